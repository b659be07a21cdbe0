"""Two-stage retrieval: texts that a model writes about queries and frames, and the ranks by them.

store/<name>/texts/<key>/texts.jsonl holds the texts in a `ResponseLog`. The key is a hash of the
identity of the model that writes them, so that every matcher uses the same texts.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from itertools import compress
from pathlib import Path

import numpy as np

from dynapix.conf.errors import UserError
from dynapix.conf.files import is_writable
from dynapix.conf.runs import lock_folder, rank
from dynapix.conf.schema import StudentConfig, TwoStageCommand
from dynapix.data.records import FrameRef, RetrievalQuery
from dynapix.data.store import Store
from dynapix.evaluation.embedders.embedder import Embedder
from dynapix.evaluation.generators.generator import Generator, response_settings
from dynapix.evaluation.generators.response_log import (
    ModelResponse,
    ResponseLog,
    Subject,
    collect_responses,
)
from dynapix.evaluation.retrieval.exact_search import Ranks, exact_ranks
from dynapix.models.fingerprints import settings_key
from dynapix.models.student.prompts import Sample
from dynapix.models.student.response_text import strip_thought
from dynapix.teacher.sections import SECTIONS, split_sections

TEXTS = "texts"
"""Folder of the texts in a store."""
FUTURE_SECTIONS = ("Prediction", "Outcome")
"""The sections of a rationale that describe the target."""
HEADING = re.compile(
    rf"^[\W\d_]*({'|'.join(SECTIONS)})(?:[*_ \t]*:[*_ \t]*|[*_ \t]*$)", re.MULTILINE | re.IGNORECASE
)
"""A section heading with the markup that models add, such as "### 3. **Prediction**"."""


@dataclass(frozen=True)
class Route:
    """A pipeline from a query to its ranking.

    Attributes:
        title: The route's name in tables, as in the paper.
        mode: The mode in which the model writes about a query.
        captions: Whether a query's text is matched to the model's captions of the frames instead
            of to the frames.
    """

    title: str
    mode: str
    captions: bool = False


ROUTES = {
    "cot_text": Route("CoT -> text", "rationale"),
    "predict_caption": Route("predict -> caption", "prediction", captions=True),
    "predict_image": Route("predict -> image", "prediction"),
}
"""The paper's three routes (its section "Models and metrics")."""

Texts = dict[str, str]
"""Texts by the name of a query or frame. A text is empty if the response has no usable text."""


def collect_texts(
    cfg: TwoStageCommand,
    student: StudentConfig,
    model: Generator,
    sample_of: Callable[[str, Subject], Sample],
    routes: Sequence[Route],
    queries: Sequence[RetrievalQuery],
    database: Sequence[FrameRef],
    store: Store,
    own: Path,
) -> dict[str, list[ModelResponse]]:
    """Return a model's responses by mode, in the modes that the routes need: to every frame of the
    database in caption mode, to every query in the other modes. Only the main rank returns them.

    They are kept in the store; in the folder `own`, if the store cannot be written.

    Raises:
        UserError: Another process collects this model's texts, or the model cannot respond.
    """
    modes = sorted({route.mode for route in routes}, reverse=True)
    modes += ["caption"] if any(route.captions for route in routes) else []
    # The prompts of these modes do not depend on a training regime.
    settings = {
        mode: response_settings(mode, "", student, cfg.seed, model.identity, store.identity, None)
        for mode in modes
    }
    shared = store.folder / TEXTS / settings_key(model.identity)
    folder = shared if is_writable(shared) else own / TEXTS
    folder.mkdir(parents=True, exist_ok=True)
    responses = {}
    busy = f"{folder} is in use by another process: run this again when that process has ended"
    with lock_folder(folder, busy):
        log = ResponseLog(folder / "texts.jsonl", settings, [*queries, *database])
        if folder != shared:
            log.add_from(shared.glob("texts.jsonl"))
        for mode in modes:
            subjects, unit = (database, "frame") if mode == "caption" else (queries, "query")
            # By scene, so that each scene's frames are decoded once.
            ordered = sorted(subjects, key=lambda s: (s.scene_id, s.name))
            respond = partial(model.respond, mode, partial(sample_of, mode))
            responses[mode] = collect_responses(ordered, mode, respond, log, unit)
    return responses


def future_text(text: str) -> str:
    """Return the sections prediction and outcome of a response, or all of it if it lacks both.

    Thinking is removed. A response that ends within its thinking yields an empty text.
    """
    return _future_sections(text) or _without_thought(text)


def _without_thought(text: str) -> str:
    # A server may return an unpaired surrogate, which tokenizers reject.
    return (strip_thought(text.encode(errors="replace").decode()) or "").strip()


def _future_sections(text: str) -> str:
    plain = HEADING.sub(lambda match: f"{match[1].capitalize()}: ", _without_thought(text))
    sections = [(name, plain[start:stop].strip()) for name, start, stop in split_sections(plain)]
    return " ".join(text for name, text in sections if text and name in FUTURE_SECTIONS)


def count_texts(responses: Sequence[ModelResponse]) -> dict[str, int]:
    """Count all texts, the empty and truncated ones, and those with a prediction or an outcome."""
    texts = [response.text for response in responses]
    return {
        "texts": len(texts),
        "  empty: a miss": sum(not _without_thought(text) for text in texts),
        "  cut off at student.max_new_tokens": sum(response.truncated for response in responses),
        "  prediction and outcome alone": sum(bool(_future_sections(text)) for text in texts),
    }


def rank_by_text(
    route: Route,
    matcher: Embedder,
    texts: Mapping[str, Texts],
    queries: Sequence[RetrievalQuery],
    database: Sequence[FrameRef],
) -> Ranks | None:
    """Rank the database for every query by its text. The ranks of a launcher share the embedding;
    only the main rank returns ranks.

    A query is a miss if its text is empty or, on a route with captions, its target's caption is.

    Args:
        texts: The texts of queries, and the captions of frames, by mode.

    Raises:
        UserError: All queries are misses, or the texts or frames cannot be embedded.
    """
    names = [frame.name for frame in database]
    # Without captions, the names stand for the frames: none of them is empty.
    captions = texts["caption"] if route.captions else {name: name for name in names}
    text_of = [texts[route.mode][query.name] for query in queries]
    valid = [bool(t and captions[q.target.name]) for t, q in zip(text_of, queries, strict=True)]
    if not any(valid):
        raise UserError(
            f"{route.title}: no query has a text to match (see {matcher.store.folder / TEXTS}): if "
            "thinking takes all of student.max_new_tokens, raise this limit",
            code="no-texts",
        )
    text_of = list(compress(text_of, valid))
    targets = [query.target.name for query in compress(queries, valid)]

    present = [captions[name] for name in names if captions[name]]
    embedded = matcher.embed_texts(text_of)
    embeddings = matcher.embed_texts(present) if route.captions else matcher.embed_frames(database)
    if rank() > 0:
        return None
    target_rows = embeddings.rows([captions[target] for target in targets])
    # Frames with the same caption tie, and each of them counts.
    parts = [embeddings.rows(present)] if route.captions else embeddings.parts(present)
    ranks = exact_ranks(embedded.rows(text_of), target_rows, parts, matcher.preset.widths)
    above, tied = np.zeros((2, len(ranks.widths), len(queries)), np.int64)
    above[:, valid], tied[:, valid] = ranks.above, ranks.tied
    return replace(ranks, above=above, tied=tied, found=np.array(valid), frames=len(names))
