"""The sections of the report: tables in the paper's shape, and figures."""

from __future__ import annotations

import io
import json
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

from conf.multirun.table import AT_START_SUFFIX
from conf.runs import read_json_lines
from evaluation.metrics.calibration import Calibration, PositionBias
from evaluation.metrics.intervals import Interval
from evaluation.metrics.results import RetrieverDifference, from_json
from evaluation.metrics.significance import PairedComparison
from evaluation.reporting import figures, tables
from evaluation.reporting.item_browser import ItemBrowser
from evaluation.reporting.measurements import (
    ABLATED_REGIMES,
    REGIMES,
    Measurement,
    group_by_items,
    shared_names,
    transfer_benchmarks,
    widest_results,
)
from evaluation.reporting.runs import (
    STUDY_KINDS,
    TRAINING_KINDS,
    FinishedRun,
    reading,
)
from evaluation.reporting.summary_tables import overall_table, summary_table
from evaluation.reporting.table import Row, Table
from train.common.curves import plot_curves

Rows = Sequence[Measurement]


@dataclass(frozen=True)
class Figure:
    """A figure that is drawn on demand: `plot` writes the figure of `data` to a file."""

    name: str
    caption: str
    plot: Callable[[Any, Any], None]
    data: Any

    @cached_property
    def svg(self) -> str:
        """An SVG file with its text as text; equal data give equal figures."""
        import matplotlib

        file = io.BytesIO()
        style = {"savefig.format": "svg", "svg.fonttype": "none", "svg.hashsalt": self.name}
        with matplotlib.rc_context(style):
            self.plot(self.data, file)
        return file.getvalue().decode()


@dataclass
class Section:
    """A part of the report."""

    title: str
    tables: list[Table] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)


def build_sections(
    selections: Rows, retrievals: Rows, runs: Sequence[FinishedRun], browser: ItemBrowser
) -> list[Section]:
    """The sections that have content, in the paper's order.

    Args:
        selections, retrievals: The results of `runs`.

    Raises:
        UserError: a report is damaged or of another version.
    """
    unchanged = [m for m in selections if not m.variants]
    transfers = transfer_benchmarks(unchanged)
    at_home = [m for m in unchanged if m.row.benchmark not in transfers]
    studies = [run for run in runs if run.kind in STUDY_KINDS]
    widest = widest_results(retrievals)
    sections = [
        zero_shot([m for m in at_home if not m.trained], widest, studies),
        distillation(at_home, widest, browser),
        ablation(unchanged),
        transfer(unchanged, transfers, browser),
        controls([m for m in selections if m.variants], runs),
        Section("Human study", [_study_table(study) for study in studies]),
        selection_details(unchanged, transfers, browser),
        retrieval_details([m for m in retrievals if m.row.builder is None]),
        training([run for run in runs if run.kind in TRAINING_KINDS]),
    ]
    return [section for section in sections if section.tables or section.figures]


def zero_shot(selections: Rows, retrievals: Rows, studies: Sequence[FinishedRun]) -> Section:
    section = Section("Zero-shot")
    for rows in group_by_items(selections).values():
        people = [row for study in studies for row in _majority_rows(study, rows[0])]
        section.tables.append(summary_table("selection", rows, people))
        section.figures.append(_family_figure("zero-shot", rows))
    for rows in group_by_items(m for m in retrievals if not m.trained).values():
        section.tables.append(summary_table("retrieval", rows))
    return section


def _majority_rows(study: FinishedRun, m: Measurement) -> list[Row]:
    """The majority vote of a study of the build that is measured."""
    with reading(study.folder):
        build = (study.report["benchmark"], study.report.get("build"))
        votes = study.report["majority"]
        if votes is None or build != (m.row.benchmark, m.run.report["build"]):
            return []
        return [tables.human_row(f"Majority vote, {study.name}", votes)]


