"""The sections of the report: tables in the paper's shape, and figures."""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import partial
from pathlib import Path
from typing import Any, TypeVar

from evaluation.metrics.calibration import Calibration, PositionBias
from evaluation.metrics.intervals import Interval
from evaluation.metrics.significance import PairedComparison
from evaluation.reporting import figures, summary_tables, tables
from evaluation.reporting.item_browser import ItemBrowser
from evaluation.reporting.measurements import (
    ABLATED_REGIMES,
    REGIMES,
    Measurement,
    group_by_items,
    model_names,
    transfer_benchmarks,
    widest_rows,
)
from evaluation.reporting.runs import (
    STUDY_KINDS,
    TRAINING_KINDS,
    FinishedRun,
    json_lines,
    reading,
)
from evaluation.reporting.table import Table
from train.common.curves import plot_curves

Rows = Sequence[Measurement]
T = TypeVar("T")


@dataclass(frozen=True)
class Figure:
    """An SVG file and its caption."""

    path: Path
    caption: str


@dataclass
class Section:
    """A part of the report. `details` are tables that the page folds and the text leaves out."""

    title: str
    tables: list[Table] = field(default_factory=list)
    figures: list[Figure] = field(default_factory=list)
    details: list[Table] = field(default_factory=list)


def build_sections(
    selections: Rows,
    retrievals: Rows,
    runs: Sequence[FinishedRun],
    browser: ItemBrowser,
    folder: Path,
) -> list[Section]:
    """The sections that have content, in the paper's order. Figures are written into `folder`.

    Args:
        selections, retrievals: The rows of `runs`.

    Raises:
        UserError: a report is damaged or of another version.
    """
    draw = partial(_draw, folder)
    unchanged = [m for m in selections if not m.variants]
    studies = [run for run in runs if run.kind in STUDY_KINDS]
    sections = [
        zero_shot(unchanged, widest_rows(retrievals), studies, draw),
        distillation(unchanged, widest_rows(retrievals), browser, draw),
        ablation(unchanged),
        transfer(unchanged, browser, draw),
        controls([m for m in selections if m.variants], runs),
        *map(human_study, studies),
        selection_details(unchanged, browser, draw),
        retrieval_details([m for m in retrievals if m.row.builder is None], draw),
        training([run for run in runs if run.kind in TRAINING_KINDS], draw),
    ]
    return [s for s in sections if s.tables or s.figures or s.details]


def zero_shot(
    selections: Rows, retrievals: Rows, studies: Sequence[FinishedRun], draw: Callable
) -> Section:
    section = Section("Zero-shot")
    transfers = transfer_benchmarks(selections)
    for benchmark, rows in group_by_items(m for m in selections if not m.trained).items():
        if benchmark not in transfers:
            build = (benchmark, rows[0].run.report.get("build"))
            on_build = [
                s for s in studies if (s.report.get("benchmark"), s.report.get("build")) == build
            ]
            table = summary_tables.zero_shot_selection_table(benchmark, rows, on_build)
            section.tables.append(table)
            section.figures.append(_family_figure(draw, "zero-shot", rows))
    for benchmark, rows in group_by_items(m for m in retrievals if not m.trained).items():
        paper = {
            "paper, Table 3: direct embedders (2,002 queries, 10,000 frames)": ["retrieval_direct"],
            "paper, Table 3: two-stage (2,002 queries, 10,000 frames)": ["retrieval_two_stage"],
        }
        caption = f"Zero-shot retrieval (recall in %) on {benchmark}"
        name, title = f"retrieval-{benchmark}", f"Zero-shot, {benchmark}"
        table = summary_tables.retrieval_summary_table(name, caption, title, rows, paper)
        section.tables.append(table)
    return section


def distillation(
    selections: Rows, retrievals: Rows, browser: ItemBrowser, draw: Callable
) -> Section:
    section = Section("Distillation")
    transfers = transfer_benchmarks(selections)
    for benchmark, rows in group_by_items(selections).items():
        if benchmark not in transfers and any(m.trained for m in rows):
            name = f"distillation-selection-{benchmark}"
            caption = f"Distillation: selection accuracy (%) on {benchmark}"
            paper = {"paper, Table 4a (Qwen3-VL-8B)": ["selection_distilled"]}
            table = summary_tables.trained_selection_table(name, caption, rows, paper)
            section.tables.append(table)
            section.figures.append(_family_figure(draw, "families", rows))
            _add_model_differences(section, benchmark, browser)
    for benchmark, rows in group_by_items(retrievals).items():
        trained = {m.run.folder: m.run for m in rows if m.trained}
        if trained:
            name = f"distillation-retrieval-{benchmark}"
            caption = f"Distillation: retrieval (recall in %) on {benchmark}"
            paper = {"paper, Table 4b (2,002 queries, 10,000 frames)": ["retrieval_distilled"]}
            title = f"Distilled, {benchmark}"
            table = summary_tables.retrieval_summary_table(name, caption, title, rows, paper)
            section.tables.append(table)
        if differences := _rank_differences(trained.values()):
            table = tables.rank_differences_table(differences)
            section.tables.append(_on_benchmark(table, benchmark))
    return section


