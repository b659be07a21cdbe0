"""Each annotator's order of the items, and order of the candidates of each item."""

from __future__ import annotations

import hashlib
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from dynapix.data.records import LETTERS, SelectionItem
from dynapix.data.seeded_order import named_rng


@dataclass(frozen=True)
class Assignment:
    """How one item is presented to one annotator.

    Attributes:
        rank: Random rank of the item; among the items that may come next, the lowest rank is shown.
        order: The index of the candidate at each letter.
    """

    annotator: str
    item_id: str
    rank: int
    order: tuple[int, ...]


def assign_items(
    items: Sequence[SelectionItem], annotators: Sequence[str], seed: int
) -> list[Assignment]:
    """Return an assignment for each annotator and item.

    For each annotator, every letter is correct equally often (up to a difference of one), over all
    items and within each family. The orders of an item are a cyclic Latin square: from each
    annotator to the next, every candidate moves by one letter. Four annotators thus see a candidate
    at four letters, and comparing their pages does not reveal the correct candidate.
    """
    # The item ids are part of the seed, so that the orders cannot be computed without them.
    digest = hashlib.sha256("\n".join(i.item_id for i in items).encode()).hexdigest()
    rng = named_rng(seed, "study", digest)
    assignments = []
    for shift, annotator in enumerate(annotators):
        if shift % len(LETTERS) == 0:
            orders = _balanced_orders(items, rng)
        ranks = named_rng(seed, "study", digest, annotator).permutation(len(items))
        for rank, item in zip(ranks, items, strict=True):
            order = tuple(np.roll(orders[item.item_id], shift).tolist())
            assignments.append(Assignment(annotator, item.item_id, int(rank), order))
    return assignments


def _balanced_orders(
    items: Sequence[SelectionItem], rng: np.random.Generator
) -> dict[str, np.ndarray]:
    """Return a random order of each item's candidates, by item id. If the items are sorted by
    family, the letter of the correct candidate advances by one from each item to the next."""
    shuffled = [items[k] for k in rng.permutation(len(items))]
    start = int(rng.integers(len(LETTERS)))
    orders = {}
    for letter, item in enumerate(sorted(shuffled, key=lambda i: i.family), start):
        order = rng.permutation(len(LETTERS))
        orders[item.item_id] = np.roll(order, letter - order.tolist().index(item.answer))
    return orders
