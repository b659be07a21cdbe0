"""The report of evaluation.select and evaluation.similarity: report.txt, report.json and
selection.png."""

from __future__ import annotations

import json
import logging
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

from conf.runs import write_text
from data.records import SelectionItem
from data.tracks.controls import MATCHED_ANCHOR
from evaluation.generators.response_log import Answer
from evaluation.metrics.accuracy import accuracy_by_group
from evaluation.metrics.calibration import Calibration, measure_calibration, measure_position_bias
from evaluation.metrics.results import SelectionResult, selection_result
from evaluation.metrics.significance import PairedComparison, compare_anchors, compare_runs
from evaluation.reporting import tables
from evaluation.reporting.figures import accuracy_figure
from evaluation.reporting.reference import SUITE

log = logging.getLogger(__name__)


@dataclass(frozen=True)
class Choices:
    """The choices of a model on all items, in one mode and under one control.

    Attributes:
        credits: 1 for a correct choice, 1/m for a tie among m candidates, 0 for others.
        letters: The chosen letters; None without one.
        answers: The parsed answers; empty for a retriever.
    """

    name: str
    mode: str
    control: str | None
    credits: Sequence[float]
    letters: Sequence[str | None]
    answers: Sequence[Answer] = ()

    @classmethod
    def from_answers(
        cls, name: str, mode: str, control: str | None, answers: Sequence[Answer]
    ) -> Choices:
        credits = [float(answer.right) for answer in answers]
        return cls(name, mode, control, credits, [a.letter for a in answers], answers)

    @property
    def parse_rate(self) -> float | None:
        if not self.answers:
            return None
        return sum(letter is not None for letter in self.letters) / len(self.letters)


def write_report(
    choices: Sequence[Choices],
    items: Sequence[SelectionItem],
    benchmark: str,
    seed: int,
    folder: Path,
    suite: str | None = None,
    **provenance: Any,
) -> list[SelectionResult]:
    """Write a report into `folder`, and return the result of each of `choices`.

    Args:
        seed: Seed of the bootstrap over scenes.
        suite: As in `SelectCommand`.
        provenance: Entries for report.json: the benchmark's build, and the keys of the log's lines.
    """
    results = [
        selection_result(
            benchmark, c.name, c.mode, items, c.credits, c.parse_rate, seed, suite, c.control
        )
        for c in choices
    ]
    by_key = {result.key: c for result, c in zip(results, choices, strict=True)}
    subtypes, letters = [f"{i.family}/{i.subtype}" for i in items], [i.letter for i in items]
    calibrations = {key: _calibrate(c.answers) for key, c in by_key.items()}
    details = {
        "subtypes": {key: accuracy_by_group(subtypes, c.credits) for key, c in by_key.items()},
        "readings": {key: count_readings(c.answers) for key, c in by_key.items() if c.answers},
        "positions": {key: measure_position_bias(c.letters, letters) for key, c in by_key.items()},
        "calibration": {key: of for key, of in calibrations.items() if of},
    }
    differences = _compare(by_key, items, seed)

    parts = [tables.selection_table(results, items[0].suite)]
    parts += [tables.paired_table(differences)] if differences else []
    log.info("%s", "\n\n".join(map(str, parts)))
    parts += tables.detail_tables(*details.values())
    write_text(folder / "report.txt", "\n\n".join(map(str, parts)) + "\n")
    controls = [{"mode": label, **asdict(p)} for label, pairs in differences for p in pairs]
    report = {**provenance, "rows": results, "controls": controls, **details}
    write_text(folder / "report.json", json.dumps(report, indent=1, default=asdict))
    shares = {f"{r.name} ({r.variant})": r.families for r in results}
    accuracy_figure(shares, folder / "selection.png", items[0].suite == SUITE)
    return results


def count_readings(answers: Sequence[Answer]) -> dict[str, int]:
    """Counts of parsed answers, of valid records among them if records were requested, and of the
    reasons why the other answers could not be parsed."""
    counts = {"with a letter": sum(a.letter is not None for a in answers)}
    if answers[0].valid is not None:
        counts["  in a valid record"] = sum(a.valid for a in answers)
    reasons = Counter(f"without: {a.reason}" for a in answers if a.letter is None)
    return counts | dict(reasons.most_common())


def _calibrate(answers: Sequence[Answer]) -> Calibration | None:
    """The calibration of the confidence in valid records; None without any."""
    valid = [answer for answer in answers if answer.valid]
    return measure_calibration([a.record.confidence for a in valid], [a.right for a in valid])


def _compare(
    choices: Mapping[str, Choices], items: Sequence[SelectionItem], seed: int
) -> list[tuple[str, list[PairedComparison]]]:
    """By label: the unchanged items less the items under the control, and in matched-anchor pairs
    the questions of the event less those of the time."""
    ids = [item.item_id for item in items]
    credits = {key: dict(zip(ids, c.credits, strict=True)) for key, c in choices.items()}
    differences = []
    for key, c in choices.items():
        if c.control is not None:
            pair, names = (credits[c.mode], credits[key]), ("unchanged", c.control)
            differences.append((c.mode, compare_runs(items, *pair, names, seed)))
        if items[0].suite == MATCHED_ANCHOR:
            differences.append((key, compare_anchors(items, credits[key], seed)))
    return differences
