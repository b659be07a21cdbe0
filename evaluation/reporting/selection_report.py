"""What a model's answers to selection items come to: rows, tables and a figure."""

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
from evaluation.reporting import figures, tables
from evaluation.reporting import reference as paper

log = logging.getLogger(__name__)

Given = dict[tuple[str, str | None], list[Answer]]
"""The answers to all items, by the mode and the control in which they were asked."""


def write_report(
    given: Given,
    items: list[SelectionItem],
    name: str,
    benchmark: str,
    cfg: SelectCommand,
    folder: Path,
    about: dict[str, Any],
) -> dict[str, float]:
    """Write report.txt, report.json and selection.png of the model called `name` into `folder`.
    `about` says in the report of which build of the benchmark, and of which lines of the answers'
    file, its numbers are.

    Returns:
        The accuracies and parse rates of each mode, under the control if there is one.
    """
    rows, metrics, told = [], {}, {}
    for (mode, control), said in given.items():
        right = [a.right for a in said]
        parsed = sum(a.letter is not None for a in said) / len(said)
        asked = (cfg.seed, cfg.suite, control)
        row = selection_row(benchmark, name, mode, items, right, parsed, *asked)
        rows.append(row)
        told[way(mode, control)] = said
        if control == cfg.control:
            metrics |= {f"{mode}_{f}": found.value for f, found in row.families.items()}
            metrics |= {f"{mode}_macro": row.macro, f"{mode}_micro": row.micro.value}
            metrics[f"{mode}_parse_rate"] = parsed
    subtypes = {w: accuracy_by_subtype(items, [a.right for a in said]) for w, said in told.items()}
    truth = [i.letter for i in items]
    letters = {
        w: measure_position_bias([a.letter for a in said], truth) for w, said in told.items()
    }
    reasons = {w: readings(said) for w, said in told.items()}
    confidences = {w: found for w, said in told.items() if (found := reported(said))}
    apart = differences(given, items, cfg)

    suite = items[0].suite
    named = [replace(row, mode=w) for row, w in zip(rows, told, strict=True)]
    parts = [tables.selection_table(named, suite), *([tables.paired_table(apart)] if apart else [])]
    log.info("%s", "\n\n".join(map(str, parts)))
    parts += [tables.subtype_table(subtypes), tables.parsing_table(reasons)]
    parts += [tables.position_table(letters)]
    parts += [tables.calibration_table(w, found) for w, found in confidences.items()]
    write_text(folder / "report.txt", "\n\n".join(map(str, parts)) + "\n")
    report = {
        **about,
        "rows": [r.to_dict() for r in rows],
        "controls": [{"mode": w, **asdict(p)} for w, found in apart for p in found],
        "subtypes": {w: {c: vars(i) for c, i in by.items()} for w, by in subtypes.items()},
        "readings": reasons,
        "positions": {w: asdict(found) for w, found in letters.items()},
        "calibration": {w: asdict(found) for w, found in confidences.items()},
    }
    write_text(folder / "report.json", json.dumps(report, indent=1))
    figures.selection_figure(named, folder / "selection.png", suite == paper.SUITE)
    return metrics


def way(mode: str, control: str | None) -> str:
    """How items were asked, for a table."""
    return mode if control is None else f"{mode}, {control}"


def readings(given: list[Answer]) -> dict[str, int]:
    """How many answers could be read, how many of them are or hold a valid record where one was
    asked for, and why the others could not."""
    counts = {"with a letter": sum(a.letter is not None for a in given)}
    if given[0].valid is not None:
        counts["  in a valid record"] = sum(a.valid for a in given)
    reasons = Counter(f"without: {a.reason}" for a in given if a.letter is None)
    return counts | dict(reasons.most_common())


def reported(given: list[Answer]) -> Calibration | None:
    """How the confidence of valid records goes with what is right."""
    return measure_calibration(
        [a.record.confidence for a in given if a.valid], [a.right for a in given if a.valid]
    )


def differences(
    given: Given, items: list[SelectionItem], cfg: SelectCommand
) -> list[tuple[str, list[PairedComparison]]]:
    """By how the items were asked: what they were answered as they are less what they were under a
    control, and what the event's questions of matched-anchor pairs were less the time's."""
    credits = {asked: {a.item_id: float(a.right) for a in said} for asked, said in given.items()}
    found = []
    for (mode, control), own in credits.items():
        if control is not None:
            names = ("as they are", control)
            found.append((mode, compare_runs(items, credits[mode, None], own, names, cfg.seed)))
        if cfg.suite == MATCHED_ANCHOR:
            found.append((way(mode, control), compare_anchors(items, own, cfg.seed)))
    return found
