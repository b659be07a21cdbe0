"""The rows of an evaluation's report.json: selection accuracies and retrieval measures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, TypeVar

import numpy as np

from data.records import RetrievalQuery, SelectionItem
from data.tracks.selection.time import CELLS
from evaluation.metrics.accuracy import accuracy_by_family, accuracy_by_group
from evaluation.metrics.intervals import Interval, SceneBootstrap, macro_by_scene
from evaluation.metrics.ranking import expected_hits, query_metrics

if TYPE_CHECKING:
    from pydantic import TypeAdapter

    from evaluation.retrieval.exact_search import Ranks

RECALLS = (1, 10, 50)
"""Cut-offs of the reported recalls."""
COMPARED = (*(f"recall@{k}" for k in RECALLS), "mrr")
"""Measures by which retrievers are compared."""
MEASURES = (*COMPARED, "median_rank", "tie_rate")
UNTRAINED = "untrained"
"""Prefix of the names of retrievers without adapters."""
SIMILARITY = "similarity"
"""The mode of a retriever that chooses the nearest candidate."""

T = TypeVar("T")


@dataclass(frozen=True)
class SelectionResult:
    """Accuracy of one model on the selection items of one benchmark, in shares.

    Answers that cannot be parsed count as wrong.

    Attributes:
        mode: How the model was prompted, such as answer or reasoning, or similarity.
        parse_rate: Share of parsed answers; None for a retriever.
        n: Number of items.
        macro_interval: 95% interval of `macro`, bootstrapped over scenes.
        horizons: Accuracy by horizon, nearest first: such as "8 frames" in the window family, and
            "1 s" in the time family.
        suite, control: As in `SelectCommand`; None for the benchmark's own items, unchanged.
    """

    benchmark: str
    name: str
    mode: str
    families: dict[str, Interval]
    macro: float
    micro: Interval
    parse_rate: float | None
    n: int
    macro_interval: Interval
    horizons: dict[str, Interval]
    suite: str | None
    control: str | None

    @property
    def variant(self) -> str:
        return variant_name(self.mode, self.control)

    @property
    def key(self) -> str:
        """The key of its details in the report: the name of a retriever, or else the variant."""
        return self.name if self.mode == SIMILARITY else self.variant

    @property
    def metrics(self) -> dict[str, float]:
        """The accuracies by family, macro and micro."""
        families = {family: share.value for family, share in self.families.items()}
        return {**families, "macro": self.macro, "micro": self.micro.value}


def variant_name(mode: str, control: str | None) -> str:
    """The mode, followed by the control if there is one."""
    return mode if control is None else f"{mode}, {control}"


@dataclass(frozen=True)
class RetrievalResult:
    """Measures of one retriever at one width, with intervals bootstrapped over scenes.

    Results that differ only in their time are equal.

    Attributes:
        width: Embedding width; None for a pipeline without widths.
        builder: The queries' builder; None for all queries.
        bytes: Size of the searched vectors at this width.
        seconds: Time to rank for all queries, at all widths together.
    """

    benchmark: str
    name: str
    width: int | None
    builder: int | None
    recall_1: Interval
    recall_10: Interval
    recall_50: Interval
    mrr: Interval
    median_rank: Interval
    tie_rate: Interval
    queries: int
    frames: int
    bytes: int | None = None
    seconds: float | None = field(default=None, compare=False)

    @property
    def untrained(self) -> bool:
        return self.name.startswith(UNTRAINED)

    @property
    def measures(self) -> dict[str, Interval]:
        """The measures by the names of `evaluation.metrics.ranking`."""
        return {name: getattr(self, name.replace("@", "_")) for name in MEASURES}


@cache
def _adapter(kind: Any) -> TypeAdapter:
    from pydantic import TypeAdapter

    return TypeAdapter(kind)


def from_json(kind: type[T], value: Any) -> T:
    """Return parsed JSON as an object of a type, such as a dataclass of dataclasses.

    Raises:
        ValueError: The value does not fit the type.
    """
    return _adapter(kind).validate_python(value)


def selection_result(
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
    """Return a model's result from the credit of each item: 1 if right, 1/m for a tie among m.

    `seed` is that of the scene resampling for the macro accuracy's interval.
    """
    families = [i.family for i in items]
    macro = macro_by_scene(credits, families, [i.scene_id for i in items], seed)
    timed = [(h, c) for i, c in zip(items, credits, strict=True) if (h := horizon_of(i))]
    by_horizon = accuracy_by_group([h for h, _ in timed], [c for _, c in timed])
    # Horizons in frames are all below one second.
    ordered = sorted(by_horizon, key=lambda h: (h.endswith(" s"), int(h.split()[0])))
    horizons = {horizon: by_horizon[horizon] for horizon in ordered}
    accuracy = accuracy_by_family(families, credits)
    return SelectionResult(
        benchmark, name, mode, accuracy.families, accuracy.macro, accuracy.micro, parse_rate,
        len(items), macro, horizons, suite, control,
    )  # fmt: skip


def horizon_of(item: SelectionItem) -> str | None:
    """Return the horizon of an item of the time family in s, or of the window family in frames."""
    if item.family == "time":
        return f"{CELLS[item.subtype]} s"
    return f"{item.horizon} frames" if item.family == "window" else None


def retrieval_results(
    benchmark: str, name: str, ranks: Ranks, queries: Sequence[RetrievalQuery], seed: int
) -> list[RetrievalResult]:
    """Return one result per width, widest first, over all queries, and then the same per builder.

    `seed` is that of the scene resampling for the intervals.
    """
    results = []
    for builder, indices in queries_by_builder(queries).items():
        scenes = SceneBootstrap([queries[k].scene_id for k in indices], seed)
        for k, width in enumerate(ranks.widths):
            per_query = _query_metrics(ranks, k, indices)
            measures = [_measure(measure, per_query[measure], scenes) for measure in MEASURES]
            sizes = (len(indices), ranks.frames)
            cost = (ranks.vectors * width * np.dtype(np.float32).itemsize, ranks.seconds)
            results.append(
                RetrievalResult(benchmark, name, width, builder, *measures, *sizes, *cost)
            )
    return results


@dataclass(frozen=True)
class RetrieverDifference:
    """Mean differences between two retrievers, left less right, over the same queries."""

    left: str
    right: str
    width: int | None
    measures: dict[str, Interval]


def compare_retrievers(
    ranked: Mapping[str, Ranks], queries: Sequence[RetrievalQuery], seed: int
) -> list[RetrieverDifference]:
    """Compare the first retriever with each other one, at every width.

    `seed` is that of the scene resampling for the intervals.
    """
    (left, first), *others = ranked.items()
    scenes = SceneBootstrap([q.scene_id for q in queries], seed)
    compared = []
    for right, other in others:
        for k, width in enumerate(first.widths):
            one, two = (_query_metrics(r, k, slice(None)) for r in (first, other))
            measures = {name: _measure(name, one[name] - two[name], scenes) for name in COMPARED}
            compared.append(RetrieverDifference(left, right, width, measures))
    return compared


def _query_metrics(ranks: Ranks, k: int, indices: np.ndarray | slice) -> dict[str, np.ndarray]:
    """Return the measures of some queries at the k-th width."""
    counts = (ranks.greater[k, indices], ranks.tied[k, indices], ranks.found[indices])
    return query_metrics(*counts, ranks.frames, RECALLS)


def _measure(name: str, values: np.ndarray, scenes: SceneBootstrap) -> Interval:
    median = name == "median_rank"
    low, high = scenes.median(values) if median else scenes.mean(values)
    value = np.median(values) if median else np.mean(values)
    return Interval(float(value), float(low), float(high), len(values))


def queries_by_builder(queries: Sequence[RetrievalQuery]) -> dict[int | None, np.ndarray]:
    """Return the indices of all queries, under None, and of each builder's."""
    builders = np.array([q.builder or 0 for q in queries])
    groups = {None: np.arange(len(queries))}
    return groups | {int(b): np.flatnonzero(builders == b) for b in np.unique(builders) if b}


def recall_curve(name: str, ranks: Ranks) -> dict[str, Any]:
    """Return recall over k at the widest width: `name`, `ks` up to the size of the database, and
    `recalls`."""
    ks = sorted({round(k) for k in np.geomspace(1, ranks.frames, 60)})
    counts = ranks.greater[0], ranks.tied[0], ranks.found
    recalls = [float(expected_hits(*counts, k).mean()) for k in ks]
    return {"name": name, "ks": ks, "recalls": recalls}
