"""Rank a database by the texts that a model wrote about queries, with a frozen encoder."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace
from itertools import compress
from typing import Any

import numpy as np

from conf.errors import UserError
from conf.schema import TwoStageCommand
from data.records import FrameRef, RetrievalQuery
from data.render.frame_cache import FrameReader
from data.store import Store
from evaluation.embedders.base import Embedder, embed_frames, embed_images, embed_texts
from evaluation.generators.image_server import ImageGenerator
from evaluation.metrics.ranking import query_metrics
from evaluation.retrieval.exact_search import Ranks
from evaluation.retrieval.predicted_texts import TEXTS, Route, Texts
from evaluation.retrieval.standard_test import rank_targets, read_parts


def rank_by_text(
    cfg: TwoStageCommand,
    route: Route,
    matcher: Embedder,
    texts: Mapping[str, Texts],
    queries: Sequence[RetrievalQuery],
    database: Sequence[FrameRef],
    store: Store,
) -> Ranks:
    """Rank the database for every query by its text.

    A query without a text is a miss, and so is one whose target has no caption on a route that
    matches captions.

    Raises:
        UserError: No query has a text, or embedding or image generation fails.
    """
    batch, preset = cfg.matcher.batch, matcher.preset
    names = [frame.name for frame in database]
    captions = texts["caption"] if route.captions else {name: name for name in names}
    text_of = [texts[route.mode][query.name] for query in queries]
    valid = [bool(t and captions[q.target.name]) for t, q in zip(text_of, queries, strict=True)]
    if not any(valid):
        raise UserError(
            f"{route.title}: no query has a text to match, see {store.folder / TEXTS}; a thought "
            "may have taken all of student.max_new_tokens",
            code="no-texts",
        )
    text_of = list(compress(text_of, valid))
    targets = [query.target.name for query in compress(queries, valid)]

    if route.generates_image:
        images = ImageGenerator(cfg.images, store).respond(sorted(set(text_of)))
        name_of = {text: f"{path.parent.name}/{path.stem}" for text, path in images.items()}
        files = {name_of[text]: path for text, path in images.items()}
        embeddings = embed_images(matcher, files, store, batch)
        query_rows = embeddings.rows([name_of[text] for text in text_of])
    else:
        query_rows = embed_texts(matcher, text_of, store, batch).rows(text_of)

    if route.captions:
        present = [captions[name] for name in names if captions[name]]
        embeddings = embed_texts(matcher, present, store, batch)
        target_rows = embeddings.rows([captions[target] for target in targets])
        # Frames with the same caption tie, and each of them counts.
        ranks = rank_targets(preset, query_rows, target_rows, [embeddings.rows(present)])
    else:
        frames = FrameReader(store, preset.image_size)
        embeddings = embed_frames(matcher, database, store, frames, batch)
        ranks = rank_targets(
            preset, query_rows, embeddings.rows(targets), read_parts(embeddings, names)
        )
    return add_misses(ranks, np.array(valid), len(names))


def add_misses(ranks: Ranks, valid: np.ndarray, frames: int) -> Ranks:
    """Extend the ranks of the `valid` queries to all queries, with misses among `frames`."""

    def extend(counts: np.ndarray) -> np.ndarray:
        extended = np.zeros((len(counts), len(valid)), counts.dtype)
        extended[:, valid] = counts
        return extended

    counts = {name: extend(getattr(ranks, name)) for name in ("greater", "tied", "found")}
    return replace(ranks, frames=frames, **counts)


def matched_texts(
    route: str, queries: Sequence[RetrievalQuery], texts: Texts, ranks: Ranks
) -> list[dict[str, Any]]:
    """Return each query's text and its target's rank at the widest width, for matched.jsonl.

    A miss has the database's size as its rank.
    """
    counts = (ranks.greater[0], ranks.tied[0], ranks.found[0])
    places = query_metrics(*counts, ranks.frames, ())["median_rank"]
    return [
        {"query_id": q.query_id, "route": route, "text": texts[q.name], "rank": float(place)}
        for q, place in zip(queries, places, strict=True)
    ]
