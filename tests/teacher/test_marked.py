"""Claims of 60 rationales, marked by hand by writers who did not know the rules of the reader."""

from __future__ import annotations

from collections import Counter
from functools import cache

import pytest

from teacher.validation.claim_extraction import extract_claims
from tests.teacher.marked import marked_items, read_marked


@cache
def verdicts_by_truth() -> dict[bool, Counter[str]]:
    """The verdicts of the reader on the marked claims that are true, and on those that are false.
    A claim is "missed" if the reader finds no claim in its words."""
    items = {item.item_id: predicates for item, predicates in marked_items()}
    counts = {True: Counter(), False: Counter()}
    for rationale in read_marked():
        claims = extract_claims(rationale["text"], items[rationale["item"]])
        for marked in rationale["claims"]:
            start = rationale["text"].index(marked["quote"])
            stop = start + len(marked["quote"])
            inside = {
                c.verdict
                for c in claims
                if start <= c.span[0] < stop and c.kind not in ("mention", "agrees")
            }
            worst = next((v for v in ("contradicted", "unknown", "supported") if v in inside), None)
            counts[marked["truth"]][worst or "missed"] += 1
    return counts


@pytest.mark.slow
def test_marked_rationales_are_about_the_items() -> None:
    rationales = read_marked()
    assert len({r["item"] for r in rationales}) == len(rationales) == 60
    assert {r["item"] for r in rationales} <= {item.item_id for item, _ in marked_items()}
    for rationale in rationales:
        quotes = [c["quote"] for c in rationale["claims"]]
        assert all(rationale["text"].count(quote) == 1 for quote in quotes)


@pytest.mark.slow
def test_true_claims_are_read_and_not_contradicted() -> None:
    true = verdicts_by_truth()[True]
    assert true.total() > 450
    assert true["contradicted"] <= 0.01 * true.total()
    assert true["supported"] >= 0.85 * true.total()


@pytest.mark.slow
def test_false_claims_are_contradicted_and_not_supported() -> None:
    false = verdicts_by_truth()[False]
    assert false.total() > 180
    assert false["contradicted"] >= 0.9 * false.total()
    assert false["supported"] <= 0.01 * false.total()