def distillation(selections: Rows, retrievals: Rows, browser: ItemBrowser) -> Section:
    section = Section("Distillation")
    for benchmark, rows in group_by_items(selections).items():
        if any(m.trained for m in rows):
            section.tables.append(summary_table("distillation-selection", rows))
            section.figures.append(_family_figure("families", rows))
            section.tables += _model_differences(benchmark, browser)
    for rows in group_by_items(retrievals).values():
        if trained := {m.run.folder: m.run for m in rows if m.trained}:
            section.tables.append(summary_table("distillation-retrieval", rows))
        for run in trained.values():
            with reading(run.folder):
                reported = run.report.get("differences", [])
                differences = from_json(list[RetrieverDifference], reported)
            if differences:
                table = tables.rank_differences_table(differences)
                section.tables.append(_name_table(table, run.title))
    return section


def ablation(selections: Rows) -> Section:
    """The regimes with rationales, in reasoning mode."""
    rows = [m for m in selections if m.row.mode == "reasoning" and m.regime in REGIMES]
    if not any(m.regime in ABLATED_REGIMES for m in rows):
        return Section("Ablation")
    rows.sort(key=lambda m: list(REGIMES).index(m.regime))
    names = zip(rows, shared_names(rows), strict=True)
    labels = [f"{REGIMES[m.regime]} ({name})" for m, name in names]
    return Section("Ablation", [overall_table("ablation", rows, labels)])


def transfer(selections: Rows, transfers: Container[str], browser: ItemBrowser) -> Section:
    """Students on benchmarks that they were not trained on, and their bases."""
    section = Section("Transfer")
    models = {(m.row.name, m.row.mode) for m in selections if m.row.benchmark in transfers}
    if of_models := [m for m in selections if (m.row.name, m.row.mode) in models]:
        names = zip(of_models, shared_names(of_models), strict=True)
        labels = [f"{name} ({m.row.mode})" for m, name in names]
        section.tables.append(overall_table("transfer", of_models, labels))
    for benchmark, rows in group_by_items(selections).items():
        if benchmark in transfers:
            section.tables.append(summary_table("transfer-selection", rows))
            # The paper's accuracies by family are on CLEVRER.
            section.figures.append(_family_figure("families", rows, with_paper=False))
            section.tables += _model_differences(benchmark, browser)
    return section


def _model_differences(benchmark: str, browser: ItemBrowser) -> list[Table]:
    """The differences between the benchmark's models, overall and, folded, by family."""
    comparisons = browser.comparisons.get(benchmark)
    if not comparisons:
        return []
    overall = tables.paired_table([("", pairs[-1:]) for pairs in comparisons])
    by_family = tables.paired_table([("", pairs) for pairs in comparisons])
    caption = f"{by_family.caption} by family"
    return [
        _name_table(replace(overall, name="differences"), benchmark),
        _name_table(replace(by_family, caption=caption, folded=True), benchmark),
    ]


def controls(selections: Rows, runs: Sequence[FinishedRun]) -> Section:
    """The accuracies under controls, and their differences from the unchanged items.

    Raises:
        UserError: a report is of another version.
    """
    section = Section("Controls")
    for run in runs:
        groups: dict[tuple[str, ...], list[PairedComparison]] = {}
        with reading(run.folder):
            for entry in run.report.get("controls", []):
                pair = from_json(PairedComparison, entry)
                groups.setdefault((entry["mode"], pair.left, pair.right), []).append(pair)
        if groups:
            table = tables.paired_table([(mode, of) for (mode, *_), of in groups.items()])
            section.tables.append(_name_table(table, run.title))
    section.tables += [
        summary_table("control", rows) for rows in group_by_items(selections).values()
    ]
    return section


def _study_table(run: FinishedRun) -> Table:
    """
    Raises:
        UserError: the study's report is of another version.
    """
    with reading(run.folder):
        title = f"study {run.name} on benchmark {run.report['benchmark']}"
        return _name_table(tables.human_table(run.report), run.name, title)


