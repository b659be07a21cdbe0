import numpy as np
import pytest
from scipy.stats import chi2

from evaluation.metrics.calibration import BINS, measure_calibration, measure_position_bias
from evaluation.metrics.intervals import wilson_interval


def test_certain_and_correct_answers_are_calibrated():
    found = measure_calibration([1, 1, 1], [True, True, True])
    assert (found.ece, found.brier, found.n) == (0, 0, 3)
    assert measure_calibration([1, 1], [False, False]).ece == 1
    assert measure_calibration([], []) is None
    assert [(b.low, b.high) for b in found.bins] == [(0.9, 1.0)]


def test_the_error_of_a_constant_confidence_is_its_difference_from_the_accuracy():
    right = [True] * 13 + [False] * 7
    found = measure_calibration([0.8] * 20, right)
    assert found.ece == pytest.approx(0.8 - 0.65)
    # The Brier score is the outcome's variance and the square of the bias.
    assert found.brier == pytest.approx(0.65 * 0.35 + 0.15**2)
    [only] = found.bins
    assert (only.accuracy.low, only.accuracy.high) == wilson_interval(13, 20)


def test_the_error_of_calibrated_confidences_is_close_to_zero():
    rng = np.random.default_rng(0)
    confidence = rng.random(200_000)
    found = measure_calibration(confidence, rng.random(200_000) < confidence)
    assert found.ece < 0.01
    # Of a calibrated share p the mean of p (1 - p), which is a sixth over all shares.
    assert found.brier == pytest.approx(1 / 6, abs=0.003)
    assert len(found.bins) == BINS
    assert sum(b.accuracy.n for b in found.bins) == found.n


def test_order_does_not_matter_and_every_confidence_has_one_bin():
    rng = np.random.default_rng(1)
    confidence, right = rng.integers(11, size=300) / 10, rng.random(300) < 0.5
    order = rng.permutation(300)
    found = measure_calibration(confidence, right)
    assert measure_calibration(confidence[order], right[order]).brier == pytest.approx(found.brier)
    for b in found.bins:
        top = b.high if b.high < 1 else 2
        assert b.accuracy.n == ((confidence >= b.low - 1e-9) & (confidence < top - 1e-9)).sum()


def test_letters_are_compared_with_the_correct_letters():
    right = list("AABBCCDD" * 5)
    found = measure_position_bias(["A"] * 40, right)
    assert found.chosen == {"A": 40, "B": 0, "C": 0, "D": 0}
    assert found.right == dict.fromkeys("ABCD", 10)
    assert found.hits == {"A": 10, "B": 0, "C": 0, "D": 0}
    # (40 - 10)^2 / 10 + 3 * 10^2 / 10, over three degrees of freedom.
    assert found.chi_square == pytest.approx(120)
    assert found.p == pytest.approx(chi2.sf(120, 3))
    assert measure_position_bias(right, right).p == 1
    # The correct letters need not be balanced.
    skewed = list("AAAAAABBCD")
    assert measure_position_bias(skewed, skewed).chi_square == 0


def test_items_without_a_choice_count_as_items():
    found = measure_position_bias([None, "A", None, "C"], list("ABCD"))
    assert sum(found.chosen.values()) == 2
    assert found.chi_square == pytest.approx(4 * 0.5**2 / 0.5)


def test_p_is_none_without_choices_or_with_a_letter_that_is_never_correct():
    assert measure_position_bias([None] * 4, list("ABCD")).p is None
    assert measure_position_bias(list("AAB"), list("AAB")).p is None


def test_random_letters_are_seldom_called_biased():
    rng = np.random.default_rng(2)
    right = list("ABCD" * 100)
    ps = [measure_position_bias(list(rng.choice(list("ABCD"), 400)), right).p for _ in range(400)]
    assert 0.02 < np.mean(np.array(ps) < 0.05) < 0.09