def _rank_differences(runs: Iterable[FinishedRun]) -> list[dict[str, Any]]:
    """The reported differences between retrievers; equal names are followed by their run's."""
    reported = [(run, run.report.get("differences", [])) for run in runs]
    names = Counter(d["left"] for _, differences in reported for d in differences[:1])
    return [
        d if names[d["left"]] == 1 else {**d, "left": f"{d['left']}, {run.name}"}
        for run, differences in reported
        for d in differences
    ]


def ablation(selections: Rows) -> Section:
    """The regimes with rationales, in reasoning mode."""
    rows = [m for m in selections if m.row.mode == "reasoning" and m.regime in REGIMES]
    if not any(m.regime in ABLATED_REGIMES for m in rows):
        return Section("Ablation")
    rows.sort(key=lambda m: list(REGIMES).index(m.regime))
    names = zip(rows, model_names(rows), strict=True)
    labels = [f"{REGIMES[m.regime]} ({name})" for m, name in names]
    caption = "Ablation: accuracy over all items (%) in reasoning mode"
    paper = {"paper, Table 12": "ablation"}
    table = summary_tables.overall_table("ablation", caption, rows, labels, paper)
    return Section("Ablation", [table])


def transfer(selections: Rows, browser: ItemBrowser, draw: Callable) -> Section:
    """Students on benchmarks that they were not trained on, and their bases."""
    section = Section("Transfer")
    if not (transfers := transfer_benchmarks(selections)):
        return section
    models = {(m.model, m.row.mode) for m in selections if m.benchmark in transfers}
    rows = [m for m in selections if (m.model, m.row.mode) in models]
    names = zip(rows, model_names(rows), strict=True)
    labels = [f"{name} ({m.row.mode})" for m, name in names]
    caption = "Transfer: accuracy over all items (%)"
    paper = {"paper, Section 5.3 (answer mode)": "transfer"}
    section.tables.append(summary_tables.overall_table("transfer", caption, rows, labels, paper))
    for benchmark, rows in group_by_items(selections).items():
        if benchmark in transfers:
            caption = f"Transfer: selection accuracy (%) on {benchmark}"
            paper = {"paper, Section 5.3 (MoVi-A, answer mode)": ["movi_a_by_family"]}
            name = f"transfer-{benchmark}"
            table = summary_tables.trained_selection_table(name, caption, rows, paper)
            section.tables.append(table)
            # The paper's accuracies by family are on CLEVRER.
            section.figures.append(_family_figure(draw, "families", rows, with_paper=False))
            _add_model_differences(section, benchmark, browser)
    return section


def _add_model_differences(section: Section, benchmark: str, browser: ItemBrowser) -> None:
    """Add the differences between the benchmark's models, overall and, folded, by family."""
    if comparisons := browser.comparisons.get(benchmark):
        overall = tables.model_differences_table(comparisons)
        by_family = tables.paired_table([(benchmark, pairs) for pairs in comparisons])
        section.tables.append(_on_benchmark(overall, benchmark))
        section.details.append(_on_benchmark(by_family, benchmark))


def controls(selections: Rows, runs: Sequence[FinishedRun]) -> Section:
    """The accuracies under controls, and their differences from the unchanged items.

    Raises:
        UserError: a report is of another version.
    """
    section = Section("Controls")
    groups: dict[tuple[Path, str, str, str], list[PairedComparison]] = {}
    for run in runs:
        with reading(run.folder):
            for entry in run.report.get("controls", []):
                fields = {key: value for key, value in entry.items() if key != "mode"}
                pair, row = PairedComparison(**fields), run.report["rows"][0]
                model = [] if run.kind == "similarity" else [row["name"]]
                label = ", ".join([row["benchmark"], *model, entry["mode"]])
                groups.setdefault((run.folder, label, pair.left, pair.right), []).append(pair)
    if groups:
        counts = Counter(key[1:] for key in groups)
        pairs = [
            (label if counts[label, left, right] == 1 else f"{label}, {folder.name}", of)
            for (folder, label, left, right), of in groups.items()
        ]
        caption = "Controls: paired differences of accuracy (%)"
        section.tables.append(replace(tables.paired_table(pairs), name="controls", caption=caption))
    for items, rows in group_by_items(selections).items():
        name = f"control-{items.replace(', ', '-')}"
        caption = f"Controls: selection accuracy (%) on {items}"
        section.tables.append(summary_tables.trained_selection_table(name, caption, rows, {}))
    return section


