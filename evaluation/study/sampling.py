"""Which items a study asks: those that a file names, or so many drawn evenly from the families."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from conf.errors import UserError
from data.records import FAMILIES, SelectionItem
from data.tracks.quota import interleave, named_rng


def named(text: str) -> list[str]:
    """The ids in a file's text, one a line, plain or as the item_id of a JSON object.

    Raises:
        ValueError: a line is neither, an id stands there twice, or there is none.
    """
    ids = []
    for number, line in enumerate(text.splitlines(), 1):
        if not line.strip():
            continue
        found = line.strip()
        if found.startswith("{"):
            try:
                found = json.loads(found)["item_id"]
            except (ValueError, KeyError) as error:
                raise ValueError(f"line {number} is no JSON object with an item_id") from error
        if not isinstance(found, str):
            raise ValueError(f"line {number} is no JSON object with an item_id")
        ids.append(found)
    if not ids:
        raise ValueError("it names no item")
    name, times = Counter(ids).most_common(1)[0]
    if times > 1:
        raise ValueError(f"it names {name} {times} times")
    return ids


def read_names(path: Path) -> list[str]:
    """`named` of a file. Raises UserError where it cannot be read."""
    try:
        return named(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(
            f"items={path}: {error.strerror}; give a number of items, or a file of item ids"
        ) from error
    except ValueError as error:
        why = "it is no text" if isinstance(error, UnicodeDecodeError) else error
        raise UserError(f"items={path} cannot be read: {why}") from error


def chosen(pool: Sequence[SelectionItem], names: Sequence[str], where: str) -> list[SelectionItem]:
    """The items of those names, in the order of the names.

    Raises:
        UserError: `pool`, the test items of `where`, lacks one.
    """
    item_of = {item.item_id: item for item in pool}
    if lacking := [name for name in names if name not in item_of]:
        more = f" ({len(lacking) - 1} more such)" if len(lacking) > 1 else ""
        raise UserError(
            f"item {lacking[0]} is no test item of {where}{more}: name items of its "
            "selection.parquet, or choose another benchmark="
        )
    return [item_of[name] for name in names]


def drawn(pool: Sequence[SelectionItem], count: int, seed: int) -> list[SelectionItem]:
    """`count` items, the families in turn and the subtypes in turn within a family. Scenes do not
    come twice while there are others: what one item shows could answer another.

    Raises:
        ValueError: the pool has fewer items.
    """
    if count > len(pool):
        raise ValueError(f"there are {len(pool)}")
    rng = named_rng(seed, "study", "items")
    shuffled = [pool[k] for k in rng.permutation(len(pool))]
    queues = {
        family: interleave([i for i in shuffled if i.family == family], lambda i: i.subtype)
        for family in FAMILIES
    }
    kept: list[SelectionItem] = []
    seen: set[str] = set()
    while len(kept) < count:
        for queue in [q for q in queues.values() if q][: count - len(kept)]:
            item = next((i for i in queue if not scenes(i) & seen), queue[0])
            queue.remove(item)
            seen |= scenes(item)
            kept.append(item)
    return kept


def scenes(item: SelectionItem) -> set[str]:
    """Every scene that an item shows a frame of."""
    return {item.scene_id, *(c.scene_id for c in item.candidates)}


def sharing(items: Sequence[SelectionItem]) -> int:
    """How many items show a scene that another one shows too."""
    shown = Counter(name for item in items for name in scenes(item))
    return sum(any(shown[name] > 1 for name in scenes(item)) for item in items)
