"""Which models of a benchmark are held against each other, and how far their answers are apart."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace

from data.records import SelectionItem
from evaluation.metrics.significance import PairedComparison, compare_runs
from evaluation.reporting.measurements import Measured
from evaluation.reporting.paper_tables import ABLATED, REGIMES
from evaluation.reporting.results import SelectionResult
from evaluation.reporting.run_responses import Said, Scored


def apart(
    answered: Mapping[str, tuple[Measured, Mapping[str, Said | Scored]]],
    items: Mapping[str, SelectionItem],
    seed: int,
) -> list[list[PairedComparison]]:
    """The models of each pair, item by item: by family, their macro, and over all.

    Args:
        answered: models of one benchmark by their label, and what they said by item.
        items: those items by their id; what was said of others is left out.
        seed: of the scenes that are drawn for the intervals.
    """
    models = {label: m for label, (m, _) in answered.items()}
    found = []
    for one, other in pairs(models):
        credits = []
        for label in (one, other):
            given = answered[label][1]
            credits.append(
                {k: said.credit(items[k].letter) for k, said in given.items() if k in items}
            )
        asked = [item for name, item in items.items() if name in credits[0]]
        if asked:
            found.append(compare_runs(asked, *credits, (one, other), seed))
    return found


def pairs(models: Mapping[str, Measured]) -> Iterator[tuple[str, str]]:
    """What the paper's claims hold against each other: a student and its base asked in the same
    mode, rationales and answers alone, the full student and one without a part, and a retriever and
    what it began from. Students of a pair have the same base and seed."""
    for label, m in models.items():
        if m.run.kind == "similarity" and m.trained:
            # Once, a base's row stands under the run that measured it first.
            began = [SelectionResult.from_dict(row) for row in m.run.report["rows"]]
            yield from (
                (label, name)
                for name, o in models.items()
                if not o.trained and replace(o.row, name=o.known_by) in began
            )
        if m.regime not in REGIMES:
            continue
        kin = [(name, other) for name, other in models.items() if other.base == m.base]
        twins = [(name, other) for name, other in kin if other.seed == m.seed]
        against = [name for name, o in kin if not o.trained and o.row.mode == m.row.mode]
        if m.regime != "answer_only":
            against += [name for name, o in twins if o.regime == "answer_only"]
        if m.regime == "cot":
            against += [
                name for name, o in twins if o.regime in ABLATED and o.row.mode == m.row.mode
            ]
        yield from ((label, name) for name in against)