def human_study(run: FinishedRun) -> Section:
    """
    Raises:
        UserError: the study's report is of another version.
    """
    with reading(run.folder):
        table = tables.human_table(run.report)
        benchmark = run.report["benchmark"]
    caption = f"{table.caption}: study {run.name} on benchmark {benchmark}"
    name = f"human-{run.name.replace('/', '-')}"
    return Section("Human study", [replace(table, name=name, caption=caption)])


def selection_details(selections: Rows, browser: ItemBrowser, draw: Callable) -> Section:
    """
    Raises:
        UserError: a report is of another version.
    """
    section = Section("Selection in detail")
    transfers = transfer_benchmarks(selections)
    for benchmark, rows in group_by_items(selections).items():
        subtypes = _read_details(rows, "subtypes", _read_intervals)
        horizons = {label: figures.accuracy_by_horizon(of) for label, of in subtypes.items()}
        if horizons := {label: of for label, of in horizons.items() if of}:
            with_paper = rows[0].benchmark not in transfers
            plot = partial(figures.horizon_figure, with_paper=with_paper)
            caption = f"Accuracy by horizon on {benchmark}."
            section.figures.append(draw(f"horizons-{benchmark}", plot, horizons, caption))
        if confusions := browser.confusions.get(benchmark):
            plot = figures.confusion_figure
            caption = f"Chosen letters by correct letter on {benchmark} (% of a row)."
            section.figures.append(draw(f"positions-{benchmark}", plot, confusions, caption))
        details = tables.detail_tables(
            subtypes,
            _read_details(rows, "readings", dict),
            _read_details(rows, "positions", lambda entry: PositionBias(**entry)),
            _read_details(rows, "calibration", Calibration.from_dict),
        )
        section.details += [_on_benchmark(table, benchmark) for table in details]
    return section


def _read_intervals(entry: Mapping[str, Any]) -> dict[str, Interval]:
    return {name: Interval(**share) for name, share in entry.items()}


def _read_details(rows: Rows, kind: str, read: Callable[[Any], T]) -> dict[str, T]:
    """One kind of details from the rows' reports, by the label of the model."""
    details = {}
    for m in rows:
        with reading(m.run.folder):
            if entry := m.run.report.get(kind, {}).get(m.report_key):
                details[m.label] = read(entry)
    return details


def retrieval_details(retrievals: Rows, draw: Callable) -> Section:
    section = Section("Retrieval in detail")
    for benchmark, rows in group_by_items(retrievals).items():
        results = [m.row for m in rows]
        section.tables.append(_on_benchmark(tables.cost_table(results), benchmark))
        widths = replace(tables.retrieval_table(results), name="widths")
        section.details.append(_on_benchmark(widths, benchmark))
        if any(row.width for row in results):
            caption = f"Recall by width on {benchmark}."
            plot = figures.retrieval_figure
            section.figures.append(draw(f"widths-{benchmark}", plot, results, caption))
        curves = {
            (m.row.name, m.run.folder): {**curve, "name": m.row.name}
            for m in rows
            for curve in m.run.report.get("curves", [])
            if curve["builder"] is None and curve["name"] == m.model
        }
        if curves:
            caption = f"Recall by k on {benchmark}, at the largest width."
            plot = figures.recall_figure
            section.figures.append(draw(f"recall-{benchmark}", plot, [*curves.values()], caption))
    return section


def training(runs: Sequence[FinishedRun], draw: Callable) -> Section:
    section = Section("Training")
    table = summary_tables.training_table(runs)
    if table.groups:
        section.tables.append(table)
    for run in runs:
        journal = run.folder / "metrics.jsonl"
        if journal.exists() and (records := [*json_lines(journal)]):
            name = f"training-{run.kind}-{run.name.replace('/', '-')}"
            caption = f"Training of {run.kind}/{run.name}."
            section.figures.append(draw(name, plot_curves, records, caption))
    return section


def _on_benchmark(table: Table, benchmark: str) -> Table:
    caption = f"{table.caption}, on {benchmark}"
    return replace(table, name=f"{table.name}-{benchmark}", caption=caption)


def _family_figure(draw: Callable, name: str, rows: Rows, with_paper: bool = True) -> Figure:
    plot = partial(figures.selection_figure, with_paper=with_paper)
    caption = f"Accuracy by family on {rows[0].items}, with 95% intervals."
    return draw(f"{name}-{rows[0].items}", plot, [m.row for m in rows], caption)


def _draw(folder: Path, name: str, plot: Callable, data: Any, caption: str) -> Figure:
    """Write a figure as SVG with its text as text; equal data give equal files."""
    import matplotlib

    path = folder / f"{name}.svg"
    with matplotlib.rc_context({"svg.fonttype": "none", "svg.hashsalt": name}):
        plot(data, path)
    return Figure(path, caption)
