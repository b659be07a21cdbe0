"""Even ranks of the target among its candidates, and models that look for shortcuts."""

from __future__ import annotations

from collections import Counter

import numpy as np

from dynapix.data.checks.shortcuts import (
    fit_logistic,
    score_logistic_model,
    score_simple_strategies,
)
from dynapix.data.items.futures.balanced_subset import choose_items, item_deviations
from dynapix.data.items.scores import (
    LIMIT,
    SCORES,
    TOLERANCE,
    Balance,
    compare_candidates,
    rank_shares,
)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def test_shares_of_ranks_are_a_distribution_that_splits_ties() -> None:
    shares = rank_shares(np.array([[2.0, 1.0, 3.0, 4.0], [1.0, 1.0, 1.0, 2.0], [5.0] * 4]))
    np.testing.assert_allclose(shares, [[0, 1, 0, 0], [1 / 3, 1 / 3, 1 / 3, 0], [1 / 4] * 4])


def test_nearly_equal_scores_are_lowest_together() -> None:
    """The precision of stored scenes does not decide which candidate is lowest or highest."""
    scores = np.array([[10.0, 10.0004, 12.0, 15.0]])
    _, lowest, highest = compare_candidates(scores)
    assert lowest.tolist() == [1, 1, 0, 0]
    assert highest.tolist() == [0, 0, 0, 1]


def test_balance_keeps_every_count_within_the_limit() -> None:
    random = rng()
    balance, refused = Balance(random), 0
    for _ in range(200):
        # The target is often the lowest, so that an unbalanced choice would reveal it.
        scores = random.normal(size=(len(SCORES), 30, 4))
        scores[..., 0] -= random.uniform(0, 1)
        refused += balance.choose(scores) is None
        assert np.abs(balance.excess).max() <= LIMIT + TOLERANCE * balance.items
    assert balance.items > 150
    only_lowest = np.tile([0.0, 1.0, 2.0, 3.0], (len(SCORES), 1, 1))
    assert [balance.choose(only_lowest) is None for _ in range(4)][-1]


def test_balance_accepts_items_that_make_the_counts_more_even() -> None:
    """If the targets have the lowest rank in all scores too seldom, no item of some other ranks is
    within the limit, but most make the counts more even."""
    random = rng()
    balance = Balance(random)
    balance.excess = np.tile([-LIMIT, LIMIT / 3, LIMIT / 3, LIMIT / 3], (len(SCORES), 1))
    accepted = [
        balance.choose(random.normal(size=(len(SCORES), 12, 4))) is not None for _ in range(40)
    ]
    assert sum(accepted) > 30
    assert np.abs(balance.excess).max() < LIMIT


def test_choice_from_a_pool_fills_quotas_and_removes_a_joint_shortcut() -> None:
    random = rng()
    scores = random.normal(size=(600, len(SCORES), 4))
    # The sum of two scores reveals the target of every second item.
    scores[::2, :2, 0] += 1.5
    cells = random.choice(["a", "b", "c"], size=600).tolist()
    quotas = {"a": 100, "b": 120, "c": 1000}
    kept = choose_items(scores, cells, quotas, random)
    assert Counter(cells[k] for k in kept) == {"a": 100, "b": 120, "c": cells.count("c")}
    assert kept == sorted(set(kept))

    def deviation(chosen: list[int]) -> float:
        return float((item_deviations(scores)[chosen].sum(axis=0) ** 2).sum())

    first = [k for cell, n in quotas.items() for k in np.flatnonzero(np.array(cells) == cell)[:n]]
    assert deviation(kept) < 0.7 * deviation(first)
    fair = random.normal(size=(600, len(SCORES), 4))
    even = item_deviations(fair)[choose_items(fair, ["a"] * 600, {"a": 500}, random)]
    assert np.abs(even.mean(axis=0)).max() < 0.02


def test_simple_strategies_score_shares_of_ties() -> None:
    scores = np.zeros((2, len(SCORES), 4))
    scores[:, 0] = [3.0, 1.0, 2.0, 2.0]
    right = score_simple_strategies(SCORES, scores, np.array([1, 0]))
    np.testing.assert_allclose(right.pop("nearness, lowest"), [1, 0])
    np.testing.assert_allclose(right.pop("nearness, highest"), [0, 1])
    np.testing.assert_allclose([*right.values()], 0.25)


def test_logistic_model_finds_a_shortcut_and_nothing_without_one() -> None:
    random = rng()
    answers = random.integers(4, size=1200)
    scores = random.normal(size=(1200, len(SCORES), 4))
    nothing = fit_logistic(compare_candidates(scores).swapaxes(1, 2), answers)
    assert np.abs(nothing).max() < 0.2
    # The target is slightly high or low in six scores: none alone is decisive.
    rows = np.arange(1200)
    for score in (0, 2, 4):
        scores[rows, score, answers] += 0.6
        scores[rows, score + 1, answers] -= 0.6

    class Item:
        family = "event"

        def __init__(self, split: str) -> None:
            self.split = split

    items = [Item("train" if k < 800 else "test") for k in range(1200)]
    right = score_logistic_model(items, scores, answers)
    assert np.isnan(right[:800]).all()
    simple = score_simple_strategies(SCORES, scores, answers).values()
    assert np.mean(right[800:]) > max(each[800:].mean() for each in simple) + 0.05 > 0.4
