"""From ranks and credits to rows: every measure of a retriever, by builder and width, and of a
choice among candidates, by family and subtype, with its interval."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from data.records import RetrievalQuery, SelectionItem
from data.tracks.selection.time import CELLS
from evaluation.metrics.accuracy import accuracy_by_family, accuracy_by_group
from evaluation.metrics.intervals import Interval, SceneBootstrap, macro_by_scene
from evaluation.metrics.ranking import expected_hits, query_metrics, summary
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
    """A row of the credit that each item was given, 1 for a right choice and 1/m for a tie among m.
    The scenes of macro's interval are drawn by `seed`."""
    families = [i.family for i in items]
    macro = macro_by_scene(credits, families, [i.scene_id for i in items], seed)
    timed = [(i, credit) for i, credit in zip(items, credits, strict=True) if i.family == "time"]
    horizons = accuracy_by_group([f"{CELLS[i.subtype]} s" for i, _ in timed], [c for _, c in timed])
    accuracy = accuracy_by_family(families, credits)
    told = (macro, horizons, suite, control)
    return SelectionResult.of(benchmark, name, mode, accuracy, parse_rate, *told)


def accuracy_by_subtype(
    items: Sequence[SelectionItem], credits: Sequence[float]
) -> dict[str, Interval]:
    """Accuracy of each cell, named `family/subtype`."""
    return accuracy_by_group([f"{i.family}/{i.subtype}" for i in items], credits)


def retrieval_rows(
    benchmark: str, name: str, ranks: Ranks, queries: Sequence[RetrievalQuery], seed: int
) -> list[RetrievalResult]:
    """A row a width, widest first, over all queries, and then as many of each builder's. The scenes
    of the intervals are drawn by `seed`."""
    rows = []
    for builder, of in by_builder(queries).items():
        scenes = SceneBootstrap([queries[k].scene_id for k in of], seed)
        for k, width in enumerate(ranks.widths):
            counts = (ranks.greater[k, of], ranks.tied[k, of], ranks.found[k, of])
            each = query_metrics(*counts, ranks.frames, RECALLS)
            found = [_measured(measure, values, scenes) for measure, values in each.items()]
            sizes = (len(of), ranks.frames)
            cost = (ranks.bytes and ranks.bytes[k], ranks.seconds and ranks.seconds[k])
            rows.append(RetrievalResult(benchmark, name, width, builder, *found, *sizes, *cost))
    return rows


def compare_retrievers(
    ranked: Mapping[str, Ranks], queries: Sequence[RetrievalQuery], seed: int
) -> list[dict[str, Any]]:
    """The first of some retrievers less each other one, at every width, over the same queries:
    `left`, `right`, `width`, and by measure the mean difference with its interval. The scenes of
    the intervals are drawn by `seed`."""
    (left, one), *others = ranked.items()
    scenes = SceneBootstrap([q.scene_id for q in queries], seed)
    found = []
    for right, other in others:
        for k, width in enumerate(one.widths):
            each = [
                query_metrics(r.greater[k], r.tied[k], r.found[k], r.frames, RECALLS)
                for r in (one, other)
            ]
            names = [*(f"recall@{k}" for k in RECALLS), "mrr"]
            apart = {name: _measured(name, each[0][name] - each[1][name], scenes) for name in names}
            told = {name: asdict(interval) for name, interval in apart.items()}
            found.append({"left": left, "right": right, "width": width, "measures": told})
    return found


def _measured(measure: str, values: np.ndarray, scenes: SceneBootstrap) -> Interval:
    middle = scenes.median(values) if measure == "median_rank" else scenes.mean(values)
    return Interval(float(summary(measure)(values)), *map(float, middle), len(values))


def by_builder(queries: Sequence[RetrievalQuery]) -> dict[int | None, np.ndarray]:
    """The numbers of all queries, under None, and of each builder's."""
    of = np.array([q.builder or 0 for q in queries])
    every = {None: np.arange(len(queries))}
    return every | {int(b): np.flatnonzero(of == b) for b in np.unique(of) if b}


def recall_curves(
    name: str, ranks: Ranks, queries: Sequence[RetrievalQuery]
) -> list[dict[str, Any]]:
    """Recall over k at the widest width, of all queries and of each builder's: `name`, `builder`,
    `ks` up to the whole database, and `recalls`."""
    ks = sorted({round(k) for k in np.geomspace(1, ranks.frames, 60)})
    curves = []
    for builder, of in by_builder(queries).items():
        counts = (ranks.greater[0, of], ranks.tied[0, of], ranks.found[0, of])
        recalls = [float(expected_hits(*counts, k).mean()) for k in ks]
        curves.append({"name": name, "builder": builder, "ks": ks, "recalls": recalls})
    return curves
