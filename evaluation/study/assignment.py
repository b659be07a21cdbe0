"""The order of the items for each annotator, and the letters of their candidates."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from data.records import LETTERS, SelectionItem
from data.tracks.quota import named_rng


@dataclass(frozen=True)
class Assignment:
    """An item of an annotator.

    Attributes:
        rank: Among items that may come next, the lowest rank comes first.
        order: The index of the candidate at each letter.
    """

    annotator: str
    item_id: str
    rank: int
    order: tuple[int, ...]


def assign_items(
    items: Sequence[SelectionItem], annotators: Sequence[str], seed: int
) -> list[Assignment]:
    """Return every annotator's order of items and candidates, by a cyclic Latin square.

    The correct answers of an annotator are equally frequent at each letter, within one, over all
    items and within each family. Each candidate of an item moves by one letter from one annotator
    to the next, so that four annotators see it at four letters and comparing their pages does not
    reveal the correct one.
    """
    # The item ids are part of the seed: without them nobody can compute the orders.
    digest = hashlib.sha256("\n".join(i.item_id for i in items).encode()).hexdigest()
    rng = named_rng(seed, "study", digest)
    assignments = []
    for turn, annotator in enumerate(annotators):
        if turn % len(LETTERS) == 0:
            orders = _balanced_orders(items, rng)
        ranks = named_rng(seed, "study", digest, annotator).permutation(len(items))
        for rank, item in zip(ranks, items, strict=True):
            order = tuple(np.roll(orders[item.item_id], turn).tolist())
            assignments.append(Assignment(annotator, item.item_id, int(rank), order))
    return assignments


def _balanced_orders(
    items: Sequence[SelectionItem], rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return a random order of each item's candidates. The letter of the correct answer advances by
    one from item to item, family after family."""
    shuffled = [items[k] for k in rng.permutation(len(items))]
    start = int(rng.integers(len(LETTERS)))
    orders = {}
    for letter, item in enumerate(sorted(shuffled, key=lambda i: i.family), start):
        order = rng.permutation(len(LETTERS))
        orders[item.item_id] = np.roll(order, letter - order.tolist().index(item.answer))
    return orders
