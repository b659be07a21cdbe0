"""What a model writes of the frames that queries ask for, and of the frames of a database.

store/<name>/texts/<key>/
    texts.jsonl         every text, as `evaluation.generators.response_log` logs it; the key is the
                        hash of the
                        model's revision, so that any matcher finds what a model has written
"""

from __future__ import annotations

import json
import re
from collections.abc import Sequence
from dataclasses import dataclass

from conf.runs import lock_folder
from conf.schema import StudentConfig, TwoStageCommand
from data.records import FrameRef, RetrievalQuery
from data.store import Store
from evaluation.generators.model_source import Generator, SampleOf, response_settings
from evaluation.generators.response_log import (
    FreeTextResponse,
    ResponseLog,
    collect_responses,
    free_text_response,
)
from evaluation.retrieval.image_server import short_hash
from models.student.answer_parser import strip_thought
from teacher.sections import SECTIONS, split_sections

TEXTS = "texts"
"""Folder of them in a store."""
FORESEEN = ("Prediction", "Outcome")
"""The sections of a rationale that tell the future state."""
MARKED = re.compile(
    rf"^[\W\d_]*({'|'.join(SECTIONS)})(?:[*_ \t]*:[*_ \t]*|[*_ \t]*$)", re.MULTILINE | re.IGNORECASE
)
"""A heading as models like to write it, such as "### 3. **Prediction**"."""


@dataclass(frozen=True)
class Route:
    """How a query is matched, as the paper's table of retrieval names it: what is written, whether
    it is drawn before it is embedded, and whether the database is matched by texts of its frames
    rather than by the frames themselves."""

    title: str
    mode: str
    drawn: bool = False
    captions: bool = False


ROUTES = {
    "cot_text": Route("CoT -> text", "rationale"),
    "predict_caption": Route("predict -> caption", "prediction", captions=True),
    "predict_image": Route("predict -> image", "prediction"),
    "predict_drawn": Route("predict -> drawn", "prediction", drawn=True),
}
"""The paper's three (Models and metrics), and one that has the future drawn."""

Texts = dict[str, str]
"""By the name of a query or frame; empty where nothing was written."""


def modes_of(routes: Sequence[str]) -> list[str]:
    """What has to be written for some routes, in the order in which it is."""
    needed = {ROUTES[route].mode for route in routes}
    needed |= {"caption" for route in routes if ROUTES[route].captions}
    return [mode for mode in ("rationale", "prediction", "caption") if mode in needed]


def write_texts(
    cfg: TwoStageCommand,
    student: StudentConfig,
    model: Generator,
    sample_of: SampleOf,
    modes: Sequence[str],
    queries: Sequence[RetrievalQuery],
    database: Sequence[FrameRef],
    store: Store,
) -> dict[str, list[FreeTextResponse]]:
    """What a model writes of every query, or in captions of every frame, by mode; what it has
    written before is read.

    Raises:
        UserError: another process has it write, or it cannot be asked.
    """
    known = {
        mode: response_settings(mode, "", student, cfg.seed, model.revision, store.identity, None)
        for mode in modes
    }
    folder = store.folder / TEXTS / short_hash(json.dumps(model.revision, sort_keys=True))
    folder.mkdir(parents=True, exist_ok=True)
    busy = f"{folder} is being written by another process; run this again when it is done"
    with lock_folder(folder, busy):
        log = ResponseLog(folder / "texts.jsonl", known, [*queries, *database], free_text_response)
        written = {}
        for mode in modes:
            things, unit = (database, "frame") if mode == "caption" else (queries, "query")
            # Scene by scene, so that a scene's frames are decoded once.
            ordered = sorted(things, key=lambda t: (t.scene_id, t.name))
            written[mode] = collect_responses(ordered, mode, model.say(mode, sample_of), log, unit)
        return written


def texts_of(written: Sequence[FreeTextResponse]) -> Texts:
    return {told.item_id: foreseen(told.text) for told in written}


def foreseen(text: str) -> str:
    """What of a text tells a state: its prediction and outcome where it has these sections, else
    all of it. A thought is none of it, and one that is not closed leaves nothing."""
    said = _said(text)
    return " ".join(_sections(said)) or said


def _said(text: str) -> str:
    return (strip_thought(text) or "").strip()


def _sections(said: str) -> list[str]:
    plain = MARKED.sub(lambda found: f"{found[1].capitalize()}: ", said)
    told = [
        plain[start:stop].strip() for name, start, stop in split_sections(plain) if name in FORESEEN
    ]
    return [section for section in told if section]


def counts(written: Sequence[FreeTextResponse]) -> dict[str, int]:
    """How many texts there are, how many are empty or cut off, and of how many the sections that
    tell the future are matched alone."""
    said = [_said(told.text) for told in written]
    return {
        "texts": len(written),
        "  empty: a miss": sum(not text for text in said),
        "  cut off at student.max_new_tokens": sum(told.cut for told in written),
        "  prediction and outcome alone": sum(bool(_sections(text)) for text in said),
    }
