"""What the report tells, section by section: tables in the paper's shape and figures, out of
finished runs."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from evaluation.metrics.calibration import Calibration, PositionBias
from evaluation.metrics.intervals import Interval
from evaluation.metrics.significance import PairedComparison
from evaluation.reporting import figures, plots, tables
from evaluation.reporting import paper_tables as shaped
from evaluation.reporting import reference as paper
from evaluation.reporting.measurements import Measured, by_items, model_names, transfers, widest
from evaluation.reporting.paper_tables import ABLATED, REGIMES
from evaluation.reporting.runs import STUDIES, TRAININGS, Finished, json_lines, unreadable
from evaluation.reporting.table import Table
from train.common.curves import curves_figure


@dataclass(frozen=True)
class Figure:
    """A drawn figure in an SVG file, and what it shows."""

    path: Path
    caption: str


@dataclass
class Section:
    """A part of the report. `details` are tables that the page folds away and that the text leaves
    out."""

    title: str
    tables: list[Table] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    details: list[Table] = field(default_factory=list)


def sections_of(
    choices: Sequence[Measured],
    ranks: Sequence[Measured],
    runs: Sequence[Finished],
    confusions: Mapping[str, Mapping[str, np.ndarray]],
    apart: Mapping[str, Sequence[Sequence[PairedComparison]]],
    folder: Path,
) -> list[Section]:
    """Every section that has a table, in the paper's order.

    Args:
        choices, ranks: the selection and the retrieval rows of `runs`.
        confusions: by benchmark and model, as `plots.confusion` counts.
        apart: by benchmark, what pairs of models are apart.
        folder: where figures are drawn.
    """
    plain = [m for m in choices if not m.ways]
    every = [m for m in ranks if m.row.builder is None]
    found = [
        zero_shot(plain, every, [run for run in runs if run.kind in STUDIES], folder),
        distillation(plain, every, apart, folder),
        ablation(plain),
        transfer(plain, apart, folder),
        controls([m for m in choices if m.ways], runs),
        *(study(run) for run in runs if run.kind in STUDIES),
        choices_in_detail(plain, confusions, folder),
        rankings_in_detail(every, folder),
        training([run for run in runs if run.kind in TRAININGS], folder),
    ]
    return [s for s in found if s.tables or s.figures or s.details]


def zero_shot(
    choices: Sequence[Measured],
    ranks: Sequence[Measured],
    studies: Sequence[Finished],
    folder: Path,
) -> Section:
    section = Section("Zero-shot")
    abroad = transfers(choices)
    for benchmark, rows in by_items(m for m in choices if not m.trained).items():
        if benchmark not in abroad:
            of = (benchmark, rows[0].run.report.get("build"))
            asked = [s for s in studies if (s.report.get("benchmark"), s.report.get("build")) == of]
            section.tables.append(shaped.selection_zero_shot(benchmark, rows, asked))
            section.figures.append(_families(folder, "zero-shot", rows, True))
    for benchmark, rows in by_items(m for m in ranks if not m.trained).items():
        section.tables.append(shaped.retrieval_zero_shot(benchmark, widest(rows)))
    return section


def distillation(
    choices: Sequence[Measured],
    ranks: Sequence[Measured],
    apart: Mapping[str, Sequence[Sequence[PairedComparison]]],
    folder: Path,
) -> Section:
    section = Section("Distillation")
    abroad = transfers(choices)
    for benchmark, rows in by_items(choices).items():
        if benchmark not in abroad and any(m.trained for m in rows):
            section.tables.append(shaped.selection_distilled(benchmark, rows))
            section.figures.append(_families(folder, "families", rows, True))
            _add_apart(section, benchmark, apart)
    for benchmark, rows in by_items(ranks).items():
        if any(m.trained for m in rows):
            section.tables.append(shaped.retrieval_distilled(benchmark, widest(rows)))
        runs = {m.run.folder: m.run for m in rows if m.trained}
        names = Counter(of["left"] for run in runs.values() for of in _widest_apart(run))
        told = [
            of if names[of["left"]] == 1 else {**of, "left": f"{of['left']}, {run.name}"}
            for run in runs.values()
            for of in run.report.get("apart", [])
        ]
        if told:
            section.tables.append(_renamed(tables.rank_differences_table(told), benchmark))
    return section


def _widest_apart(run: Finished) -> list[dict[str, Any]]:
    """Of what a run's retrievers are apart, what they are at the widest width."""
    return run.report.get("apart", [])[:1]


