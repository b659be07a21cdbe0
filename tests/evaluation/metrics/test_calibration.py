import numpy as np
import pytest

from dynapix.evaluation.metrics.calibration import measure_calibration, measure_position_bias


def test_certain_answers_are_calibrated_if_they_are_correct():
    found = measure_calibration([1, 1, 1], [True, True, True])
    assert (found.confidence, found.accuracy, found.ece, found.brier, found.n) == (1, 1, 0, 0, 3)
    assert measure_calibration([1, 1], [False, False]).ece == 1
    assert measure_calibration([], []) is None


def test_the_calibration_error_of_a_constant_confidence_is_its_difference_from_the_accuracy():
    found = measure_calibration([0.8] * 20, [True] * 13 + [False] * 7)
    assert found.ece == pytest.approx(0.8 - 0.65)
    # The Brier score is the variance of the correctness plus the square of the difference.
    assert found.brier == pytest.approx(0.65 * 0.35 + 0.15**2)


def test_the_calibration_error_of_calibrated_confidences_is_close_to_zero():
    rng = np.random.default_rng(0)
    confidence = rng.random(200_000)
    found = measure_calibration(confidence, rng.random(200_000) < confidence)
    assert found.ece < 0.01
    # The Brier score of a calibrated confidence p is p (1 - p). Its mean over p from 0 to 1 is 1/6.
    assert found.brier == pytest.approx(1 / 6, abs=0.003)


def test_the_calibration_error_is_the_mean_over_bins_weighted_by_their_answers():
    confidence, correct = [0.05, 0.15, 0.15, 0.95, 1], [1, 0, 1, 1, 0]
    # The terms are those of the bins that begin at 0, 0.1 and 0.9.
    expected = (0.95 + 2 * abs(0.15 - 0.5) + 2 * abs(0.975 - 0.5)) / 5
    for order in ([0, 1, 2, 3, 4], [4, 2, 0, 3, 1]):
        found = measure_calibration(np.array(confidence)[order], np.array(correct)[order])
        assert found.ece == pytest.approx(expected)


def test_position_bias_counts_chosen_and_correct_letters():
    found = measure_position_bias(["A"] * 39 + [None], list("AABBCCDD" * 5))
    assert found.chosen == {"A": 39, "B": 0, "C": 0, "D": 0}
    assert found.right == dict.fromkeys("ABCD", 10)
    assert found.hits == {"A": 10, "B": 0, "C": 0, "D": 0}
