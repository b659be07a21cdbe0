"""Shortcuts: strategies that answer selection items without predicting the motion.

A simple strategy chooses the candidate with the lowest or the highest value of one score (see
`data.items.scores.SCORES`). A logistic model combines all scores; it is trained on the items of the
training split, for each family.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from dynapix.data.items.futures.contact import has_ghost
from dynapix.data.items.scores import compare_candidates, order_target_first, rank_shares
from dynapix.data.records import SelectionItem
from dynapix.data.seeded_order import named_rng

PENALTY = 1e-2
"""Weight of the squared coefficients in the loss of the logistic model."""
FOLDS = 10
"""Number of parts of the scenes in a cross-validation."""


def score_simple_strategies(
    names: Sequence[str], scores: np.ndarray, answers: np.ndarray
) -> dict[str, np.ndarray]:
    """Return the score of each simple strategy on each item, (N,): 1 / m if the target is among m
    candidates with the best score, otherwise 0.

    Args:
        names: Names of the S scores.
        scores: (N, S, 4) scores of the candidates.
        answers: (N,) indices of the targets.
    """
    shares = rank_shares(order_target_first(scores, answers))
    ends = {"lowest": 0, "highest": 3}
    return {
        f"{name}, {end}": shares[:, k, rank]
        for k, name in enumerate(names)
        for end, rank in ends.items()
    }


def score_not_the_ghost(items: Sequence[SelectionItem]) -> np.ndarray:
    """Return the expected score (N,) of a guess that excludes the ghost where it is a candidate."""
    return np.array([1 / 3 if has_ghost(item) else 1 / 4 for item in items])


def fit_logistic(features: np.ndarray, answers: np.ndarray) -> np.ndarray:
    """Return the coefficients (F,) of a conditional logistic model, by maximum likelihood with a
    small penalty: the probability of a candidate is the softmax of its linear score over four."""
    from scipy.optimize import minimize
    from scipy.special import softmax

    rows = np.arange(len(answers))

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        residual = softmax(features @ weights, axis=-1)
        likelihood = np.log(residual[rows, answers]).mean()
        residual[rows, answers] -= 1
        gradient = np.einsum("nc,ncf->f", residual, features) / len(rows)
        penalty = PENALTY * (weights**2).sum() / 2
        return penalty - likelihood, gradient + PENALTY * weights

    return minimize(loss, np.zeros(features.shape[-1]), jac=True, method="L-BFGS-B").x


def score_logistic_model(
    items: Sequence[SelectionItem], scores: np.ndarray, answers: np.ndarray
) -> np.ndarray:
    """Return for each item whether the logistic model of its family is right, (N,): NaN for items
    of the training split, on which the models are trained, and of families without such items."""
    right = np.full(len(items), np.nan)
    features = compare_candidates(scores).swapaxes(-2, -1)
    families = np.array([item.family for item in items])
    splits = np.array([item.split for item in items])
    for family in np.unique(families):
        train = (families == family) & (splits == "train")
        test = (families == family) & (splits == "test")
        if train.any():
            weights = fit_logistic(features[train], answers[train])
            right[test] = (features[test] @ weights).argmax(axis=-1) == answers[test]
    return right


def cross_validate_logistic_model(
    items: Sequence[SelectionItem], scores: np.ndarray, answers: np.ndarray
) -> np.ndarray:
    """Return for each item whether the logistic model of its family is right, (N,), when it is
    trained on the items of the scenes of the other folds, of both splits."""
    scenes = sorted({item.scene_id for item in items})
    order = named_rng(0, "folds").permutation(len(scenes))
    fold = {scenes[k]: position % FOLDS for position, k in enumerate(order)}
    right = np.full(len(items), np.nan)
    for held_out in range(FOLDS):
        splits = ["test" if fold[item.scene_id] == held_out else "train" for item in items]
        parted = [replace(i, split=split) for i, split in zip(items, splits, strict=True)]
        tested = score_logistic_model(parted, scores, answers)
        right = np.where(np.isnan(tested), right, tested)
    return right
