"""The report's tables in the paper's shape: own rows in its parts, and the paper's rows below."""

from __future__ import annotations

import json
from collections.abc import Callable, Mapping, Sequence

from conf.errors import UserError
from conf.multirun.table import AT_START_SUFFIX
from evaluation.metrics.intervals import Interval
from evaluation.reporting import reference as paper
from evaluation.reporting.measurements import SUITES, Measured
from evaluation.reporting.results import SIMILARITY
from evaluation.reporting.runs import Finished, unreadable
from evaluation.reporting.table import Best, Table
from evaluation.reporting.tables import (
    RETRIEVAL_HEAD,
    RETRIEVAL_NOTE,
    SELECTION_HEAD,
    SELECTION_NOTE,
    interval_cell,
    majority_cells,
    retrieval_cells,
    retrieval_references,
    selection_cells,
    selection_references,
)

REGIMES = {
    "answer_only": "answer-only",
    "cot": "full student",
    "cot_no_candidate_analysis": "- candidate analysis",
    "cot_no_match_layout": "- match layout",
}
"""What the paper calls the regimes of a student's training."""
ABLATED = ("cot_no_candidate_analysis", "cot_no_match_layout")
"""Those without a part of the rationale."""


Rows = list[list[str]]
SELECTION_BEST = dict.fromkeys(("Event", "Time", "Window", "Macro", "Micro"), max)
RETRIEVAL_BEST = {**dict.fromkeys(("R@1", "R@10", "R@50", "MRR"), max), "Median": min}
"""Which number of a column is its best."""
BOLD = "Bold: the best of a column, of what was measured here and of the paper's rows."
NO_MODELS = (paper.CHANCE.name, paper.HUMAN_MAJORITY.name)
PEOPLE = "people, on the items of their study"
"""The part of a table in which they stand, who are no models."""


def selection_zero_shot(
    benchmark: str, rows: Sequence[Measured], studies: Sequence[Finished]
) -> Table:
    """The paper's Table 2, with the majority votes of studies of the benchmark.

    Raises:
        UserError: what a study exported is of another version.
    """
    reference = {
        "": (paper.CHANCE, paper.HUMAN_MAJORITY),
        ": similarity scorers": paper.SELECTION_SIMILARITY,
        ": open generative VLMs": paper.SELECTION_GENERATIVE,
    }
    parts = {
        "similarity scorers": selection_cells([m.row for m in rows if m.row.mode == SIMILARITY]),
        "generative models": selection_cells([m.row for m in rows if m.row.mode != SIMILARITY]),
        PEOPLE: [row for study in studies for row in _majority(study)],
        **{f"paper, Table 2{k}": selection_references(told) for k, told in reference.items()},
    }
    head = [f"Zero-shot, {benchmark}", *SELECTION_HEAD]
    told = _with_best(head, _told(parts), SELECTION_BEST)
    caption = f"Zero-shot selection accuracy (%) on {benchmark}"
    return Table(f"selection-{benchmark}", caption, head, told, (SELECTION_NOTE, BOLD))


def _majority(study: Finished) -> Rows:
    try:
        return majority_cells(f"Majority vote, {study.name}", study.report)
    except (KeyError, TypeError) as error:
        raise unreadable(study.folder) from error


def selection_distilled(benchmark: str, rows: Sequence[Measured]) -> Table:
    """The paper's Table 4 (a)."""
    reference = {"paper, Table 4a (Qwen3-VL-8B)": paper.SELECTION_DISTILLED}
    caption = f"Distillation: selection accuracy (%) on {benchmark}"
    return selection_trained(f"distillation-selection-{benchmark}", caption, rows, reference)


def selection_transfer(benchmark: str, rows: Sequence[Measured]) -> Table:
    """By family, on a benchmark that no student was trained on; the paper has MoVi-A's."""
    reference = {"paper, Section 5.3 (MoVi-A, answer mode)": paper.MOVI_A_BY_FAMILY}
    caption = f"Transfer: selection accuracy (%) on {benchmark}"
    return selection_trained(f"transfer-{benchmark}", caption, rows, reference)


def selection_trained(
    name: str,
    caption: str,
    rows: Sequence[Measured],
    reference: dict[str, Sequence[paper.SelectionReference]],
) -> Table:
    """Selection rows of models as they were released, of trained ones, and of the paper."""
    parts = {
        "zero-shot": selection_cells([m.row for m in rows if not m.trained]),
        "trained": selection_cells([m.row for m in rows if m.trained]),
        **{label: selection_references(told) for label, told in reference.items()},
    }
    head = [f"Selection, {rows[0].items}", *SELECTION_HEAD]
    told = _with_best(head, _told(parts), SELECTION_BEST)
    return Table(name, caption, head, told, (SELECTION_NOTE, BOLD))


def retrieval_zero_shot(benchmark: str, rows: Sequence[Measured]) -> Table:
    """The paper's Table 3; retrievers at their widest."""
    reference = {
        "paper, Table 3: direct embedders": paper.RETRIEVAL_DIRECT,
        "paper, Table 3: two-stage": paper.RETRIEVAL_TWO_STAGE,
    }
    head = [f"Zero-shot, {benchmark}", *RETRIEVAL_HEAD]
    caption = f"Zero-shot retrieval (recall in %) on {benchmark}"
    return _retrieval(f"retrieval-{benchmark}", caption, head, rows, reference)


