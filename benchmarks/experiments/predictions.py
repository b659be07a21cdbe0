"""Measures what students predict in their rationales: whether their predictions are true, and
whether they single out the target.

    python -m benchmarks.experiments.predictions checkpoints/select/model-checkpoints-sft-exp-cot

The arguments are runs of `evaluation.select`, such as the seeds of one experiment. The columns of
the first table are, in % of the items of a family:

    right       the answer is right
    predicts    the response predicts something
    true        the response predicts something, and every prediction is true of the target
    decides     of the items whose predictions are true, the probability that a reader of these
                alone picks the target (`dynapix.sufficiency`)
    sufficiency this probability in all items: the accuracy of a student that reads and compares
                without mistakes, but predicts what this student predicts
    deciding    of the items with predictions, a predicted object is one that the built-in narrator
                chooses to decide the item
    follows     the answer is a candidate of which the predictions are true

The second table divides the responses by the number of candidates that show what is predicted,
according to the response itself. The last one tells which candidates wrong answers choose: those of
an earlier or later moment than the target, of an alternative future of the scene, or of another
scene; and how often these are offered among the wrong candidates of the same items.
"""

from __future__ import annotations

import argparse
from collections import Counter
from collections.abc import Iterator, Sequence
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
from conf.schema import RelationBounds
from data.records import FAMILIES, LETTERS, SelectionItem
from data.store import Store
from teacher.predicates.extraction import extract_predicates
from teacher.predicates.facts import Relation
from teacher.predicates.relations import VALUES, normalize_relation
from teacher.reading.claims import Claim
from teacher.statement_choice import choose_statements
from teacher.sufficiency import find_predicted, is_consistent, measure_sufficiency
from teacher.validation.claim_extraction import extract_claims

SUBTYPES = ("in_1s", "in_2s")
"""Subtypes of time items."""
KINDS = ("earlier", "later", "alternative future", "another scene")
"""Kinds of wrong candidates, compared with the target."""


class Predicted(NamedTuple):
    """What a response answers and predicts.

    Attributes:
        fitting: Letters of the candidates of which the predictions are true.
        sufficiency: The probability that a reader of the predictions picks the target.
        names_deciding: Whether a predicted object decides the item; None if nothing is predicted.
        described: Letters of the candidates that show all that is predicted, according to the
            response.
    """

    family: str
    target: str
    answer: str | None
    fitting: tuple[str, ...]
    sufficiency: float
    names_deciding: bool | None
    described: tuple[str, ...]


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("runs", nargs="+", type=Path, help="folders of runs of evaluation.select")
    parser.add_argument("--benchmark", default="tiny")
    parser.add_argument("--store", type=Path, default=Path("store"))
    args = parser.parse_args()
    store = open_benchmark(args.store, args.benchmark)
    found = [p for run in args.runs for p in read_predictions(run, store)]
    if found:
        print_shares(found)
        print_agreement(found)
    print_wrong_answers(args.runs, store)


def print_shares(found: Sequence[Predicted]) -> None:
    """Print the shares of the first table by family."""
    print_header(
        "family",
        "items",
        "right",
        "predicts",
        "true",
        "decides",
        "sufficiency",
        "deciding",
        "follows",
    )
    for family in (*FAMILIES, "all"):
        rows = [r for r in found if family in (r.family, "all")]
        true = [r for r in rows if r.target in r.fitting]
        columns = (
            [r.answer == r.target for r in rows],
            [r.names_deciding is not None for r in rows],
            [r.target in r.fitting for r in rows],
            [r.sufficiency for r in true],
            [r.sufficiency for r in rows],
            [r.names_deciding for r in rows if r.names_deciding is not None],
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
        p = extract_predicates(item, store.scene(item.scene_id), store.scene, RelationBounds())
        if p is None:
            continue
        claims = extract_claims(response.text, p)
        predicted = find_predicted(response.text, claims)
        fitting = tuple(v.letter for v in p.views if predicted and is_consistent(predicted, v))
        deciding = {name for s in choose_statements(p).statements for name in s.objects}
        names = {name for claim in predicted for name in claim.subjects}
        sufficiency = measure_sufficiency(response.text, claims, p)
        names_deciding = not names.isdisjoint(deciding) if names else None
        described = find_described(predicted, claims) if predicted else ()
        yield Predicted(
            item.family,
            item.letter,
            response.letter,
            fitting,
            sufficiency,
            names_deciding,
            described,
        )


def find_described(predicted: Sequence[Claim], claims: Sequence[Claim]) -> tuple[str, ...]:
    """Return the letters of the candidates that show all that is predicted, according to the
    claims about them."""
    shown = {(c.candidate, read_statement(c)) for c in claims if c.candidate is not None}
    return tuple(
        letter for letter in LETTERS if all((letter, read_statement(c)) in shown for c in predicted)
    )


def read_statement(claim: Claim) -> tuple[object, ...]:
    """Return what a claim states, without the candidate or the moment that it is about."""
    relation = Relation(claim.kind, claim.subjects, claim.value)
    return (normalize_relation(relation) if claim.kind in VALUES else relation, claim.affirmed)


def print_agreement(found: Sequence[Predicted]) -> None:
    """Print how often the answer is right by the number of candidates that agree with the
    prediction, in the student's words."""
    print_header("agreeing candidates", "responses", "right")
    for count in range(len(LETTERS) + 1):
        rows = [r for r in found if r.names_deciding is not None and len(r.described) == count]
        share = f"{100 * np.mean([r.answer == r.target for r in rows]):.1f}" if rows else "-"
        print_row(count, len(rows), share)


def print_wrong_answers(runs: Sequence[Path], store: Store) -> None:
    """Print which wrong candidates are chosen and which are offered, in percent."""
    print_header(
        "mode",
        "family or subtype",
        "wrong answers",
        *(f"{kind}: chosen, offered" for kind in KINDS),
    )
    items = store.selection("test")
    for mode in ("reasoning", "answer"):
        responses = [read_item_responses(run, mode) for run in runs]
        for family in ("all", *FAMILIES, *SUBTYPES):
            wrong = [
                (item, run[item.item_id].letter)
                for run in responses
                for item in items
                if family in ("all", item.family, item.subtype)
                and item.item_id in run
                and run[item.item_id].letter not in (None, item.letter)
            ]
            if wrong:
                chosen = Counter(classify_candidate(item, letter) for item, letter in wrong)
                offered = Counter(
                    classify_candidate(item, letter)
                    for item, _ in wrong
                    for letter in LETTERS
                    if letter != item.letter
                )
                cells = (
                    f"{100 * chosen[k] / chosen.total():.1f}, "
                    f"{100 * offered[k] / offered.total():.1f}"
                    for k in KINDS
                )
                print_row(mode, family, len(wrong), *cells)


def classify_candidate(item: SelectionItem, letter: str) -> str:
    """Return which of `KINDS` a wrong candidate is."""
    target, chosen = (item.candidates[LETTERS.index(k)] for k in (item.letter, letter))
    if chosen.source == "alternative":
        return "alternative future"
    if chosen.scene_id != target.scene_id:
        return "another scene"
    return "earlier" if chosen.frame < target.frame else "later"


if __name__ == "__main__":
    with report_failures():
        main()
