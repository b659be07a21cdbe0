"""Texts that a model writes about queries' future frames and about a database's frames.

store/<name>/texts/<key>/
    texts.jsonl         the texts, in a `ResponseLog`; the key is the hash of the model's revision,
                        so that they serve any matcher
"""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

from conf.runs import lock_folder
from conf.schema import StudentConfig, TwoStageCommand
from data.records import FrameRef, RetrievalQuery
from data.store import Store
from evaluation.generators.base import Generator, response_settings
from evaluation.generators.image_server import short_hash
from evaluation.generators.response_log import (
    FreeTextResponse,
    ResponseLog,
    Subject,
    collect_responses,
    free_text_response,
)
from models.student.answer_parser import strip_thought
from models.student.prompts import Sample
from teacher.sections import SECTIONS, split_sections

TEXTS = "texts"
"""Their folder in a store."""
FUTURE_SECTIONS = ("Prediction", "Outcome")
"""The sections of a rationale that describe the future state."""
HEADING = re.compile(
    rf"^[\W\d_]*({'|'.join(SECTIONS)})(?:[*_ \t]*:[*_ \t]*|[*_ \t]*$)", re.MULTILINE | re.IGNORECASE
)
"""A section heading with the markup that models add, such as "### 3. **Prediction**"."""


@dataclass(frozen=True)
class Route:
    """A pipeline from a query to its ranking.

    Attributes:
        title: Its name in tables, as in the paper's.
        mode: The mode in which the model writes about a query.
        generates_image: Whether an image of the text is matched instead of the text.
        captions: Whether captions of the database's frames are matched instead of the frames.
    """

    title: str
    mode: str
    generates_image: bool = False
    captions: bool = False


ROUTES = {
    "cot_text": Route("CoT -> text", "rationale"),
    "predict_caption": Route("predict -> caption", "prediction", captions=True),
    "predict_image": Route("predict -> image", "prediction"),
    "predict_generated_image": Route(
        "predict -> generated image", "prediction", generates_image=True
    ),
}
"""The paper's three routes (Models and metrics), and one through an image server."""

Texts = dict[str, str]
"""Texts by the name of a query or frame; empty if nothing usable was written."""


def modes_of(routes: Sequence[str]) -> list[str]:
    """Return the modes in which texts are needed for some routes."""
    needed = {ROUTES[route].mode for route in routes}
    needed |= {"caption" for route in routes if ROUTES[route].captions}
    return [mode for mode in ("rationale", "prediction", "caption") if mode in needed]


def write_texts(
    cfg: TwoStageCommand,
    student: StudentConfig,
    model: Generator,
    sample_of: Callable[[str, Subject], Sample],
    modes: Sequence[str],
    queries: Sequence[RetrievalQuery],
    database: Sequence[FrameRef],
    store: Store,
) -> dict[str, list[FreeTextResponse]]:
    """Return a model's responses by mode: to every frame in caption mode, else to every query.

    Raises:
        UserError: Another process collects this model's texts, or the model cannot respond.
    """
    settings = {
        mode: response_settings(mode, "", student, cfg.seed, model.revision, store.identity, None)
        for mode in modes
    }
    folder = store.folder / TEXTS / short_hash(json.dumps(model.revision, sort_keys=True))
    folder.mkdir(parents=True, exist_ok=True)
    busy = f"{folder} is in use by another process; run this again when it is done"
    with lock_folder(folder, busy):
        log = ResponseLog(
            folder / "texts.jsonl", settings, [*queries, *database], free_text_response
        )
        responses = {}
        for mode in modes:
            subjects, unit = (database, "frame") if mode == "caption" else (queries, "query")
            # By scene, so that each scene's frames are decoded once.
            ordered = sorted(subjects, key=lambda s: (s.scene_id, s.name))
            respond = partial(model.respond, mode, partial(sample_of, mode))
            responses[mode] = collect_responses(ordered, mode, respond, log, unit)
        return responses


def texts_of(responses: Sequence[FreeTextResponse]) -> Texts:
    return {response.item_id: future_text(response.text) for response in responses}


def future_text(text: str) -> str:
    """Return the prediction and outcome of a response if it has these sections, else all of it.

    A thought is left out; one that is not closed leaves nothing.
    """
    text = _without_thought(text)
    return " ".join(_future_sections(text)) or text


def _without_thought(text: str) -> str:
    return (strip_thought(text) or "").strip()


def _future_sections(text: str) -> list[str]:
    plain = HEADING.sub(lambda heading: f"{heading[1].capitalize()}: ", text)
    sections = [
        plain[start:stop].strip()
        for name, start, stop in split_sections(plain)
        if name in FUTURE_SECTIONS
    ]
    return [section for section in sections if section]


def count_texts(responses: Sequence[FreeTextResponse]) -> dict[str, int]:
    """Count the texts, the empty and truncated ones, and those with future sections."""
    texts = [_without_thought(response.text) for response in responses]
    return {
        "texts": len(responses),
        "  empty: a miss": sum(not text for text in texts),
        "  cut off at student.max_new_tokens": sum(response.cut for response in responses),
        "  prediction and outcome alone": sum(bool(_future_sections(text)) for text in texts),
    }
