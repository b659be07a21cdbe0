"""In which order each annotator is asked the items, and sees the candidates of each."""

from __future__ import annotations

import hashlib
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from itertools import chain, permutations

import numpy as np

from data.records import LETTERS, SelectionItem
from data.tracks.quota import named_rng

Column = tuple[int, ...]
"""The letters, by number, at which a candidate stands for four annotators."""
COLUMNS: list[Column] = list(permutations(range(len(LETTERS))))


@dataclass(frozen=True)
class Planned:
    """One item for one annotator. `order` holds at each letter's place the index of the candidate
    that is shown there; of two items that may both come next, the one of lower `rank` does."""

    annotator: str
    item_id: str
    rank: int
    order: tuple[int, ...]


@dataclass(frozen=True)
class Waiting:
    """An item that an annotator has not been asked. `votes` counts the others' answers
    to it, and those who have it open."""

    item_id: str
    family: str
    scene_id: str
    prefix_stop: int
    rank: int
    votes: int


def plan(items: Sequence[SelectionItem], annotators: Sequence[str], seed: int) -> list[Planned]:
    """Every annotator's order of items and candidates.

    For each annotator the right answer stands at each letter equally often, to one, over all items
    and within each family. Of each four annotators in a row every candidate of an item stands at
    four different letters, so that who lays pages side by side sees all of them move alike.
    """
    # Who lacks the items cannot work these orders out from the seed.
    digest = hashlib.sha256("\n".join(i.item_id for i in items).encode()).hexdigest()
    shared = named_rng(seed, "study", digest)
    shuffled = [items[k] for k in shared.permutation(len(items))]
    fours, left_over = [], []
    for family in sorted({item.family for item in items}):
        of = [item for item in shuffled if item.family == family]
        rest = len(of) % len(LETTERS)
        left_over.append(of[:rest])
        fours += [[of[k : k + len(LETTERS)]] for k in range(rest, len(of), len(LETTERS))]
    orders: dict[str, list[tuple[int, ...]]] = {item.item_id: [] for item in items}
    for _ in range(0, len(annotators), len(LETTERS)):
        for groups in [*fours, left_over]:
            columns = _right_answers([len(group) for group in groups], shared)
            for item, places in zip(chain.from_iterable(groups), columns, strict=True):
                orders[item.item_id] += _orders(item.answer, places, shared)
    planned = []
    for turn, annotator in enumerate(annotators):
        ranks = named_rng(seed, "study", digest, annotator).permutation(len(items))
        for rank, item in zip(ranks, items, strict=True):
            planned.append(Planned(annotator, item.item_id, int(rank), orders[item.item_id][turn]))
    return planned


def _right_answers(groups: Sequence[int], rng: np.random.Generator) -> list[Column]:
    """Columns of the right answers of groups of items, drawn until they are even: each annotator's
    differ within a group of at most four, and over all groups are equally often at each letter, to
    one."""
    of = [group for group, size in enumerate(groups) for _ in range(size)]
    least, most = len(of) // len(LETTERS), -(-len(of) // len(LETTERS))
    found: list[Column] = []

    def fits(column: Column) -> bool:
        group = of[len(found)]
        for annotator, place in enumerate(column):
            taken = [g for c, g in zip(found, of, strict=False) if c[annotator] == place]
            if group in taken or len(taken) == most:
                return False
        return True

    def fill() -> bool:
        if len(found) == len(of):
            each = [Counter(places) for places in zip(*found, strict=True)]
            return all(count[place] >= least for count in each for place in range(len(LETTERS)))
        for k in rng.permutation(len(COLUMNS)):
            if fits(COLUMNS[k]):
                found.append(COLUMNS[k])
                if fill():
                    return True
                found.pop()
        return False

    fill()
    return found


def _orders(answer: int, places: Column, rng: np.random.Generator) -> list[tuple[int, ...]]:
    """What four annotators see at each letter of an item whose right answer stands at `places`."""
    columns = {answer: places}
    for k in rng.permutation(len(LETTERS)):
        if k != answer:
            taken = list(zip(*columns.values(), strict=True))
            free = [c for c in COLUMNS if all(p not in t for p, t in zip(c, taken, strict=True))]
            columns[int(k)] = free[rng.integers(len(free))]
    candidates = sorted(columns)
    return [
        tuple(sorted(candidates, key=lambda c, turn=turn: columns[c][turn]))
        for turn in range(len(LETTERS))
    ]


def next_item(
    waiting: Sequence[Waiting], asked: Mapping[str, int], total: Mapping[str, int]
) -> str:
    """The item that an annotator is asked next.

    The families come evenly, so that who stops early has answered each in proportion; within one
    the item with the fewest answers, so that depth grows evenly. Of one scene the earliest prefix
    comes first: a later one shows what became of it.

    Args:
        waiting: at least one.
        asked, total: items of each family that the annotator was asked, and that there are.
    """
    first: dict[str, int] = {}
    for item in waiting:
        first[item.scene_id] = min(item.prefix_stop, first.get(item.scene_id, item.prefix_stop))
    ready = [item for item in waiting if item.prefix_stop == first[item.scene_id]]
    best = min(
        ready,
        key=lambda item: (asked.get(item.family, 0) / total[item.family], item.votes, item.rank),
    )
    return best.item_id
