"""Chooses the items of balanced cells so that no combination of scores reveals the targets.

The ranks of a cell's targets are even (`data.items.scores`), but even ranks do
not suffice: targets with the highest score may lead by a smaller margin than distractors do, and
then a combination of scores reveals them. Small deviations of the cells also add up over a family.
So each cell makes more items than its quota (`RESERVE`), and `choose_items` chooses among the items
of a whole family.

If the sums of the targets' relative scores are zero, the best logistic model of these scores is the
one that ignores them, since the gradient of its likelihood is zero there. The sums are measured in
standard deviations (as in a score test), because scores that nearly agree, such as the displacement
of one object and of all objects, have a difference that varies little and can reveal much.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from dynapix.data.items.scores import compare_candidates, rank_excess

RESERVE = 1.15
"""Factor on the quota of a balanced cell: the number of items from which its items are chosen."""
RANK_WEIGHT = 4.0
"""Weight of the squared deviations of the counts of ranks, relative to those of the sums."""
RIDGE = 0.01
"""Added to the variances of the relative scores: some of them are constant, or depend on others."""
SWEEPS = 30
"""Maximum number of times that each chosen item is exchanged for a better one of its cell."""


def choose_items(
    scores: np.ndarray,
    cells: Sequence[str],
    quotas: dict[str, int],
    rng: np.random.Generator,
    eligible: Sequence[int] = (0, 1, 2, 3),
) -> list[int]:
    """Return the indices of the items to keep, in ascending order, up to the quota of each cell.

    The first items of each cell are exchanged for others of the cell as long as this lowers the
    pooled deviation: the squared norm of the sum of the items' deviations (`item_deviations`).

    Args:
        scores: (N, S, 4) scores of the candidates of N items of one family, the target first.
        cells: The cell of each item, a key of `quotas`.
        eligible: The candidates that could be the target as far as their kind tells.
    """
    cell_of = np.array(cells)
    deviations = item_deviations(scores, eligible)
    kept = np.zeros(len(cells), dtype=bool)
    for cell, quota in quotas.items():
        kept[np.flatnonzero(cell_of == cell)[:quota]] = True
    total = deviations[kept].sum(axis=0)
    for _ in range(SWEEPS):
        exchanged = False
        for k in rng.permutation(np.flatnonzero(kept)):
            others = np.flatnonzero(~kept & (cell_of == cell_of[k]))
            totals = total - deviations[k] + deviations[others]
            squared = (totals**2).sum(axis=1)
            if len(others) and squared.min() < (total**2).sum() * (1 - 1e-9):
                best = squared.argmin()
                kept[k], kept[others[best]] = False, True
                total, exchanged = totals[best], True
        if not exchanged:
            break
    return np.flatnonzero(kept).tolist()


def item_deviations(scores: np.ndarray, eligible: Sequence[int] = (0, 1, 2, 3)) -> np.ndarray:
    """Return for each item (N, D) by how much its target differs from a target without shortcuts:
    its relative scores in standard deviations, and for each rank, whether it has the rank. Both are
    relative to the mean of the eligible candidates. `scores` are those of the candidates (N, S, 4),
    the target first."""
    relative = compare_candidates(scores)
    relative = relative - relative[..., list(eligible)].mean(axis=-1, keepdims=True)
    scatter = np.einsum("nfc,ngc->fg", relative, relative) / relative[:, 0].size
    whiten = np.linalg.cholesky(np.linalg.inv(scatter + RIDGE * np.eye(len(scatter))))
    ranks = rank_excess(scores, eligible).reshape(len(scores), -1)
    return np.concatenate([relative[..., 0] @ whiten, math.sqrt(RANK_WEIGHT) * ranks], axis=1)
