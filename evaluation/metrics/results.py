"""The contents of an evaluation's report.json: selection accuracies and retrieval measures."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any, ClassVar, TypeVar

import numpy as np

from dynapix.data.checks.intervals import Interval, SceneBootstrap
from dynapix.data.records import FAMILIES, RetrievalQuery
from dynapix.evaluation.metrics.ranking import query_metrics
from dynapix.evaluation.metrics.reasons import ReasonSummary
from dynapix.evaluation.metrics.seeds import MACRO
from dynapix.evaluation.metrics.significance import PairedComparison, PairScores

if TYPE_CHECKING:
    from dynapix.evaluation.retrieval.exact_search import Ranks

RECALLS = (1, 10, 50)
"""Cut-offs of the reported recalls."""
COMPARED = (*(f"recall@{k}" for k in RECALLS), "mrr")
"""Measures by which retrievers are compared."""
MEASURES = (*COMPARED, "median_rank", "tie_rate")
TWIN_ABOVE = "twin_above"
"""The measure of the counterfactual pool alone: the share of queries whose factual twin ranks above
the target."""
UNTRAINED = "untrained"
"""First word of the names of Qwen3-VL retrievers that this project has not trained."""
BASELINE = "baseline"
"""Mode of the results of baselines, which choose by simple rules from the oracle."""
SCENE_ALONE = "baseline: the scene alone"
"""Name of the results of a ranker that puts all frames of the target's scene first."""
SIMILARITY = "similarity"
"""Mode of the results of `evaluation.similarity`: a retriever chooses the nearest candidate."""

T = TypeVar("T")


@dataclass(frozen=True)
class Accuracy:
    """Accuracy of each family that has items; `macro`, the unweighted mean of these accuracies; and
    `micro`, the accuracy over all items."""

    families: dict[str, Interval]
    macro: Interval
    micro: Interval


def accuracy_by_family(
    families: Sequence[str], credits: Sequence[float], scenes: SceneBootstrap
) -> Accuracy:
    """Return the accuracy by family, in the order of `FAMILIES`, and over all items.

    Args:
        families: The family of each item.
        credits: The credit for each item: 1 for a correct choice, 0 for a wrong choice, and 1/m if
            a retriever gives the highest score to the target and to m - 1 other candidates.
        scenes: The bootstrap over the items' scenes.
    """
    by_family = scenes.group_means(credits, families)
    ordered = {f: by_family[f] for f in FAMILIES if f in by_family}
    return Accuracy(ordered, scenes.macro(credits, families), scenes.mean(credits))


@dataclass(frozen=True)
class SelectionResult:
    """Accuracy of one model on the selection items of one benchmark, as fractions from 0 to 1.

    Responses that cannot be parsed count as wrong.

    Attributes:
        mode: Response mode, such as "reasoning"; `SIMILARITY` for a retriever.
        families, macro, micro: As in `Accuracy`.
        parse_rate: Fraction of the responses in which a letter was found; None for a retriever.
        n: Number of items.
        horizons: Accuracy by horizon (time from the prefix to the target), shortest first. Examples
            of keys are "8 frames" (window family) and "1 s" (time family).
        suite: The set of items, such as "matched_anchor"; None for the standard items.
        control: The change of each prefix, such as "shuffled_prefix"; None for unchanged items.
    """

    benchmark: str
    name: str
    mode: str
    families: dict[str, Interval]
    macro: Interval
    micro: Interval
    parse_rate: float | None
    n: int
    horizons: dict[str, Interval]
    suite: str | None
    control: str | None

    @property
    def variant(self) -> str:
        return variant_name(self.mode, self.control)

    @property
    def key(self) -> str:
        """Key of the details in `SelectionReport`: `variant`, or `name` if no mode was chosen."""
        return self.name if self.mode in (BASELINE, SIMILARITY) else self.variant

    @property
    def metrics(self) -> dict[str, float]:
        """The accuracies by family, macro and micro."""
        families = {family: interval.value for family, interval in self.families.items()}
        return {**families, MACRO: self.macro.value, "micro": self.micro.value}


def variant_name(mode: str, control: str | None) -> str:
    """Return the mode, followed by the control if there is one."""
    return mode if control is None else f"{mode}, {control}"


@dataclass(frozen=True)
class SelectionReport:
    """report.json of evaluation.select and evaluation.similarity.

    Attributes:
        build: Hash that identifies the benchmark's build.
        controls: Comparisons of the unchanged items with each control. For matched-anchor items,
            also comparisons of the event question with the time question of each pair.
        subtypes, readings: Details by `SelectionResult.key`. `readings` has the numbers of parsed
            responses, of valid records, and of responses that could not be parsed for each reason.
        reasons: What the rationales claim, by `SelectionResult.key`, for reasoning modes.
        pairs: Scores of pairs about interventions, by `SelectionResult.key`.
        asked: The mode and the control of each variant, and the `key` of its lines in
            answers.jsonl; empty for retrievers.
    """

    build: str
    rows: list[SelectionResult]
    controls: list[PairedComparison]
    subtypes: dict[str, dict[str, Interval]]
    readings: dict[str, dict[str, int]]
    reasons: dict[str, ReasonSummary] = field(default_factory=dict)
    asked: list[tuple[str, str | None, str]] = field(default_factory=list)
    pairs: dict[str, list[PairScores]] = field(default_factory=dict)


