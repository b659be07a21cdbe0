"""The sections of the report: tables in the layout of the paper's tables, and figures."""

from __future__ import annotations

import io
from collections.abc import Callable, Container, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from typing import Any

from dynapix.data.checks.observer_curve import plot_observers
from dynapix.evaluation.reporting import figures, summary_tables, tables
from dynapix.evaluation.reporting.item_results import ItemResults
from dynapix.evaluation.reporting.measurements import (
    ABLATED_REGIMES,
    REGIMES,
    Measurement,
    group_by_item_set,
    transfer_benchmarks,
    widest_results,
)
from dynapix.evaluation.reporting.runs import (
    SELECTION_KINDS,
    STUDY_KINDS,
    TRAINING_KINDS,
    FinishedRun,
)
from dynapix.evaluation.reporting.table import Row, Table, file_stem
from dynapix.train.common.curves import plot_curves
from dynapix.train.common.journal import read_journal

Results = Sequence[Measurement]


@dataclass(frozen=True)
class Figure:
    """A figure, which `plot(data, file)` draws when `svg` is first read."""

    name: str
    caption: str
    plot: Callable[[Any, Any], None]
    data: Any

    @cached_property
    def svg(self) -> str:
        """The figure as SVG with selectable text. The same data give the same bytes."""
        import matplotlib

        file = io.BytesIO()
        style = {"savefig.format": "svg", "svg.fonttype": "none", "svg.hashsalt": self.name}
        with matplotlib.rc_context(style):
            self.plot(self.data, file)
        return file.getvalue().decode()


@dataclass
class Section:
    """A titled part of the report. One without tables and figures is left out."""

    title: str
    tables: list[Table] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)


def build_sections(
    selections: Results, retrievals: Results, runs: Sequence[FinishedRun], by_item: ItemResults
) -> list[Section]:
    """Return the sections that have tables or figures, in the order of the paper.

    Args:
        selections, retrievals: The results of `runs`, without repeated results.

    Raises:
        UserError: The report of a human study was written by another version.
    """
    unchanged = [m for m in selections if not m.variants]
    transfers = transfer_benchmarks(unchanged)
    in_domain = [m for m in unchanged if m.benchmark not in transfers]
    studies = [run for run in runs if run.kind in STUDY_KINDS]
    widest = widest_results(retrievals)
    sections = [
        build_zero_shot([m for m in in_domain if not m.trained], widest, studies, by_item),
        build_distillation(in_domain, widest, by_item),
        build_ablation(unchanged),
        build_transfer(unchanged, transfers, by_item),
        build_controls([m for m in selections if m.variants], runs),
        Section("Human study", [_study_table(study) for study in studies]),
        build_selection_details(unchanged, transfers, by_item),
        build_retrieval_details([m for m in retrievals if m.result.builder is None]),
        build_training([run for run in runs if run.kind in TRAINING_KINDS]),
    ]
    return [section for section in sections if section.tables or section.figures]


def build_zero_shot(
    selections: Results,
    retrievals: Results,
    studies: Sequence[FinishedRun],
    by_item: ItemResults,
) -> Section:
    """Released models, without any training by this project, and the votes of humans."""
    section = Section("Zero-shot")
    for rows in group_by_item_set(selections).values():
        people = [row for study in studies for row in _majority_rows(study, rows[0])]
        baselines = by_item.baselines.get(rows[0].group, [])
        observers = by_item.observers.get(rows[0].item_set, {})
        table = summary_tables.summary_table("selection", rows, people, baselines, observers)
        section.tables.append(table)
        section.figures.append(_family_figure("zero-shot", rows))
    for rows in group_by_item_set(m for m in retrievals if not m.trained).values():
        section.tables.append(summary_tables.summary_table("retrieval", rows))
    return section


def _majority_rows(study: FinishedRun, m: Measurement) -> list[Row]:
    """Return the row of a study's majority vote, or no row if `m` measured another build."""
    report = study.report
    build = (report.benchmark, report.build)
    if report.majority is None or build != (m.benchmark, m.run.report.build):
        return []
    return [tables.human_row(f"Majority vote, {study.name}", report.majority)]


def build_distillation(selections: Results, retrievals: Results, by_item: ItemResults) -> Section:
    """Trained models beside released models, on benchmarks that do not test transfer."""
    section = Section("Distillation")
    for rows in group_by_item_set(selections).values():
        if any(m.trained for m in rows):
            baselines = by_item.baselines.get(rows[0].group, [])
            observers = by_item.observers.get(rows[0].item_set, {})
            table = summary_tables.summary_table(
                "distillation-selection", rows, baselines=baselines, observers=observers
            )
            section.tables.append(table)
            section.figures.append(_family_figure("families", rows))
            section.tables += _model_differences(rows[0].group, by_item)
    for rows in group_by_item_set(retrievals).values():
        if trained := {m.run.folder: m.run for m in rows if m.trained}:
            section.tables.append(summary_tables.summary_table("distillation-retrieval", rows))
        for run in trained.values():
            if run.report.differences:
                table = tables.rank_differences_table(run.report.differences)
                section.tables.append(_name_table(table, run.title))
    return section


def build_ablation(selections: Results) -> Section:
    """The students of all regimes in reasoning mode, if an ablated student was measured."""
    rows = [m for m in selections if m.result.mode == "reasoning" and m.regime in REGIMES]
    if not any(m.regime in ABLATED_REGIMES for m in rows):
        return Section("Ablation")
    rows.sort(key=lambda m: list(REGIMES).index(m.regime))
    table = summary_tables.overall_table(
        "ablation", rows, lambda m: f"{REGIMES[m.regime]} ({m.name})"
    )
    return Section("Ablation", [table])


