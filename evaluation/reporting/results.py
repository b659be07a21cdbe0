"""The rows of an evaluation's report.json: selection accuracies and retrieval measures."""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

from evaluation.metrics.accuracy import Accuracy
from evaluation.metrics.intervals import Interval

RECALLS = (1, 10, 50)
"""Cut-offs of the reported recalls."""
MEASURES = ("mrr", "median_rank", "tie_rate")
"""Retrieval measures besides the recalls."""
UNTRAINED = "untrained"
"""Prefix of the names of retrievers without adapters."""
SIMILARITY = "similarity"
"""The mode of a retriever that chooses the nearest candidate."""


@dataclass(frozen=True)
class SelectionResult:
    """Accuracy of one model on the selection items of one benchmark, in shares.

    Answers that cannot be parsed count as wrong.

    Attributes:
        mode: How the model was prompted, such as answer or reasoning, or similarity.
        parse_rate: Share of parsed answers; None for a retriever.
        n: Number of items.
        macro_interval: 95% interval of `macro`, bootstrapped over scenes.
        horizons: Accuracy on time items by their horizon, "1 s" and "2 s".
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
        accuracy: Accuracy,
        parse_rate: float | None,
        macro_interval: Interval | None = None,
        horizons: dict[str, Interval] | None = None,
        suite: str | None = None,
        control: str | None = None,
    ) -> SelectionResult:
        shares = (accuracy.families, accuracy.macro, accuracy.micro, parse_rate)
        optional = (macro_interval, horizons or {}, suite, control)
        return cls(benchmark, name, mode, *shares, accuracy.micro.n, *optional)

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> SelectionResult:
        macro = row["macro_interval"]
        intervals = {
            "families": {name: Interval(**share) for name, share in row["families"].items()},
            "horizons": {name: Interval(**share) for name, share in row["horizons"].items()},
            "micro": Interval(**row["micro"]),
            "macro_interval": macro and Interval(**macro),
        }
        return cls(**{**row, **intervals})


@dataclass(frozen=True)
class RetrievalResult:
    """Measures of one retriever at one width, with intervals bootstrapped over scenes.

    Results that differ only in their time are equal.

    Attributes:
        width: Embedding width; None for a pipeline without widths.
        builder: The queries' builder; None for all queries.
        bytes, seconds: Cost of the search, as in `evaluation.retrieval.exact_search.Ranks`.
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
        recalls = {f"recall@{k}": getattr(self, f"recall_{k}") for k in RECALLS}
        return {**recalls, **{name: getattr(self, name) for name in MEASURES}}

    def to_dict(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_dict(cls, row: dict[str, Any]) -> RetrievalResult:
        names = [f"recall_{k}" for k in RECALLS] + list(MEASURES)
        return cls(**{**row, **{name: Interval(**row[name]) for name in names}})
