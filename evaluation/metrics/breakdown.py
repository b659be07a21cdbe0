"""Rows of result tables: accuracy by family and subtype, ranking measures by builder and width."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from data.records import RetrievalQuery, SelectionItem
from data.tracks.selection.time import CELLS
from evaluation.metrics.accuracy import accuracy_by_family, accuracy_by_group
from evaluation.metrics.intervals import Interval, SceneBootstrap, macro_by_scene
from evaluation.metrics.ranking import aggregate, expected_hits, query_metrics
from evaluation.reporting.results import RECALLS, RetrievalResult, SelectionResult
from evaluation.retrieval.exact_search import Ranks


def selection_row(
    benchmark: str,
    name: str,
    mode: str,
    items: Sequence[SelectionItem],
    credits: Sequence[float],
    parse_rate: float | None,
    seed: int,
    suite: str | None = None,
    control: str | None = None,
) -> SelectionResult:
    """Return a model's row from the credit of each item: 1 if right, 1/m for a tie among m.

    `seed` is that of the scene resampling for the macro accuracy's interval.
    """
    families = [i.family for i in items]
    macro = macro_by_scene(credits, families, [i.scene_id for i in items], seed)
    timed = [(i, credit) for i, credit in zip(items, credits, strict=True) if i.family == "time"]
    horizons = accuracy_by_group([f"{CELLS[i.subtype]} s" for i, _ in timed], [c for _, c in timed])
    accuracy = accuracy_by_family(families, credits)
    return SelectionResult.of(
        benchmark, name, mode, accuracy, parse_rate, macro, horizons, suite, control
    )


def accuracy_by_subtype(
    items: Sequence[SelectionItem], credits: Sequence[float]
) -> dict[str, Interval]:
    """Return the accuracy of each subtype, named `family/subtype`."""
    return accuracy_by_group([f"{i.family}/{i.subtype}" for i in items], credits)


def retrieval_rows(
    benchmark: str, name: str, ranks: Ranks, queries: Sequence[RetrievalQuery], seed: int
) -> list[RetrievalResult]:
    """Return one row per width, widest first, over all queries, and then the same per builder.

    `seed` is that of the scene resampling for the intervals.
    """
    rows = []
    for builder, indices in queries_by_builder(queries).items():
        scenes = SceneBootstrap([queries[k].scene_id for k in indices], seed)
        for k, width in enumerate(ranks.widths):
            counts = (ranks.greater[k, indices], ranks.tied[k, indices], ranks.found[k, indices])
            per_query = query_metrics(*counts, ranks.frames, RECALLS)
            measures = [_measure(measure, values, scenes) for measure, values in per_query.items()]
            sizes = (len(indices), ranks.frames)
            cost = (ranks.bytes and ranks.bytes[k], ranks.seconds and ranks.seconds[k])
            rows.append(RetrievalResult(benchmark, name, width, builder, *measures, *sizes, *cost))
    return rows


def compare_retrievers(
    ranked: Mapping[str, Ranks], queries: Sequence[RetrievalQuery], seed: int
) -> list[dict[str, Any]]:
    """Compare the first retriever with each other one, at every width, over the same queries.

    Returns:
        Dictionaries of `left`, `right`, `width` and `measures`: by name the mean difference, left
        less right, with its interval. `seed` is that of the scene resampling.
    """
    (left, first), *others = ranked.items()
    scenes = SceneBootstrap([q.scene_id for q in queries], seed)
    compared = []
    for right, other in others:
        for k, width in enumerate(first.widths):
            per_query = [
                query_metrics(r.greater[k], r.tied[k], r.found[k], r.frames, RECALLS)
                for r in (first, other)
            ]
            measures = {
                name: asdict(_measure(name, per_query[0][name] - per_query[1][name], scenes))
                for name in (*(f"recall@{k}" for k in RECALLS), "mrr")
            }
            compared.append({"left": left, "right": right, "width": width, "measures": measures})
    return compared


def _measure(name: str, values: np.ndarray, scenes: SceneBootstrap) -> Interval:
    low, high = scenes.median(values) if name == "median_rank" else scenes.mean(values)
    return Interval(float(aggregate(name)(values)), float(low), float(high), len(values))


def queries_by_builder(queries: Sequence[RetrievalQuery]) -> dict[int | None, np.ndarray]:
    """Return the indices of all queries, under None, and of each builder's."""
    builders = np.array([q.builder or 0 for q in queries])
    groups = {None: np.arange(len(queries))}
    return groups | {int(b): np.flatnonzero(builders == b) for b in np.unique(builders) if b}


def recall_curves(
    name: str, ranks: Ranks, queries: Sequence[RetrievalQuery]
) -> list[dict[str, Any]]:
    """Return recall over k at the widest width, of all queries and of each builder's.

    Each curve has `name`, `builder`, `ks` up to the size of the database, and `recalls`.
    """
    ks = sorted({round(k) for k in np.geomspace(1, ranks.frames, 60)})
    curves = []
    for builder, indices in queries_by_builder(queries).items():
        counts = (ranks.greater[0, indices], ranks.tied[0, indices], ranks.found[0, indices])
        recalls = [float(expected_hits(*counts, k).mean()) for k in ks]
        curves.append({"name": name, "builder": builder, "ks": ks, "recalls": recalls})
    return curves
