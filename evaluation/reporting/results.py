"""What models, retrievers and pipelines measured, as reports keep it."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from evaluation.metrics.accuracy import Accuracy
from evaluation.metrics.intervals import Interval

RECALLS = (1, 10, 50)
"""Cut-offs that the retrieval rows report."""
MEASURES = ("mrr", "median_rank", "tie_rate")
"""What they report besides."""
UNTRAINED = "untrained"
"""What the names of rows begin with that a trained retriever is held against."""

SIMILARITY = "similarity"
"""The mode of a retriever that chooses the nearest candidate."""


@dataclass(frozen=True)
class SelectionResult:
    """One model on one benchmark's selection items, in shares. What could not be parsed counts as
    wrong.

    `mode` says how it was asked, such as answer, reasoning or similarity; `parse_rate` is None
    where nothing is parsed; `n` is the number of items. `horizons` are the time items by their
    distance, "1 s" and "2 s"; the interval of `macro` is drawn over scenes. `suite` and `control`
    are those of `SelectCommand`, None where all items were shown as they are.
    """

    benchmark: str
    name: str
    mode: str
    families: dict[str, Interval]
    macro: float
    micro: Interval
    parse_rate: float | None
    n: int
    macro_interval: Interval | None = None
    horizons: dict[str, Interval] = field(default_factory=dict)
    suite: str | None = None
    control: str | None = None

    @classmethod
    def of(
        cls,
        benchmark: str,
        name: str,
        mode: str,
        found: Accuracy,
        parse_rate: float | None,
        macro_interval: Interval | None = None,
        horizons: dict[str, Interval] | None = None,
        suite: str | None = None,
        control: str | None = None,
    ) -> SelectionResult:
        shares = (found.families, found.macro, found.micro, parse_rate)
        told = (macro_interval, horizons or {}, suite, control)
        return cls(benchmark, name, mode, *shares, found.micro.n, *told)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> SelectionResult:
        families = {name: Interval(**found) for name, found in row["families"].items()}
        horizons = {name: Interval(**found) for name, found in row.get("horizons", {}).items()}
        macro = row.get("macro_interval")
        whole = {"micro": Interval(**row["micro"]), "macro_interval": macro and Interval(**macro)}
        return cls(**{**row, "families": families, "horizons": horizons, **whole})


@dataclass(frozen=True)
class RetrievalResult:
    """One retriever at one width (None for a pipeline without widths) on the queries of one builder
    (None for all of them), recalls in shares. Intervals are drawn over scenes. `bytes` and
    `seconds` are those of `evaluation.retrieval.exact_search.Ranks`; rows that differ in the time
    alone are
    equal."""

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
        """By the names that `evaluation.metrics.accuracy` gives them."""
        recalls = {f"recall@{k}": getattr(self, f"recall_{k}") for k in RECALLS}
        return {**recalls, **{name: getattr(self, name) for name in MEASURES}}

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> RetrievalResult:
        names = [f"recall_{k}" for k in RECALLS] + list(MEASURES)
        return cls(**{**row, **{name: Interval(**row[name]) for name in names}})
