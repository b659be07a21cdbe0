"""In which order each annotator is asked the items, and sees the candidates of each."""

from __future__ import annotations

import hashlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from data.records import LETTERS, SelectionItem
from data.selection.drafts import cell_rng


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
    """An item that an annotator has not been asked. `votes` counts the others' answers to it."""

    item_id: str
    family: str
    scene_id: str
    prefix_stop: int
    rank: int
    votes: int


def plan(items: Sequence[SelectionItem], annotators: Sequence[str], seed: int) -> list[Planned]:
    """Every annotator's order of items and candidates.

    For each annotator the right answer stands at each letter equally often, to one, over all items
    and within each family; four annotators in a row have that of an item at four different letters.
    """
    # Who lacks the items cannot work these orders out from the seed.
    digest = hashlib.sha256("\n".join(i.item_id for i in items).encode()).hexdigest()
    shared = cell_rng(seed, "study", digest)
    letters = shared.permutation(len(LETTERS))
    shuffled = [items[k] for k in shared.permutation(len(items))]
    # A run of this cycle holds each letter equally often to one, and a family is such a run.
    by_family = sorted(shuffled, key=lambda item: item.family)
    planned = []
    for turn, annotator in enumerate(annotators):
        rng = cell_rng(seed, "study", digest, annotator)
        ranks = rng.permutation(len(items))
        for k, item in enumerate(by_family):
            place = letters[(k + turn) % len(LETTERS)]
            others = [c for c in range(len(LETTERS)) if c != item.answer]
            order = [others[c] for c in rng.permutation(len(others))]
            order.insert(place, item.answer)
            planned.append(Planned(annotator, item.item_id, int(ranks[k]), tuple(order)))
    return planned


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
