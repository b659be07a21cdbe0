"""Random generators and orders that a seed and names determine."""

from __future__ import annotations

import hashlib
from collections import defaultdict
from collections.abc import Callable, Hashable, Iterable, Iterator
from itertools import count, islice
from typing import TypeVar

import numpy as np

Element = TypeVar("Element")


def named_rng(seed: int, *names: str) -> np.random.Generator:
    """Return a random generator for a seed and names, such as those of a cell. Other names give
    another generator, so that the quota of a cell does not affect other cells."""
    digest = hashlib.sha256("/".join(names).encode()).digest()
    return np.random.default_rng([seed, int.from_bytes(digest[:8], "big")])


def round_robin(queues: Iterable[Iterable[Element]]) -> Iterator[Element]:
    """Yield the next element of each queue in turn, until all are exhausted. An element is computed
    when its turn comes."""
    waiting = [iter(queue) for queue in queues]
    while waiting:
        remaining = []
        for queue in waiting:
            for element in islice(queue, 1):
                yield element
                remaining.append(queue)
        waiting = remaining


def interleave(elements: Iterable[Element], key: Callable[[Element], Hashable]) -> list[Element]:
    """Order elements so that the first element of every key comes first, then the second element of
    every key, and so on."""
    turns: dict[Hashable, Iterator[int]] = defaultdict(count)
    # `sorted` calls its key once for each element, in order.
    return sorted(elements, key=lambda element: next(turns[key(element)]))
