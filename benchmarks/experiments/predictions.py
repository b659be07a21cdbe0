"""Measures what a student predicts in its rationales: whether its predictions are true, and whether
they single out the target.

    python -m benchmarks.experiments.predictions checkpoints/select/model-checkpoints-sft-exp-cot

The argument is a run of `evaluation.select` with answers in reasoning mode. The columns are, in %
of the items of a family:

    right       the answer is right
    predicts    the response predicts something
    true        the response predicts something, and every prediction is true of the target
    decides     of the items whose predictions are true, the probability that a reader of these
                alone picks the target (`dynapix.sufficiency`)
    reader      this probability in all items: the accuracy of a student that reads and compares
                without mistakes, but predicts what this student predicts
    chosen      of the items with predictions, a predicted object is one that the built-in narrator
                chooses to decide the item
    follows     the answer is a candidate of which the predictions are true
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from pathlib import Path
from typing import NamedTuple

import numpy as np

from benchmarks.experiments.experiment import (
    open_benchmark,
    print_header,
    print_row,
    read_item_responses,
)
from conf.failures import report_failures
from data.records import FAMILIES
from data.store import Store
from teacher.deciding import choose_statements
from teacher.predicates.extraction import extract_predicates
from teacher.predicates.relations import Bounds
from teacher.sufficiency import find_predicted, is_consistent, measure_sufficiency
from teacher.validation.claim_extraction import extract_claims


class Predicted(NamedTuple):
    """What a response answers and predicts.

    Attributes:
        fitting: Letters of the candidates of which the predictions are true.
        reader: The probability that a reader of the predictions picks the target.
        chosen: Whether a predicted object decides the item; None if nothing is predicted.
    """

    family: str
    target: str
    answer: str | None
    fitting: tuple[str, ...]
    reader: float
    chosen: bool | None


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("run", type=Path, help="folder of a run of evaluation.select")
    parser.add_argument("--benchmark", default="tiny")
    parser.add_argument("--store", type=Path, default=Path("store"))
    args = parser.parse_args()
    found = list(read_predictions(args.run, open_benchmark(args.store, args.benchmark)))
    print_header(
        "family", "items", "right", "predicts", "true", "decides", "reader", "chosen", "follows"
    )
    for family in (*FAMILIES, "all"):
        rows = [r for r in found if family in (r.family, "all")]
        true = [r for r in rows if r.target in r.fitting]
        columns = (
            [r.answer == r.target for r in rows],
            [r.chosen is not None for r in rows],
            [r.target in r.fitting for r in rows],
            [r.reader for r in true],
            [r.reader for r in rows],
            [r.chosen for r in rows if r.chosen is not None],
            [r.answer in r.fitting for r in rows],
        )
        shares = (f"{100 * np.mean(c):.1f}" if c else "-" for c in columns)
        print_row(family, len(rows), *shares)


def read_predictions(run: Path, store: Store) -> Iterator[Predicted]:
    """Yield what each response in reasoning mode predicts."""
    responses = read_item_responses(run, "reasoning")
    for item in store.selection("test"):
        response = responses.get(item.item_id)
        if response is None:
            continue
        p = extract_predicates(item, store.scene(item.scene_id), store.scene, Bounds())
        if p is None:
            continue
        claims = extract_claims(response.text, p)
        predicted = find_predicted(response.text, claims)
        fitting = tuple(v.letter for v in p.views if predicted and is_consistent(predicted, v))
        deciding = {name for s in choose_statements(p).statements for name in s.objects}
        names = {name for claim in predicted for name in claim.subjects}
        reader = measure_sufficiency(response.text, claims, p)
        chosen = not names.isdisjoint(deciding) if names else None
        yield Predicted(item.family, item.letter, response.letter, fitting, reader, chosen)


if __name__ == "__main__":
    with report_failures():
        main()
