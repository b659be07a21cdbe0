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


def check_selection_items(rows: Sequence[Measurement], responses: Sequence[Responses]) -> None:
    """Refuse rows of one table that are not of the same items.

    Args:
        responses: The responses of each row's model.

    Raises:
        UserError: two runs measured different items.
    """
    first: dict[str, int] = {}
    for k, m in enumerate(rows):
        j = first.setdefault(m.items, k)
        names = (str(rows[j].run.folder), str(m.run.folder))
        check_same_items(responses[j], responses[k], names)


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
            (frames, queries), (other_frames, other_queries) = sizes
            raise UserError(
                f"{other.run.folder} and {m.run.folder} ranked {frames:,} and {other_frames:,} "
                f"frames of {m.benchmark} for {queries:,} and {other_queries:,} queries: choose "
                "runs of one test with runs=[...]",
                code="different-queries",
            )


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
