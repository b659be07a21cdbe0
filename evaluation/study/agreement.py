"""Accuracy of annotators and of their majority, agreement, and decision times.

A majority is strictly more than half of an item's votes. Items without one (1-1, 1-1-1) are
undecided and count as wrong.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from data.records import FAMILIES, LETTERS
from evaluation.metrics.accuracy import accuracy_by_family
from evaluation.study.storage import Vote


def summary(votes: Sequence[Vote], items: int, annotators: Sequence[str]) -> dict[str, Any]:
    """The report of a study, ready for JSON; undefined values are None.

    Args:
        items: Number of items in the study, answered or not.
        annotators: All annotators, with or without votes.

    Returns:
        `items`, `judgments`; `annotators`, those with votes; `depth`, the number of items by their
        number of votes; `accuracy` by annotator, as `evaluation.metrics.accuracy.Accuracy`;
        `majority`, the same over the items with votes, and how many of them are `undecided`;
        `fleiss_kappa` and its `items`, which all annotators answered; `krippendorff_alpha` and its
        `items`, which have two votes or more; and median `seconds` by family.
    """
    by_item = _group(votes, "item_id")
    by_annotator = _group(votes, "annotator")
    choices = [[vote.choice for vote in of_item] for of_item in by_item.values()]
    active = [name for name in annotators if name in by_annotator]
    complete = [c for c in choices if 1 < len(c) == len(active)]
    several = [c for c in choices if len(c) > 1]
    depth = Counter(map(len, choices)) + Counter({0: items - len(choices)})
    return {
        "items": items,
        "judgments": len(votes),
        "annotators": active,
        "depth": {str(count): depth[count] for count in sorted(depth)},
        "accuracy": {name: _accuracy(by_annotator[name]) for name in active},
        "majority": _majority_accuracy(by_item) if by_item else None,
        "fleiss_kappa": {"value": fleiss_kappa(complete), "items": len(complete)},
        "krippendorff_alpha": {"value": krippendorff_alpha(several), "items": len(several)},
        "seconds": median_seconds(votes),
    }


def majority(choices: Sequence[int]) -> int | None:
    """The choice of more than half; None if there is no such choice."""
    choice, count = Counter(choices).most_common(1)[0]
    return choice if 2 * count > len(choices) else None


def fleiss_kappa(items: Sequence[Sequence[int]]) -> float | None:
    """Fleiss' kappa of items with equal numbers of votes, two or more.

    Returns:
        None where it is undefined: no items, single votes, or all votes for one candidate index.

    Raises:
        ValueError: the numbers of votes differ.
    """
    from statsmodels.stats.inter_rater import fleiss_kappa as kappa

    if not items or len(items[0]) < 2:
        return None
    table = _count_choices(items)
    if len(set(table.sum(axis=1))) > 1:
        raise ValueError("Fleiss' kappa needs the same number of votes for every item")
    return None if _is_unanimous(table) else float(kappa(table))


def krippendorff_alpha(items: Sequence[Sequence[int]]) -> float | None:
    """Krippendorff's alpha for nominal votes: one minus the disagreement within items over the
    disagreement between any two votes. Items may differ in their number of votes.

    Returns:
        None where it is undefined: no item has two votes, or all are for one candidate index.
    """
    table = _count_choices([choices for choices in items if len(choices) > 1])
    if not len(table) or _is_unanimous(table):
        return None
    depth, total = table.sum(axis=1), table.sum(axis=0)
    votes = total.sum()
    # Ordered pairs of unequal votes; a pair within an item weighs one over its other votes.
    within = ((depth**2 - (table**2).sum(axis=1)) / (depth - 1)).sum() / votes
    between = (votes**2 - (total**2).sum()) / (votes * (votes - 1))
    return float(1 - within / between)


def median_seconds(votes: Sequence[Vote]) -> dict[str, dict[str, float | int]]:
    """Median decision times by family and clock, over votes whose page was loaded once: the total
    viewing time of the others is unknown."""
    by_family = _group([vote for vote in votes if vote.loads == 1], "family")
    return {
        family: {
            "server": float(np.median([vote.seconds for vote in by_family[family]])),
            "client": float(np.median([vote.client_seconds for vote in by_family[family]])),
            "votes": len(by_family[family]),
        }
        for family in FAMILIES
        if family in by_family
    }


def _accuracy(votes: Sequence[Vote]) -> dict[str, Any]:
    return asdict(accuracy_by_family([vote.family for vote in votes], [v.right for v in votes]))


def _majority_accuracy(by_item: Mapping[str, Sequence[Vote]]) -> dict[str, Any]:
    decisions = [majority([vote.choice for vote in votes]) for votes in by_item.values()]
    first = [votes[0] for votes in by_item.values()]
    correct = [choice == vote.answer for choice, vote in zip(decisions, first, strict=True)]
    accuracy = accuracy_by_family([vote.family for vote in first], correct)
    return {**asdict(accuracy), "undecided": decisions.count(None)}


def _count_choices(items: Sequence[Sequence[int]]) -> np.ndarray:
    """(items, 4) votes for each candidate."""
    rows = [np.bincount(choices, minlength=len(LETTERS)) for choices in items]
    return np.array(rows, dtype=int).reshape(-1, len(LETTERS))


def _is_unanimous(table: np.ndarray) -> bool:
    return np.count_nonzero(table.sum(axis=0)) == 1


def _group(votes: Sequence[Vote], key: str) -> dict[str, list[Vote]]:
    groups: dict[str, list[Vote]] = defaultdict(list)
    for vote in votes:
        groups[getattr(vote, key)].append(vote)
    return groups
