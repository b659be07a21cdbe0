"""Claims of 60 rationales, marked by hand by writers who did not know the rules of the reader."""

from __future__ import annotations

import pytest

from tests.teacher.marked import verdicts_by_truth


@pytest.mark.slow
def test_true_claims_are_read_and_not_contradicted() -> None:
    true = verdicts_by_truth()[True]
    assert true.total() > 450
    assert true["contradicted"] <= 0.01 * true.total()
    assert true["supported"] >= 0.7 * true.total()


@pytest.mark.slow
def test_false_claims_are_contradicted_and_not_supported() -> None:
    false = verdicts_by_truth()[False]
    assert false.total() > 180
    assert false["contradicted"] >= 0.85 * false.total()
    assert false["supported"] <= 0.01 * false.total()
