"""The report of evaluation.select: report.txt, report.json and selection.png."""

from __future__ import annotations

import json
import logging
from collections import Counter
from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

from conf.runs import write_text
from conf.schema import SelectCommand
from data.records import SelectionItem
from data.tracks.controls import MATCHED_ANCHOR
from evaluation.generators.response_log import Answer
from evaluation.metrics.breakdown import accuracy_by_subtype, selection_row
from evaluation.metrics.calibration import Calibration, measure_calibration, measure_position_bias
from evaluation.metrics.significance import PairedComparison, compare_anchors, compare_runs
from evaluation.reporting import tables
from evaluation.reporting.figures import selection_figure
from evaluation.reporting.reference import SUITE

log = logging.getLogger(__name__)

Answers = dict[tuple[str, str | None], list[Answer]]
"""The answers to all items by mode and control."""


def write_report(
    answers: Answers,
    items: list[SelectionItem],
    name: str,
    benchmark: str,
    cfg: SelectCommand,
    folder: Path,
    provenance: dict[str, Any],
) -> dict[str, float]:
    """Write the report of the model `name` into `folder`.

    Args:
        provenance: Entries for report.json: the benchmark's build, and the keys of the log's lines.

    Returns:
        Accuracies and parse rates of each mode, under the control if there is one.
    """
    labels = {variant: variant_label(*variant) for variant in answers}
    by_label = {labels[variant]: of_variant for variant, of_variant in answers.items()}
    rows, metrics = [], {}
    for (mode, control), of_variant in answers.items():
        correct = [a.right for a in of_variant]
        parse_rate = sum(a.letter is not None for a in of_variant) / len(of_variant)
        settings = (cfg.seed, cfg.suite, control)
        row = selection_row(benchmark, name, mode, items, correct, parse_rate, *settings)
        rows.append(row)
        if control == cfg.control:
            metrics |= {f"{mode}_{f}": share.value for f, share in row.families.items()}
            metrics |= {f"{mode}_macro": row.macro, f"{mode}_micro": row.micro.value}
            metrics[f"{mode}_parse_rate"] = parse_rate
    letters = [item.letter for item in items]
    details = {
        "subtypes": {
            label: accuracy_by_subtype(items, [a.right for a in of_variant])
            for label, of_variant in by_label.items()
        },
        "readings": {label: count_readings(of_variant) for label, of_variant in by_label.items()},
        "positions": {
            label: measure_position_bias([a.letter for a in of_variant], letters)
            for label, of_variant in by_label.items()
        },
        "calibration": {
            label: calibration
            for label, of_variant in by_label.items()
            if (calibration := calibrate(of_variant))
        },
    }
    differences = compare_variants(answers, items, cfg)

    suite = items[0].suite
    labelled = [replace(r, mode=label) for r, label in zip(rows, by_label, strict=True)]
    parts = [tables.selection_table(labelled, suite)]
    parts += [tables.paired_table(differences)] if differences else []
    log.info("%s", "\n\n".join(map(str, parts)))
    parts += tables.detail_tables(*details.values())
    write_text(folder / "report.txt", "\n\n".join(map(str, parts)) + "\n")
    report = {
        **provenance,
        "rows": [row.to_dict() for row in rows],
        "controls": [{"mode": label, **asdict(p)} for label, pairs in differences for p in pairs],
        **details,
    }
    write_text(folder / "report.json", json.dumps(report, indent=1, default=asdict))
    selection_figure(labelled, folder / "selection.png", suite == SUITE)
    return metrics


def variant_label(mode: str, control: str | None) -> str:
    return mode if control is None else f"{mode}, {control}"


def count_readings(answers: list[Answer]) -> dict[str, int]:
    """Counts of parsed answers, of valid records among them if records were requested, and of the
    reasons why the other answers could not be parsed."""
    counts = {"with a letter": sum(a.letter is not None for a in answers)}
    if answers[0].valid is not None:
        counts["  in a valid record"] = sum(a.valid for a in answers)
    reasons = Counter(f"without: {a.reason}" for a in answers if a.letter is None)
    return counts | dict(reasons.most_common())


def calibrate(answers: list[Answer]) -> Calibration | None:
    """The calibration of the confidence in valid records; None without any."""
    return measure_calibration(
        [a.record.confidence for a in answers if a.valid], [a.right for a in answers if a.valid]
    )


def compare_variants(
    answers: Answers, items: list[SelectionItem], cfg: SelectCommand
) -> list[tuple[str, list[PairedComparison]]]:
    """By label: the unchanged items less the items under the control, and in matched-anchor pairs
    the questions of the event less those of the time."""
    credits = {
        variant: {a.item_id: float(a.right) for a in of_variant}
        for variant, of_variant in answers.items()
    }
    differences = []
    for (mode, control), own in credits.items():
        if control is not None:
            names = ("unchanged", control)
            pairs = compare_runs(items, credits[mode, None], own, names, cfg.seed)
            differences.append((mode, pairs))
        if cfg.suite == MATCHED_ANCHOR:
            anchors = compare_anchors(items, own, cfg.seed)
            differences.append((variant_label(mode, control), anchors))
    return differences
