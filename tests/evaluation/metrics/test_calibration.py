import numpy as np
import pytest
from scipy.stats import chi2

from evaluation.metrics.calibration import BINS, measure_calibration, measure_position_bias
from evaluation.metrics.intervals import wilson_interval


def test_one_who_is_sure_and_right_is_calibrated():
    found = measure_calibration([1, 1, 1], [True, True, True])
    assert (found.ece, found.brier, found.n) == (0, 0, 3)
    assert [(b.low, b.high) for b in found.bins] == [(0.9, 1.0)]


def test_one_who_is_sure_and_wrong_could_not_be_worse():
    assert measure_calibration([1, 1], [False, False]).ece == 1
    assert measure_calibration([0, 1], [True, False]).brier == 1


def test_one_who_always_says_the_same_is_off_by_the_difference():
    right = [True] * 13 + [False] * 7
    found = measure_calibration([0.8] * 20, right)
    assert found.ece == pytest.approx(0.8 - 0.65)
    # The Brier score is the outcome's variance and the square of the bias.
    assert found.brier == pytest.approx(0.65 * 0.35 + 0.15**2)
    [only] = found.bins
    assert (only.accuracy.low, only.accuracy.high) == wilson_interval(13, 20)


def test_one_who_knows_how_sure_to_be_comes_close_to_zero():
    rng = np.random.default_rng(0)
    told = rng.random(200_000)
    found = measure_calibration(told, rng.random(200_000) < told)
    assert found.ece < 0.01
    # Of a calibrated share p the mean of p (1 - p), which is a sixth over all shares.
    assert found.brier == pytest.approx(1 / 6, abs=0.003)
    assert len(found.bins) == BINS
    assert sum(b.accuracy.n for b in found.bins) == found.n


def test_order_says_nothing_and_every_confidence_has_one_bin():
    rng = np.random.default_rng(1)
    told, right = rng.integers(11, size=300) / 10, rng.random(300) < 0.5
    order = rng.permutation(300)
    found = measure_calibration(told, right)
    assert measure_calibration(told[order], right[order]).brier == pytest.approx(found.brier)
    for b in found.bins:
        top = b.high if b.high < 1 else 2
        assert b.accuracy.n == ((told >= b.low - 1e-9) & (told < top - 1e-9)).sum()


@pytest.mark.parametrize(("told", "right"), [([0.5], []), ([1.1], [1]), ([float("nan")], [1])])
def test_what_is_no_confidence_is_refused(told, right):
    with pytest.raises(ValueError, match="confidences from 0 to 1"):
        measure_calibration(told, right)


def test_nothing_has_no_calibration():
    assert measure_calibration([], []) is None


def test_letters_are_held_against_those_that_are_right():
    right = list("AABBCCDD" * 5)
    found = measure_position_bias(["A"] * 40, right)
    assert found.chosen == {"A": 40, "B": 0, "C": 0, "D": 0}
    assert found.right == dict.fromkeys("ABCD", 10)
    assert found.hits == {"A": 10, "B": 0, "C": 0, "D": 0}
    # (40 - 10)^2 / 10 + 3 * 10^2 / 10, over three degrees of freedom.
    assert found.chi_square == pytest.approx(120)
    assert found.p == pytest.approx(chi2.sf(120, 3))
    assert measure_position_bias(right, right).p == 1
    # What is right may stand where it likes.
    skewed = list("AAAAAABBCD")
    assert measure_position_bias(skewed, skewed).chi_square == 0


def test_items_without_a_choice_count_as_items():
    found = measure_position_bias([None, "A", None, "C"], list("ABCD"))
    assert sum(found.chosen.values()) == 2
    assert found.chi_square == pytest.approx(4 * 0.5**2 / 0.5)


def test_where_nothing_can_be_tested_nothing_is():
    assert measure_position_bias([None] * 4, list("ABCD")).p is None
    assert measure_position_bias(list("AAB"), list("AAB")).p is None
    with pytest.raises(ValueError, match=r"shorter|longer"):
        measure_position_bias(["A"], [])


def test_a_fair_chooser_is_seldom_called_biased():
    rng = np.random.default_rng(2)
    right = list("ABCD" * 100)
    ps = [measure_position_bias(list(rng.choice(list("ABCD"), 400)), right).p for _ in range(400)]
    assert 0.02 < np.mean(np.array(ps) < 0.05) < 0.09