def selection_details(selections: Rows, transfers: Container[str], browser: ItemBrowser) -> Section:
    """
    Raises:
        UserError: a report is of another version.
    """
    section = Section("Selection in detail")
    for benchmark, rows in group_by_items(selections).items():
        if horizons := {m.label: m.row.horizons for m in rows if m.row.horizons}:
            plot = partial(figures.accuracy_figure, with_paper=benchmark not in transfers)
            caption = f"Accuracy by horizon on {benchmark}."
            section.figures.append(Figure(f"horizons-{benchmark}", caption, plot, horizons))
        if confusions := browser.confusions.get(benchmark):
            plot = figures.confusion_figure
            caption = f"Chosen letters by correct letter on {benchmark} (% of a row)."
            section.figures.append(Figure(f"positions-{benchmark}", caption, plot, confusions))
        details = tables.detail_tables(
            _read_details(rows, "subtypes", dict[str, Interval]),
            _read_details(rows, "readings", dict[str, int]),
            _read_details(rows, "positions", PositionBias),
            _read_details(rows, "calibration", Calibration),
        )
        section.tables += [_name_table(replace(t, folded=True), benchmark) for t in details]
    return section


def _read_details(rows: Rows, key: str, kind: Any) -> dict[str, Any]:
    """One kind of details from the rows' reports, by the label of the model."""
    details = {}
    for m in rows:
        with reading(m.run.folder):
            if entry := m.run.report.get(key, {}).get(m.row.key):
                details[m.label] = from_json(kind, entry)
    return details


def retrieval_details(retrievals: Rows) -> Section:
    section = Section("Retrieval in detail")
    for benchmark, rows in group_by_items(retrievals).items():
        ordered = sorted(rows, key=lambda m: (-(m.row.width or 0), not m.row.untrained))
        section.tables.append(replace(summary_table("widths", ordered), folded=True))
        if any(m.row.width for m in rows):
            plot, caption = figures.retrieval_figure, f"Recall by width on {benchmark}."
            results = [(m.name, m.row) for m in rows]
            section.figures.append(Figure(f"widths-{benchmark}", caption, plot, results))
        curves: dict[str, Any] = {}
        for m in rows:
            with reading(m.run.folder):
                for curve in m.run.report.get("curves", []):
                    if curve["name"] == m.row.name:
                        curves.setdefault(m.name, curve)
        if curves:
            caption = f"Recall by k on {benchmark}, at the largest width."
            plot = figures.recall_figure
            section.figures.append(Figure(f"recall-{benchmark}", caption, plot, curves))
    return section


def training(runs: Sequence[FinishedRun]) -> Section:
    """The metrics of each run on held-out training scenes, at its start and at its end.

    Raises:
        UserError: a run's metrics.json is damaged.
    """
    section, groups = Section("Training"), {}
    for run in runs:
        remedy = "delete it and run the command again, which writes it without training again"
        with reading(run.folder, "metrics.json", remedy):
            metrics = dict(json.loads((run.folder / "metrics.json").read_text()))
        groups[run.title] = [
            {
                "name": name.replace("_", " "), "End": f"{end:.3f}",
                "Start": f"{metrics[name + AT_START_SUFFIX]:.3f}",
            }
            for name, end in metrics.items()
            if name + AT_START_SUFFIX in metrics
        ]  # fmt: skip
        journal = run.folder / "metrics.jsonl"
        if journal.exists() and (records := [*read_json_lines(journal)]):
            name = f"training-{run.title.replace('/', '-')}"
            section.figures.append(Figure(name, f"Training of {run.title}.", plot_curves, records))
    if any(groups.values()):
        caption = "Training, on held-out scenes"
        section.tables.append(Table("training", caption, ["Start", "End"], groups))
    return section


def _name_table(table: Table, name: str, title: str = "") -> Table:
    """Name a table after what it is about, such as a benchmark or a run."""
    caption, suffix = f"{table.caption}: {title or name}", name.replace("/", "-")
    return replace(table, name=f"{table.name}-{suffix}", caption=caption)


def _family_figure(name: str, rows: Rows, with_paper: bool = True) -> Figure:
    plot = partial(figures.accuracy_figure, with_paper=with_paper)
    caption = f"Accuracy by family on {rows[0].items}, with 95% intervals."
    shares = {m.label: m.row.families for m in rows}
    return Figure(f"{name}-{rows[0].items}", caption, plot, shares)