def ablation(choices: Sequence[Measured]) -> Section:
    """The regimes of chain of thought beside each other, in reasoning mode."""
    told = [m for m in choices if m.row.mode == "reasoning" and m.regime in REGIMES]
    if not any(m.regime in ABLATED for m in told):
        return Section("Ablation")
    told.sort(key=lambda m: list(REGIMES).index(m.regime))
    names = zip(told, model_names(told), strict=True)
    labels = [f"{REGIMES[m.regime]} ({name})" for m, name in names]
    caption = "Ablation: accuracy over all items (%) in reasoning mode"
    reference = {"paper, Table 12": paper.ABLATION}
    return Section("Ablation", [shaped.overall_table("ablation", caption, told, labels, reference)])


def transfer(
    choices: Sequence[Measured],
    apart: Mapping[str, Sequence[Sequence[PairedComparison]]],
    folder: Path,
) -> Section:
    """Students on benchmarks that they were not trained on, and the models that they began from."""
    section = Section("Transfer")
    if not (abroad := transfers(choices)):
        return section
    travelled = {(m.model, m.row.mode) for m in choices if m.benchmark in abroad}
    told = [m for m in choices if (m.model, m.row.mode) in travelled]
    names = zip(told, model_names(told), strict=True)
    labels = [f"{name} ({m.row.mode})" for m, name in names]
    caption = "Transfer: accuracy over all items (%)"
    reference = {"paper, Section 5.3 (answer mode)": paper.TRANSFER}
    section.tables.append(shaped.overall_table("transfer", caption, told, labels, reference))
    for benchmark, rows in by_items(choices).items():
        if benchmark in abroad:
            section.tables.append(shaped.selection_transfer(benchmark, rows))
            # The paper's figures by family are of CLEVRER.
            section.figures.append(_families(folder, "families", rows, False))
            _add_apart(section, benchmark, apart)
    return section


def _add_apart(
    section: Section, benchmark: str, apart: Mapping[str, Sequence[Sequence[PairedComparison]]]
) -> None:
    """Add what the benchmark's models are apart, and folded away the same by family."""
    if found := apart.get(benchmark):
        section.tables.append(_renamed(tables.apart_table(found), benchmark))
        by_family = tables.paired_table([(benchmark, of) for of in found])
        section.details.append(_renamed(by_family, benchmark))


def controls(choices: Sequence[Measured], runs: Sequence[Finished]) -> Section:
    """What controls are apart from what they are held against, and the controls' own rows.

    Raises:
        UserError: what a run reports is of another version.
    """
    section = Section("Controls")
    apart: dict[tuple[Path, str, str, str], list[PairedComparison]] = {}
    for run in runs:
        for told in run.report.get("controls", []):
            try:
                pair = PairedComparison(
                    **{key: value for key, value in told.items() if key != "mode"}
                )
                ways = [told["mode"]] if run.kind == "similarity" else [_model(run), told["mode"]]
            except (KeyError, TypeError) as error:
                raise unreadable(run.folder) from error
            way = ", ".join([run.report["rows"][0]["benchmark"], *ways])
            apart.setdefault((run.folder, way, pair.left, pair.right), []).append(pair)
    if apart:
        ways = Counter(key[1:] for key in apart)
        table = tables.paired_table(
            [
                (way if ways[way, left, right] == 1 else f"{way}, {folder.name}", of)
                for (folder, way, left, right), of in apart.items()
            ]
        )
        caption = "Controls: paired differences of accuracy (%)"
        section.tables.append(replace(table, name="controls", caption=caption))
    for benchmark, rows in by_items(choices).items():
        name = f"control-{benchmark.replace(', ', '-')}"
        caption = f"Controls: selection accuracy (%) on {benchmark}"
        section.tables.append(shaped.selection_trained(name, caption, rows, {}))
    return section


def _model(run: Finished) -> str:
    return run.report["rows"][0]["name"]


def study(run: Finished) -> Section:
    """
    Raises:
        UserError: what the study exported is of another version.
    """
    try:
        table = tables.human_table(run.report)
        caption = f"{table.caption}: study {run.name} on benchmark {run.report['benchmark']}"
    except (KeyError, TypeError) as error:
        raise unreadable(run.folder) from error
    name = f"human-{run.name.replace('/', '-')}"
    return Section("Human study", [replace(table, name=name, caption=caption)])


