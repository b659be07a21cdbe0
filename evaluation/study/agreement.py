"""Accuracy of annotators and of their majority, agreement, and decision times.

A majority is strictly more than half of an item's votes. Items without a majority, such as items
with one vote for each of two candidates, are undecided and count as wrong.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
import pandas as pd

from dynapix.data.checks.intervals import SceneBootstrap
from dynapix.data.records import LETTERS
from dynapix.evaluation.metrics.results import (
    Accuracy,
    MajorityVote,
    StudyReport,
    accuracy_by_family,
)


def summarize_votes(
    votes: pd.DataFrame,
    items: int,
    annotators: Sequence[str],
    benchmark: str,
    build: str,
    seed: int,
) -> StudyReport:
    """Return the accuracies, the agreement and the decision times of a study.

    Args:
        votes: As `storage.read_votes` returns them.
        items: Number of items in the study, with or without votes.
        annotators: All annotators, with or without votes.
        benchmark: Name of the study's benchmark.
        build: Identity of the benchmark's build.
        seed: Seed of the bootstrap over scenes.
    """
    # The number of votes for each candidate (items, 4).
    counts = pd.crosstab(votes.item_id, votes.choice)
    counts = counts.reindex(columns=range(len(LETTERS)), fill_value=0)
    depth = counts.sum(axis=1)
    active = [name for name in annotators if name in set(votes.annotator)]
    complete = counts[(depth == len(active)) & (depth > 1)]
    items_by_depth = {0: items - len(counts), **depth.value_counts()}
    votes_of = {name: votes[votes.annotator == name] for name in active}
    accuracy = {name: _accuracy(own, list(own.right), seed) for name, own in votes_of.items()}
    return StudyReport(
        benchmark,
        build,
        items,
        judgments=len(votes),
        annotators=active,
        depth={str(d): int(n) for d, n in sorted(items_by_depth.items()) if n},
        accuracy=accuracy,
        majority=_majority_vote(votes, counts, seed) if len(votes) else None,
        fleiss_kappa=fleiss_kappa(complete),
        kappa_items=len(complete),
        seconds=median_seconds(votes),
    )


def majority(counts: pd.DataFrame) -> pd.Series:
    """Return the candidate with more than half of each item's votes; NaN if there is none."""
    return counts.idxmax(axis=1).where(2 * counts.max(axis=1) > counts.sum(axis=1))


def fleiss_kappa(counts: pd.DataFrame) -> float | None:
    """Return Fleiss' kappa of items that all have the same number of votes, at least two. Return
    None if there are no items, or if all votes are for the same candidate index."""
    from statsmodels.stats.inter_rater import fleiss_kappa as kappa

    return float(kappa(counts.to_numpy())) if np.count_nonzero(counts.sum()) > 1 else None


def median_seconds(votes: pd.DataFrame) -> dict[str, float]:
    """Return median decision times by family. Only votes whose page was loaded once are used: if a
    page was loaded several times, its total viewing time is unknown."""
    return votes[votes.loads == 1].groupby("family").seconds.median().to_dict()


def _accuracy(items: pd.DataFrame, credits: Sequence[float], seed: int) -> Accuracy:
    scenes = SceneBootstrap(list(items.scene_id), seed)
    return accuracy_by_family(list(items.family), credits, scenes)


def _majority_vote(votes: pd.DataFrame, counts: pd.DataFrame, seed: int) -> MajorityVote:
    choices = majority(counts)
    items = votes.groupby("item_id").first().loc[counts.index]
    accuracy = _accuracy(items, list(choices == items.answer), seed)
    return MajorityVote(**vars(accuracy), undecided=int(choices.isna().sum()))
