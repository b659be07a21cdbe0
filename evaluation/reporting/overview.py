"""The overview that `evaluation.report` prints: the accuracy of the student that was evaluated last
and of each trained retriever."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

from dynapix.data.checks.intervals import Interval
from dynapix.evaluation.metrics.results import TWIN_ABOVE, RetrievalResult
from dynapix.evaluation.metrics.selection import BASELINES
from dynapix.evaluation.reporting.item_results import ItemResults
from dynapix.evaluation.reporting.measurements import Measurement, widest_results

CHANCE = 25.0
"""Accuracy of random choices among four candidates, in percent."""


def write_overview(
    selections: Sequence[Measurement], retrievals: Sequence[Measurement], by_item: ItemResults
) -> str:
    """Return the overview of a report; empty if no trained model was measured."""
    students = [m for m in selections if m.trained and not m.variants]
    reasoning = [m for m in students if m.result.mode == "reasoning"]
    main = max(reasoning or students, key=lambda m: m.run.started, default=None)
    lines = []
    if main is not None:
        lines.append(_describe_student(main, students, by_item))
        reasons = main.run.report.reasons.get(main.result.key)
        if reasons is not None:
            shares = {
                part: percent(summary.supported)
                for part, summary in reasons.parts.items()
                if summary.supported is not None
            }
            listed = ", ".join(f"{share} about the {part}" for part, share in shares.items())
            lines.append(
                f"Of its claims, the oracle supports {listed}. The answer is right and its reasons "
                f"are true in {percent(reasons.true)} of its responses."
                if listed
                else "Its responses make no claims that the oracle can check."
            )
    lines += _describe_retriever(retrievals)
    return "\n".join(lines)


def percent(interval: Interval) -> str:
    value, low, high = (100 * x for x in (interval.value, interval.low, interval.high))
    return f"{value:.1f}% [{low:.1f}, {high:.1f}]"


def _describe_student(
    main: Measurement, students: Sequence[Measurement], by_item: ItemResults
) -> str:
    """Return the accuracy of a student, beside students that answer at once and the best baseline
    that does not predict."""
    beside = [f"chance {CHANCE:.0f}%"]
    for m in students:
        if m is not main and m.group == main.group and m.regime == "answer_only":
            beside.append(f"{m.label}, trained on answers alone, {percent(m.result.micro)}")
    rules = [r for r in by_item.baselines.get(main.group, []) if r.name != BASELINES["velocity"]]
    if rules:
        best = max(rules, key=lambda rule: rule.micro.value)
        beside.append(f"best rule without prediction, {best.name}, {percent(best.micro)}")
    return (
        f"{main.label} is right in {percent(main.result.micro)} of {main.result.n:,} unseen items "
        f"of {main.group} ({'; '.join(beside)})."
    )


def _describe_retriever(retrievals: Sequence[Measurement]) -> Iterator[str]:
    widest = [m for m in widest_results(retrievals) if isinstance(m.result, RetrievalResult)]
    for m in (m for m in widest if m.trained):
        same = [w for w in widest if w.item_set == m.item_set and not w.trained]
        beside = "".join(f"; {w.name} {100 * w.result.recall_10.value:.1f}%" for w in same)
        twin = m.result.measures.get(TWIN_ABOVE)
        above = f" It ranks the factual scene's frame higher in {percent(twin)}." if twin else ""
        yield (
            f"{m.name} finds the {m.result.pool} frame among the first 10 of {m.result.frames:,} "
            f"in {percent(m.result.recall_10)} of {m.result.queries:,} queries{beside}.{above}"
        )