@dataclass(frozen=True)
class RetrievalResult:
    """Measures of one retriever, or of a two-stage pipeline, at one width, with intervals
    bootstrapped over scenes. Results that differ only in `seconds` are equal.

    Attributes:
        width: Embedding width.
        builder: Number of the builder (the procedure that made the queries); None for the queries
            of all builders.
        bytes: Size of the searched vectors at this width.
        seconds: Time to rank the database for all queries, at all widths together.
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

    pool: ClassVar[str] = "future"

    @property
    def untrained(self) -> bool:
        return self.name.startswith(UNTRAINED)

    @property
    def measures(self) -> dict[str, Interval]:
        """The measures by name, as `query_metrics` names them, such as "recall@1"."""
        return {name: getattr(self, name.replace("@", "_")) for name in MEASURES}


@dataclass(frozen=True)
class CounterfactualResult(RetrievalResult):
    """Measures over counterfactual queries, with `TWIN_ABOVE`."""

    twin_above: Interval = field(kw_only=True)

    pool: ClassVar[str] = "counterfactual"

    @property
    def measures(self) -> dict[str, Interval]:
        return {**super().measures, TWIN_ABOVE: self.twin_above}


@dataclass(frozen=True)
class RetrieverDifference:
    """Mean differences between two retrievers, left minus right, over the same queries."""

    left: str
    right: str
    width: int | None
    measures: dict[str, Interval]


@dataclass(frozen=True)
class MajorityVote(Accuracy):
    """Accuracy of the majority vote over the items with votes. `undecided` items have no majority
    and count as wrong."""

    undecided: int


@dataclass(frozen=True)
class StudyReport:
    """report.json of evaluation.study.export.

    Attributes:
        items: Number of items in the study, with or without votes.
        judgments: Number of votes.
        annotators: Annotators with votes.
        depth: Number of items by number of votes.
        accuracy: Accuracy by annotator.
        fleiss_kappa: Over the `kappa_items` items that all annotators with votes answered; None
            where it is undefined.
        seconds: Median decision times by family.
    """

    benchmark: str
    build: str
    items: int
    judgments: int
    annotators: list[str]
    depth: dict[str, int]
    accuracy: dict[str, Accuracy]
    majority: MajorityVote | None
    fleiss_kappa: float | None
    kappa_items: int
    seconds: dict[str, float]


@dataclass(frozen=True)
class RetrievalReport:
    """report.json of evaluation.retrieve and evaluation.two_stage."""

    build: str
    rows: list[CounterfactualResult | RetrievalResult]
    differences: list[RetrieverDifference] = field(default_factory=list)


def from_json(kind: type[T], value: Any) -> T:
    """Convert parsed JSON to an instance of `kind`, such as a nested dataclass.

    Raises:
        ValueError: The value does not fit the type.
    """
    from pydantic import TypeAdapter

    return TypeAdapter(kind).validate_python(value)


def retrieval_results(
    benchmark: str, name: str, ranks: Ranks, queries: Sequence[RetrievalQuery], seed: int
) -> list[RetrievalResult]:
    """Return a result for each width, widest first: over all queries, then for each builder. `seed`
    is the seed of the bootstrap over scenes. A baseline has the width None."""
    results = []
    for builder in (None, *sorted({q.builder for q in queries if q.builder})):
        indices = [i for i, q in enumerate(queries) if builder in (None, q.builder)]
        scenes = SceneBootstrap([queries[i].scene_id for i in indices], seed)
        for k, width in enumerate(ranks.widths):
            per_query = _query_metrics(ranks, k, indices)
            measures = [_summarize(name, per_query[name], scenes) for name in MEASURES]
            sizes = (len(indices), ranks.frames)
            cost = (None, None)
            if width is not None:
                cost = (ranks.vectors * width * np.dtype(np.float32).itemsize, ranks.seconds)
            values = (benchmark, name, width, builder, *measures, *sizes, *cost)
            if TWIN_ABOVE in per_query:
                twin_above = scenes.mean(per_query[TWIN_ABOVE])
                results.append(CounterfactualResult(*values, twin_above=twin_above))
            else:
                results.append(RetrievalResult(*values))
    return results


def compare_retrievers(
    ranked: Mapping[str, Ranks], queries: Sequence[RetrievalQuery], seed: int
) -> list[RetrieverDifference]:
    """Compare the first retriever with each of the others, at every width. `ranked` has the ranks
    by retriever. `seed` is the seed of the bootstrap over scenes."""
    (left, first), *others = ranked.items()
    scenes = SceneBootstrap([q.scene_id for q in queries], seed)
    compared = []
    for right, other in others:
        for k, width in enumerate(first.widths):
            one, two = (_query_metrics(r, k, slice(None)) for r in (first, other))
            names = [name for name in (*COMPARED, TWIN_ABOVE) if name in one]
            measures = {name: _summarize(name, one[name] - two[name], scenes) for name in names}
            compared.append(RetrieverDifference(left, right, width, measures))
    return compared


def _query_metrics(ranks: Ranks, k: int, indices: list[int] | slice) -> dict[str, np.ndarray]:
    """Return the measures of the queries at `indices`, at the k-th width."""
    counts = (ranks.above[k, indices], ranks.tied[k, indices], ranks.found[indices])
    measures = query_metrics(*counts, ranks.frames, RECALLS)
    if ranks.twin_above is not None:
        measures[TWIN_ABOVE] = ranks.twin_above[k, indices]
    return measures


def _summarize(name: str, values: np.ndarray, scenes: SceneBootstrap) -> Interval:
    return scenes.median(values) if name == "median_rank" else scenes.mean(values)
