"""What a study's votes say: accuracy of each annotator and of the majority, agreement, time.

Majority is strictly more than half of an item's votes. An item on which no candidate has it (1-1,
1-1-1) is counted wrong, and how many there are is told.
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict
from typing import Any

import numpy as np

from data.records import FAMILIES, LETTERS
from evaluation.metrics.accuracy import accuracy_by_family
from evaluation.study.votes import Vote


def summary(votes: Sequence[Vote], items: int, annotators: Sequence[str]) -> dict[str, Any]:
    """Everything that a report shows of a study, ready for JSON; what is undefined is None.

    Args:
        items: how many the study asks, answered or not.
        annotators: everyone who has an account, whether it was used or not.

    Returns:
        `items`, `judgments`; `annotators`, those who answered; `depth`, how many items have each
        number of votes; `accuracy` by annotator, with `families`, `macro` and `micro` as in
        `evaluation.metrics.accuracy.Accuracy`; `majority`, the same of the items that have a vote,
        and how
        many of them are `undecided`; `fleiss_kappa` with the `items` that all of them answered;
        `krippendorff_alpha` with the `items` of two votes or more; and median `seconds` by family.
    """
    by_item = _grouped(votes, "item_id")
    by_annotator = _grouped(votes, "annotator")
    chosen = {item: [vote.choice for vote in of] for item, of in by_item.items()}
    took_part = [a for a in annotators if a in by_annotator]
    complete = [c for c in chosen.values() if 1 < len(c) == len(took_part)]
    several = [c for c in chosen.values() if len(c) > 1]
    depth = Counter(map(len, chosen.values())) + Counter({0: items - len(chosen)})
    return {
        "items": items,
        "judgments": len(votes),
        "annotators": took_part,
        "depth": {str(votes): depth[votes] for votes in sorted(depth)},
        "accuracy": {a: _accuracy(by_annotator[a]) for a in took_part},
        "majority": _majority_accuracy(by_item) if by_item else None,
        "fleiss_kappa": {"value": fleiss_kappa(complete), "items": len(complete)},
        "krippendorff_alpha": {"value": krippendorff_alpha(several), "items": len(several)},
        "seconds": seconds(votes),
    }


def majority(choices: Sequence[int]) -> int | None:
    """What more than half chose; None where nothing has so many."""
    choice, count = Counter(choices).most_common(1)[0]
    return choice if 2 * count > len(choices) else None


def fleiss_kappa(items: Sequence[Sequence[int]]) -> float | None:
    """Fleiss' kappa of items with the same number of votes each, two or more.

    Returns:
        None where it is undefined: no items, single votes, or all votes for one candidate index.

    Raises:
        ValueError: the numbers of votes differ.
    """
    from statsmodels.stats.inter_rater import fleiss_kappa as kappa

    if not items or len(items[0]) < 2:
        return None
    table = _counts(items)
    if len(set(table.sum(axis=1))) > 1:
        raise ValueError("Fleiss' kappa needs as many votes of every item")
    return None if _unanimous(table) else float(kappa(table))


def krippendorff_alpha(items: Sequence[Sequence[int]]) -> float | None:
    """Krippendorff's alpha for nominal votes, of items with any numbers of them: one minus the
    disagreement within items over the disagreement between any two votes.

    Returns:
        None where it is undefined: no item has two votes, or all are for one candidate index.
    """
    table = _counts([choices for choices in items if len(choices) > 1])
    if not len(table) or _unanimous(table):
        return None
    depth, total = table.sum(axis=1), table.sum(axis=0)
    votes = total.sum()
    # Ordered pairs of unlike votes, those of an item weighted by one over its other votes.
    within = ((depth**2 - (table**2).sum(axis=1)) / (depth - 1)).sum() / votes
    between = (votes**2 - (total**2).sum()) / (votes * (votes - 1))
    return float(1 - within / between)


def seconds(votes: Sequence[Vote]) -> dict[str, dict[str, float | int]]:
    """Median decision times by family, by both clocks, of votes whose page was loaded once: of the
    others nobody knows how long they were looked at."""
    by_family = _grouped([vote for vote in votes if vote.loads == 1], "family")
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
    found = accuracy_by_family([vote.family for vote in votes], [vote.right for vote in votes])
    return asdict(found)


def _majority_accuracy(by_item: Mapping[str, Sequence[Vote]]) -> dict[str, Any]:
    decided = {item: majority([v.choice for v in of]) for item, of in by_item.items()}
    families = [of[0].family for of in by_item.values()]
    right = [decided[item] == of[0].answer for item, of in by_item.items()]
    undecided = sum(choice is None for choice in decided.values())
    return {**asdict(accuracy_by_family(families, right)), "undecided": undecided}


def _counts(items: Sequence[Sequence[int]]) -> np.ndarray:
    """(items, 4) votes for each candidate."""
    rows = [np.bincount(choices, minlength=len(LETTERS)) for choices in items]
    return np.array(rows, dtype=int).reshape(-1, len(LETTERS))


def _unanimous(table: np.ndarray) -> bool:
    return np.count_nonzero(table.sum(axis=0)) == 1


def _grouped(votes: Sequence[Vote], key: str) -> dict[str, list[Vote]]:
    found: dict[str, list[Vote]] = defaultdict(list)
    for vote in votes:
        found[getattr(vote, key)].append(vote)
    return found