def build_transfer(selections: Results, transfers: Container[str], by_item: ItemResults) -> Section:
    """The models that were measured on transfer benchmarks: their accuracies on all benchmarks."""
    section = Section("Transfer")
    models = {(m.result.name, m.result.mode) for m in selections if m.benchmark in transfers}
    if measured := [m for m in selections if (m.result.name, m.result.mode) in models]:
        table = summary_tables.overall_table("transfer", measured, lambda m: m.label)
        section.tables.append(table)
    for rows in group_by_item_set(selections).values():
        if rows[0].benchmark in transfers:
            observers = by_item.observers.get(rows[0].item_set, {})
            table = summary_tables.summary_table("transfer-selection", rows, observers=observers)
            section.tables.append(table)
            # The paper's accuracies by family are on CLEVRER.
            section.figures.append(_family_figure("families", rows, with_paper=False))
            section.tables += _model_differences(rows[0].group, by_item)
    return section


def _model_differences(group: str, by_item: ItemResults) -> list[Table]:
    """Return the accuracies of trainings with several seeds, and the differences between models
    over all items and, in a folded table, by family."""
    seeded = summary_tables.seed_tables(*by_item.seeds.get(group, ([], {})), group)
    comparisons = by_item.comparisons.get(group)
    if not comparisons:
        return seeded
    overall = tables.paired_table(p for p in comparisons if p.of == "all")
    by_family = tables.paired_table(comparisons)
    caption = f"{by_family.caption} by family"
    return [
        *seeded,
        _name_table(replace(overall, name="differences"), group),
        _name_table(replace(by_family, caption=caption, folded=True), group),
    ]


def build_controls(selections: Results, runs: Sequence[FinishedRun]) -> Section:
    """The accuracies on other suites and under controls, and the paired differences."""
    compared = [run for run in runs if run.kind in SELECTION_KINDS and run.report.controls]
    differences = [_name_table(tables.paired_table(r.report.controls), r.title) for r in compared]
    differences += [
        _name_table(tables.pair_table(run.report.pairs), run.title)
        for run in runs
        if run.kind in SELECTION_KINDS and run.report.pairs
    ]
    groups = group_by_item_set(selections).values()
    accuracies = [summary_tables.summary_table("control", rows) for rows in groups]
    return Section("Controls", differences + accuracies)


def _study_table(run: FinishedRun) -> Table:
    title = f"study {run.name} on benchmark {run.report.benchmark}"
    return _name_table(tables.human_table(run.report), run.name, title)


def build_selection_details(
    selections: Results, transfers: Container[str], by_item: ItemResults
) -> Section:
    section = Section("Selection in detail")
    for benchmark, rows in group_by_item_set(selections).items():
        if horizons := {m.label: m.result.horizons for m in rows if m.result.horizons}:
            plot = partial(figures.plot_accuracies, with_paper=rows[0].benchmark not in transfers)
            caption = f"Accuracy by horizon on {benchmark}."
            section.figures.append(
                Figure(file_stem(f"horizons-{benchmark}"), caption, plot, horizons)
            )
        if curves := by_item.observers.get(benchmark):
            plot = partial(plot_observers, models={m.label: m.result.micro for m in rows})
            caption = f"Accuracy of models and of observers, by their error, on {benchmark}."
            name = file_stem(f"observer-{benchmark}")
            section.figures.append(Figure(name, caption, plot, curves))
        if split := by_item.future_moment.get(benchmark):
            section.tables.append(_name_table(tables.future_moment_table(split), benchmark))
        details = tables.detail_tables({m.label: (m.result.key, m.run.report) for m in rows})
        section.tables += [_name_table(replace(t, folded=True), benchmark) for t in details]
    return section


def build_retrieval_details(retrievals: Results) -> Section:
    section = Section("Retrieval in detail")
    for benchmark, rows in group_by_item_set(retrievals).items():
        ordered = sorted(rows, key=lambda m: (-(m.result.width or 0), not m.result.untrained))
        section.tables.append(replace(summary_tables.summary_table("widths", ordered), folded=True))
        if any(m.result.width for m in rows):
            plot, caption = figures.plot_recalls, f"Recall by width on {benchmark}."
            results = [(m.name, m.result) for m in rows]
            section.figures.append(Figure(file_stem(f"widths-{benchmark}"), caption, plot, results))
    return section


def build_training(runs: Sequence[FinishedRun]) -> Section:
    """The curves of the training loss, and of the measures on held-out scenes."""
    section = Section("Training")
    for run in runs:
        if records := read_journal(run.folder):
            name = f"training-{run.title.replace('/', '-')}"
            section.figures.append(Figure(name, f"Training of {run.title}.", plot_curves, records))
    return section


def _name_table(table: Table, name: str, title: str = "") -> Table:
    """Append a name to the table's name, and `title` (or else the name) to its caption."""
    caption, suffix = f"{table.caption}: {title or name}", file_stem(name)
    return replace(table, name=f"{table.name}-{suffix}", caption=caption)


def _family_figure(name: str, rows: Results, with_paper: bool = True) -> Figure:
    plot = partial(figures.plot_accuracies, with_paper=with_paper)
    caption = f"Accuracy by family on {rows[0].item_set}, with 95% intervals."
    accuracies = {m.label: m.result.families for m in rows}
    return Figure(file_stem(f"{name}-{rows[0].item_set}"), caption, plot, accuracies)
