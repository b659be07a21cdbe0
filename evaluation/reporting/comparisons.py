"""Whether runs can be compared, and the paired comparisons between models of a benchmark."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from itertools import permutations
from pathlib import Path

from conf.errors import UserError
from data.records import SelectionItem
from evaluation.metrics.results import SelectionResult, from_json
from evaluation.metrics.significance import PairedComparison, compare_runs
from evaluation.reporting.measurements import ABLATED_REGIMES, REGIMES, Measurement
from evaluation.reporting.run_responses import Responses
from evaluation.reporting.runs import reading


def check_comparable(selections: Sequence[Measurement], retrievals: Sequence[Measurement]) -> None:
    """Refuse two builds of one benchmark, whose items can differ although their ids agree, and two
    sizes of one retrieval test.

    Raises:
        UserError: two runs measured different builds, or ranked other numbers of frames or queries.
    """
    builds: dict[str, tuple[str, Path]] = {}
    for m in (*selections, *retrievals):
        with reading(m.run.folder):
            own = (m.run.report["build"], m.run.folder)
        build, folder = builds.setdefault(m.row.benchmark, own)
        if build != own[0]:
            raise UserError(
                f"{folder} and {m.run.folder} measured different builds of benchmark "
                f"{m.row.benchmark}: measure one of them again (run=NAME), or leave it out with "
                "runs=[...]",
                code="different-builds",
            )
    first: dict[tuple, Measurement] = {}
    for m in retrievals:
        other = first.setdefault((m.row.benchmark, m.row.builder), m)
        if (m.row.frames, m.row.queries) != (other.row.frames, other.row.queries):
            raise UserError(
                f"{other.run.folder} and {m.run.folder} ranked {other.row.frames:,} and "
                f"{m.row.frames:,} frames of {m.row.benchmark} for {other.row.queries:,} and "
                f"{m.row.queries:,} queries: choose runs of one test with runs=[...]",
                code="different-queries",
            )


def compare_models(
    models: Mapping[str, tuple[Measurement, Responses]],
    items: Mapping[str, SelectionItem],
    seed: int,
) -> list[list[PairedComparison]]:
    """Paired comparisons of the models that the paper compares: by family, macro, and overall.

    Args:
        models: Models of one benchmark by label, with their responses.
        items: The benchmark's items by id.
        seed: Seed of the bootstrap over scenes.
    """
    comparisons = []
    for pair in permutations(models, 2):
        if not _is_claim(*(models[label][0] for label in pair)):
            continue
        credits = [
            {k: r.credit(items[k].letter) for k, r in models[label][1].items()} for label in pair
        ]
        answered = [item for item_id, item in items.items() if item_id in credits[0]]
        if answered:
            comparisons.append(compare_runs(answered, *credits, pair, seed))
    return comparisons


def _is_claim(m: Measurement, other: Measurement) -> bool:
    """Whether the paper compares such models: a student and its base in the same mode, a student
    with rationales and one of answers alone, the full student and an ablated one, and a retriever
    and its untrained base. Both students have the same base and seed."""
    if m.run.kind == "similarity":
        # The row of a common base is kept once, under the run that measured it first.
        reported = from_json(list[SelectionResult], m.run.report["rows"])
        return m.trained and not other.trained and other.row in reported
    if m.regime not in REGIMES or other.base != m.base:
        return False
    same_mode = other.row.mode == m.row.mode
    if not other.trained:
        return same_mode
    if other.seed != m.seed:
        return False
    if other.regime == "answer_only":
        return m.regime != "answer_only"
    return m.regime == "cot" and other.regime in ABLATED_REGIMES and same_mode
