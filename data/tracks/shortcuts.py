"""Shortcuts: strategies that answer selection items without predicting the motion.

A simple strategy chooses the candidate with the lowest or the highest value of one score (see
`data.tracks.selection.shortcut_scores.SCORES`). A logistic model combines all scores; it is trained
on the items of the training split, for each family.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from typing import Any

import numpy as np
from PIL import Image

from data.records import FrameRef, Scene, SelectionItem
from data.render.frame_cache import render_frames
from data.tracks.selection.balanced_items import IMAGE_SIZE
from data.tracks.selection.shortcut_scores import (
    SCORES,
    CandidateFrames,
    compare_candidates,
    rank_shares,
)

SIMPLE = tuple(f"{score}, {end}" for score in SCORES for end in ("lowest", "highest"))
"""Names of the simple strategies."""
PENALTY = 1e-2
"""Weight of the squared coefficients in the loss of the logistic model."""


def item_scores(
    item: SelectionItem, scene_of: Callable[[str], Scene], config: Mapping[str, Any]
) -> np.ndarray:
    """Return the scores (S, 4) of an item's candidates, in the order of `SCORES`.

    Args:
        scene_of: Function that loads a scene by its id.
        config: Settings of the benchmark.
    """
    frames = [FrameRef(item.scene_id, item.prefix_stop), *item.candidates]
    states = [(scene_of(f.scene_id), f.frame) for f in frames]
    images = np.stack([_small_image(*state, config) for state in states])
    compared = CandidateFrames.compare(states, [f.frame for f in frames], images)
    return compared.scores(np.array([[1, 2, 3, 4]]))[:, 0]


def _small_image(scene: Scene, frame: int, config: Mapping[str, Any]) -> np.ndarray:
    """Return a frame as a small (H, W, 3) image, rendered by Bullet if its scene was simulated."""
    width, height = IMAGE_SIZE
    small = {"renderer": "bullet", "width": width, "height": height}
    pixels = render_frames(scene, [frame], {**config, **small})[frame]
    if pixels.shape[:2] == (height, width):
        return pixels
    return np.asarray(Image.fromarray(pixels).resize(IMAGE_SIZE))


def score_simple_strategies(scores: np.ndarray, answers: np.ndarray) -> np.ndarray:
    """Return the score of each simple strategy on each item, (N, 2 S): 1 if it chooses the target,
    otherwise 0.

    If the target is among m candidates with the best score, the strategy scores 1 / m.

    Args:
        scores: (N, S, 4) scores of the candidates.
        answers: (N,) indices of the targets.
    """
    shares = rank_shares(order_target_first(scores, answers))
    return np.stack([shares[..., 0], shares[..., 3]], axis=-1).reshape(len(scores), -1)


def order_target_first(scores: np.ndarray, answers: np.ndarray) -> np.ndarray:
    """Return scores (N, S, 4) with those of the target, whose index is in `answers`, first."""
    order = np.array([[a, *(k for k in range(4) if k != a)] for a in answers.tolist()])
    return np.take_along_axis(scores, order[:, None, :], axis=-1)


def fit_logistic(features: np.ndarray, answers: np.ndarray) -> np.ndarray:
    """Return the coefficients (F,) of a conditional logistic model, by maximum likelihood with a
    small penalty.

    The probability of a candidate is the softmax of its linear score over the four candidates.
    """
    from scipy.optimize import minimize

    rows = np.arange(len(answers))

    def loss(weights: np.ndarray) -> tuple[float, np.ndarray]:
        linear = features @ weights
        linear -= linear.max(axis=-1, keepdims=True)
        odds = np.exp(linear)
        probabilities = odds / odds.sum(axis=-1, keepdims=True)
        likelihood = np.log(probabilities[rows, answers]).mean()
        residual = probabilities.copy()
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