def choices_in_detail(
    choices: Sequence[Measured], confusions: Mapping[str, Mapping[str, np.ndarray]], folder: Path
) -> Section:
    """
    Raises:
        UserError: what a run reports is of another version.
    """
    section = Section("Selection in detail")
    abroad = transfers(choices)
    for benchmark, rows in by_items(choices).items():
        cells = _told(rows, "subtypes", _intervals)
        horizons = {label: by for label, of in cells.items() if (by := plots.by_horizon(of))}
        if horizons:
            draw = partial(plots.horizon_figure, reference=rows[0].benchmark not in abroad)
            drawn = _draw(folder, f"horizons-{benchmark}", draw, horizons)
            section.figures.append(Figure(drawn, f"Accuracy by horizon on {benchmark}."))
        if found := confusions.get(benchmark):
            drawn = _draw(folder, f"positions-{benchmark}", plots.confusion_figure, found)
            caption = f"What was chosen where each letter was right, on {benchmark} (% of a row)."
            section.figures.append(Figure(drawn, caption))
        section.details += [_renamed(table, benchmark) for table in _details(rows, cells)]
    return section


def _intervals(told: Mapping[str, Any]) -> dict[str, Interval]:
    return {cell: Interval(**found) for cell, found in told.items()}


def _details(rows: Sequence[Measured], cells: Mapping[str, Mapping[str, Interval]]) -> list[Table]:
    """The tables of what runs report of their models besides their rows."""
    readings = _told(rows, "readings", dict)
    letters = _told(rows, "positions", lambda of: PositionBias(**of))
    sure = _told(rows, "calibration", Calibration.from_dict)
    told = [tables.subtype_table(cells)] if cells else []
    told += [tables.parsing_table(readings)] if readings else []
    told += [tables.position_table(letters)] if letters else []
    for k, (label, found) in enumerate(sure.items()):
        table = tables.calibration_table(label, found)
        told.append(replace(table, name=f"{table.name}-{k}"))
    return told


T = TypeVar("T")


def _told(rows: Sequence[Measured], kind: str, read: Callable[[Any], T]) -> dict[str, T]:
    """What runs report of one kind, by the label of the model; where they report of it."""
    found = {}
    for m in rows:
        try:
            if told := m.told(kind):
                found[m.label] = read(told)
        except (KeyError, TypeError, ValueError, AttributeError) as error:
            raise unreadable(m.run.folder) from error
    return found


def rankings_in_detail(ranks: Sequence[Measured], folder: Path) -> Section:
    section = Section("Retrieval in detail")
    for benchmark, rows in by_items(ranks).items():
        of_all = [m.row for m in rows]
        section.tables.append(_renamed(tables.cost_table(of_all), benchmark))
        section.details.append(_renamed(tables.retrieval_table(of_all), benchmark, "widths"))
        if any(row.width for row in of_all):
            drawn = _draw(folder, f"widths-{benchmark}", figures.retrieval_figure, of_all)
            section.figures.append(Figure(drawn, f"Recall by width on {benchmark}."))
        curves = {
            (m.row.name, m.run.folder): {**curve, "name": m.row.name}
            for m in rows
            for curve in m.run.report.get("curves", [])
            if curve["builder"] is None and curve["name"] == m.model
        }
        if curves:
            drawn = _draw(folder, f"recall-{benchmark}", plots.recall_figure, [*curves.values()])
            section.figures.append(Figure(drawn, f"Recall by k on {benchmark}, at the widest."))
    return section


def training(runs: Sequence[Finished], folder: Path) -> Section:
    section = Section("Training")
    if table := shaped.training_table(runs):
        section.tables.append(table)
    for run in runs:
        if records := [*json_lines(run.folder / "metrics.jsonl")]:
            name = f"{run.kind}-{run.name.replace('/', '-')}"
            drawn = _draw(folder, f"training-{name}", curves_figure, records)
            section.figures.append(Figure(drawn, f"Training of {run.kind}/{run.name}."))
    return section


def _renamed(table: Table, benchmark: str, name: str | None = None) -> Table:
    caption = f"{table.caption}, on {benchmark}"
    return replace(table, name=f"{name or table.name}-{benchmark}", caption=caption)


def _families(folder: Path, name: str, rows: Sequence[Measured], reference: bool) -> Figure:
    benchmark, shown = rows[0].items, [m.row for m in rows]
    draw = partial(figures.selection_figure, reference=reference)
    drawn = _draw(folder, f"{name}-{benchmark}", draw, shown)
    return Figure(drawn, f"Accuracy by family on {benchmark}, with 95% intervals.")


def _draw(folder: Path, name: str, draw: Callable[..., None], what: Any) -> Path:
    """An SVG file with its text as text, the same for the same figure."""
    import matplotlib

    folder.mkdir(exist_ok=True)
    path = folder / f"{name}.svg"
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        draw(what, path)
    return path