def retrieval_distilled(benchmark: str, rows: Sequence[Measured]) -> Table:
    """The paper's Table 4 (b); retrievers at their widest."""
    reference = {"paper, Table 4b": paper.RETRIEVAL_DISTILLED}
    head = [f"Distilled, {benchmark}", *RETRIEVAL_HEAD]
    caption = f"Distillation: retrieval (recall in %) on {benchmark}"
    return _retrieval(f"distillation-retrieval-{benchmark}", caption, head, rows, reference)


def _retrieval(
    name: str,
    caption: str,
    head: Sequence[str],
    rows: Sequence[Measured],
    reference: dict[str, Sequence[paper.RetrievalReference]],
) -> Table:
    ordered = sorted(rows, key=lambda m: m.trained)
    direct = [m.row for m in ordered if m.run.kind == "retrieve"]
    staged = [m.row for m in ordered if m.run.kind == "two_stage"]
    parts = {
        "two-stage predict-then-match": retrieval_cells(staged),
        "direct embedders": retrieval_cells(direct),
        **{label: retrieval_references(told) for label, told in reference.items()},
    }
    told = _with_best(head, _told(parts), RETRIEVAL_BEST)
    return Table(name, caption, head, told, (RETRIEVAL_NOTE, BOLD))


def overall_table(
    name: str,
    caption: str,
    rows: Sequence[Measured],
    labels: Sequence[str],
    reference: dict[str, Sequence[paper.OverallReference]],
) -> Table:
    """Accuracy over all items of a benchmark, a line a model and a column a benchmark, the one it
    was trained on first: the paper's Table 12 (ablation), and its figures of transfer.

    Args:
        labels: what each row's model is called; rows of one label stand in one line.
    """
    homes = {m.home for m in rows if m.home}
    # A model as it was released has no benchmark of its own.
    columns = [
        "In domain"
        if m.benchmark == m.home or (not m.trained and m.benchmark in homes)
        else m.column
        for m in rows
    ]
    # Two benchmarks of a suite have a column each; of its own, a line may have two.
    places: dict[tuple[str, str], set[str]] = {}
    for m, label, column in zip(rows, labels, columns, strict=True):
        line = label if column == "In domain" else ""
        places.setdefault((column, line), set()).add(m.benchmark)
    shared = {column for (column, _), of in places.items() if len(of) > 1}
    columns = [
        f"{column} ({m.benchmark})" if column in shared else column
        for m, column in zip(rows, columns, strict=True)
    ]
    suites = dict.fromkeys(["In domain", *SUITES.values(), *columns])
    found: dict[str, dict[str, Interval]] = {}
    for m, label, column in zip(rows, labels, columns, strict=True):
        found.setdefault(label, {})[column] = m.row.micro
    own = []
    for label, of in found.items():
        each = [of.get(column) for column in suites]
        own.append([label, *(f"{100 * i.value:.1f}" if i else "-" for i in each)])
        own.append(["  95% interval", *map(interval_cell, each)])
    printed = {
        told: [_overall(r, len(suites)) for r in references]
        for told, references in reference.items()
    }
    head = ["Overall accuracy, %", *suites]
    told = _with_best(head, {"": own, **printed}, dict.fromkeys(suites, max))
    return Table(name, caption, head, told, ("Intervals are Wilson's, over items.", BOLD))


def _overall(row: paper.OverallReference, columns: int) -> list[str]:
    shares = [f"{percent:.1f}" for percent in (row.clevrer, row.movi_a, row.physion)]
    return [row.name, *shares, *["-"] * (columns - len(shares))]


def training_table(runs: Sequence[Finished]) -> Table | None:
    """What each run measured on held-out training scenes, at its start and at its end."""
    parts = {}
    for run in runs:
        try:
            metrics = json.loads((run.folder / "metrics.json").read_text())
        except ValueError as error:
            raise UserError(
                f"{run.folder / 'metrics.json'} is damaged: delete it, and run its training "
                "command again, which ends where it was"
            ) from error
        starts = {name: metrics.get(f"{name}{AT_START_SUFFIX}") for name in metrics}
        parts[f"{run.kind}/{run.name}"] = [
            [name.replace("_", " "), f"{start:.3f}", f"{metrics[name]:.3f}"]
            for name, start in starts.items()
            if start is not None
        ]
    head = ["Training (held-out scenes)", "Start", "End"]
    told = _told(parts)
    return Table("training", "Training, on held-out scenes", head, told) if told else None


def _told(parts: dict[str, list[list[str]]]) -> dict[str, list[list[str]]]:
    return {label: rows for label, rows in parts.items() if rows}


def _with_best(
    head: Sequence[str], parts: dict[str, Rows], best: Mapping[str, Callable[[list[float]], float]]
) -> dict[str, Rows]:
    """The rows, the best cell of each column that `best` names told so, as the paper does: among
    what was measured, and among the paper's."""
    parts = {label: [list(row) for row in rows] for label, rows in parts.items()}
    for printed in (False, True):
        chosen = [r for k, r in parts.items() if k.startswith("paper") is printed and k != PEOPLE]
        of = [row for rows in chosen for row in rows]
        models = [row for row in of if not row[0].startswith("  ") and row[0] not in NO_MODELS]
        for place, name in enumerate(head):
            if name in best:
                _tell_best(models, place, best[name])
    return parts


def _tell_best(rows: Rows, place: int, best: Callable[[list[float]], float]) -> None:
    told = [row for row in rows if row[place] not in ("", "-")]
    values = [float(row[place]) for row in told]
    for row, value in zip(told, values, strict=True):
        # One alone is better than none.
        if len(values) > 1 and value == best(values):
            row[place] = Best(row[place])
