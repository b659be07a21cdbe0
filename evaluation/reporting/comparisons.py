"""Whether runs can be compared, and the paired comparisons between models of a benchmark."""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Mapping, Sequence
from dataclasses import replace

from conf.errors import UserError
from data.records import SelectionItem
from evaluation.metrics.significance import PairedComparison, check_same_items, compare_runs
from evaluation.reporting.measurements import ABLATED_REGIMES, REGIMES, Measurement
from evaluation.reporting.results import SelectionResult
from evaluation.reporting.run_responses import Responses
from evaluation.reporting.runs import FinishedRun, reading

REMEDY = "compare runs of the same items, chosen with runs=[...]"


def check_same_build(runs: Iterable[FinishedRun]) -> None:
    """Refuse two builds of one benchmark: their items can differ although their ids agree.

    Raises:
        UserError: two runs measured different builds of a benchmark.
    """
    first: dict[str, tuple[str, FinishedRun]] = {}
    for run in runs:
        with reading(run.folder):
            name, build = run.config["benchmark"]["name"], run.report["build"]
        other_build, other = first.setdefault(name, (build, run))
        if other_build != build:
            raise UserError(
                f"{other.folder} and {run.folder} measured different builds of benchmark {name}: "
                "measure one of them again (run=NAME), or leave it out with runs=[...]",
                code="different-builds",
            )


def check_selection_items(
    rows: Sequence[Measurement], items: Sequence[Mapping[str, object] | None]
) -> None:
    """Refuse rows of one table that are not of the same items.

    Args:
        items: Each row's items by id; None if they are unknown, so that their number, and the
            limit and seed that chose them, are compared instead.

    Raises:
        UserError: two runs measured different items.
    """
    first: dict[str, int] = {}
    # Known items come first, for the error can name those that differ.
    for k in sorted(range(len(rows)), key=lambda k: items[k] is None):
        row, j = rows[k], first.setdefault(rows[k].items, k)
        other = rows[j]
        names = (str(other.run.folder), str(row.run.folder))
        if items[j] is not None and items[k] is not None:
            check_same_items(items[j], items[k], names)
        elif (sizes := (f"{other.row.n:,}", f"{row.row.n:,}"))[0] != sizes[1]:
            _refuse(names, f"answered {sizes[0]} and {sizes[1]} items", "different-items")
        elif (samples := (_sample(other.run), _sample(row.run)))[0] != samples[1]:
            detail = f"answered items of limit and seed {samples[0]} and {samples[1]}"
            _refuse(names, detail, "different-items")


def _sample(run: FinishedRun) -> tuple[int, int] | None:
    """The limit and the seed that chose a run's items; None for all items."""
    limit = run.config.get("limit")
    return None if limit is None else (limit, run.config.get("seed", 0))


def check_retrieval_sizes(rows: Sequence[Measurement]) -> None:
    """Refuse retrieval rows of one benchmark with different numbers of queries or frames.

    Raises:
        UserError: two runs ranked another number of frames or queries.
    """
    first: dict[tuple, Measurement] = {}
    for m in rows:
        other = first.setdefault((m.benchmark, m.row.builder), m)
        sizes = [(r.row.frames, r.row.queries) for r in (other, m)]
        if sizes[0] != sizes[1]:
            (frames, queries), (more_frames, more_queries) = sizes
            names = (str(other.run.folder), str(m.run.folder))
            detail = (
                f"ranked {frames:,} and {more_frames:,} frames of {m.benchmark} for {queries:,} "
                f"and {more_queries:,} queries"
            )
            _refuse(names, detail, "different-queries")


def _refuse(names: tuple[str, str], detail: str, code: str) -> None:
    raise UserError(f"{names[0]} and {names[1]} {detail}: {REMEDY}", code=code)


def compare_models(
    models: Mapping[str, tuple[Measurement, Responses]],
    items: Mapping[str, SelectionItem],
    seed: int,
) -> list[list[PairedComparison]]:
    """Paired comparisons of the models that the paper compares: by family, macro, and overall.

    Args:
        models: Models of one benchmark by label, with their responses; responses to other items
            are left out.
        items: The benchmark's items by id.
        seed: Seed of the bootstrap over scenes.
    """
    comparisons = []
    for pair in model_pairs({label: m for label, (m, _) in models.items()}):
        credits = [
            {k: r.credit(items[k].letter) for k, r in models[label][1].items() if k in items}
            for label in pair
        ]
        answered = [item for item_id, item in items.items() if item_id in credits[0]]
        if answered:
            comparisons.append(compare_runs(answered, *credits, pair, seed))
    return comparisons


def model_pairs(models: Mapping[str, Measurement]) -> Iterator[tuple[str, str]]:
    """The pairs behind the paper's claims, by label: a student and its base in the same mode, a
    student with rationales and one of answers alone, the full student and an ablated one, and a
    retriever and its untrained base. Both students of a pair have the same base and seed."""
    for label, m in models.items():
        if m.run.kind == "similarity" and m.trained:
            # The row of a common base is kept once, under the run that measured it first.
            reported = [SelectionResult.from_dict(row) for row in m.run.report["rows"]]
            yield from (
                (label, name)
                for name, other in models.items()
                if not other.trained and replace(other.row, name=other.report_key) in reported
            )
        if m.regime not in REGIMES:
            continue
        same_base = [(name, other) for name, other in models.items() if other.base == m.base]
        same_seed = [(name, other) for name, other in same_base if other.seed == m.seed]
        others = [name for name, o in same_base if not o.trained and o.row.mode == m.row.mode]
        if m.regime != "answer_only":
            others += [name for name, o in same_seed if o.regime == "answer_only"]
        if m.regime == "cot":
            others += [
                name
                for name, o in same_seed
                if o.regime in ABLATED_REGIMES and o.row.mode == m.row.mode
            ]
        yield from ((label, name) for name in others)
