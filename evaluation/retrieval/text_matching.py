"""What was written of queries, matched to a database by a frozen encoder."""

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
from evaluation.embedders.embed import Embedder, embed_frames, embed_images, embed_texts
from evaluation.metrics.ranking import query_metrics
from evaluation.retrieval.exact_search import Ranks
from evaluation.retrieval.image_server import draw
from evaluation.retrieval.predicted_texts import TEXTS, Route, Texts
from evaluation.retrieval.standard_test import in_parts, rank_targets


def ranks(
    cfg: TwoStageCommand,
    route: Route,
    matcher: Embedder,
    texts: Mapping[str, Texts],
    queries: Sequence[RetrievalQuery],
    database: Sequence[FrameRef],
    store: Store,
) -> Ranks:
    """Rank the database for every query by what was written of it. A query of which nothing was
    written finds nothing, nor does one whose target has no caption where captions are matched.

    Raises:
        UserError: nothing was written of any query, or what embeds or draws raises it.
    """
    batch, preset = cfg.matcher.batch, matcher.preset
    names = [frame.name for frame in database]
    said = [texts[route.mode][query.name] for query in queries]
    captions = texts["caption"] if route.captions else {name: name for name in names}
    there = [bool(s and captions[q.target.name]) for s, q in zip(said, queries, strict=True)]
    if not any(there):
        raise UserError(
            f"{route.title}: nothing was written that could be matched, see "
            f"{store.folder / TEXTS}; a thought may have taken all of student.max_new_tokens"
        )
    said = list(compress(said, there))
    targets = [query.target.name for query in compress(queries, there)]

    if route.drawn:
        images = draw(cfg.images, sorted(set(said)), store)
        name_of = {text: f"{path.parent.name}/{path.stem}" for text, path in images.items()}
        by_name = {name_of[text]: path for text, path in images.items()}
        asked = embed_images(matcher, by_name, store, batch).rows([name_of[text] for text in said])
    else:
        asked = embed_texts(matcher, said, store, batch).rows(said)

    if route.captions:
        told = [captions[name] for name in names if captions[name]]
        shown = embed_texts(matcher, told, store, batch)
        goals = shown.rows([captions[target] for target in targets])
        # Frames of one caption tie, and each of them counts.
        found = rank_targets(preset, asked, goals, [shown.rows(told)])
    else:
        frames = FrameReader(store, preset.image_size)
        shown = embed_frames(matcher, database, store, frames, batch)
        found = rank_targets(preset, asked, shown.rows(targets), in_parts(shown, names))
    return with_misses(found, np.array(there), len(names))


def with_misses(found: Ranks, there: np.ndarray, frames: int) -> Ranks:
    """Ranks of some queries as ranks of all, of which those that are not `there` found nothing
    among `frames`."""

    def among_all(counts: np.ndarray) -> np.ndarray:
        every = np.zeros((len(counts), len(there)), counts.dtype)
        every[:, there] = counts
        return every

    counts = {name: among_all(getattr(found, name)) for name in ("greater", "tied", "found")}
    return replace(found, frames=frames, **counts)


def matched(
    route: str, queries: Sequence[RetrievalQuery], texts: Texts, found: Ranks
) -> list[dict[str, Any]]:
    """What was matched for each query, and its target's rank at the widest width: the database's
    size where it was not found."""
    counts = (found.greater[0], found.tied[0], found.found[0])
    places = query_metrics(*counts, found.frames, ())["median_rank"]
    return [
        {"query_id": q.query_id, "route": route, "text": texts[q.name], "rank": float(place)}
        for q, place in zip(queries, places, strict=True)
    ]
