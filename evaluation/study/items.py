"""The items of a study: those that a file names, or a number sampled evenly from the families."""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Sequence
from pathlib import Path

from conf.errors import UserError
from data.records import FAMILIES, SelectionItem
from data.tracks.quota import interleave, named_rng


def read_item_ids(path: Path) -> list[str]:
    """The ids in a file, one a line, plain or as the item_id of a JSON object.

    Raises:
        UserError: the file cannot be read, names no item, or names an item twice.
    """
    try:
        return _parse_item_ids(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise UserError(
            f"items={path}: {error.strerror}; give a number of items, or a file of item ids",
            code="missing-file",
        ) from error
    except ValueError as error:
        reason = "it is not text" if isinstance(error, UnicodeDecodeError) else error
        raise UserError(f"items={path} cannot be read: {reason}", code="invalid-items") from error


def _parse_item_ids(text: str) -> list[str]:
    ids = []
    for number, line in enumerate(text.splitlines(), 1):
        item_id = line.strip()
        try:
            if item_id.startswith("{"):
                item_id = json.loads(item_id)["item_id"]
            if not isinstance(item_id, str):
                raise ValueError
        except (ValueError, KeyError) as error:
            raise ValueError(f"line {number} is not a JSON object with an item_id") from error
        if item_id:
            ids.append(item_id)
    if not ids:
        raise ValueError("it names no item")
    item_id, count = Counter(ids).most_common(1)[0]
    if count > 1:
        raise ValueError(f"it names {item_id} {count} times")
    return ids


def find_items(
    pool: Sequence[SelectionItem], ids: Sequence[str], benchmark: str
) -> list[SelectionItem]:
    """The items of these ids, in their order.

    Raises:
        UserError: `pool`, the test items of `benchmark`, lacks one.
    """
    by_id = {item.item_id: item for item in pool}
    if missing := [item_id for item_id in ids if item_id not in by_id]:
        more = f" ({len(missing) - 1} more are missing)" if len(missing) > 1 else ""
        raise UserError(
            f"item {missing[0]} is not a test item of {benchmark}{more}: name items of its "
            "selection.parquet, or choose another benchmark=",
            code="unknown-item",
        )
    return [by_id[item_id] for item_id in ids]


def sample_items(
    pool: Sequence[SelectionItem], count: int, seed: int, setting: str
) -> list[SelectionItem]:
    """`count` items, the families in turn and the subtypes in turn within a family. Scenes repeat
    only if there are no others: one item's images could answer another item.

    Args:
        setting: The setting that asks for the items, for the error.

    Raises:
        UserError: the pool has fewer items.
    """
    if count > len(pool):
        raise UserError(
            f"{setting}={count} is more than the {len(pool)} items of the benchmark's split",
            code="too-few-items",
        )
    rng = named_rng(seed, "study", "items")
    shuffled = [pool[k] for k in rng.permutation(len(pool))]
    queues = {
        family: interleave([i for i in shuffled if i.family == family], lambda i: i.subtype)
        for family in FAMILIES
    }
    chosen: list[SelectionItem] = []
    used: set[str] = set()
    while len(chosen) < count:
        for queue in [q for q in queues.values() if q][: count - len(chosen)]:
            item = next((i for i in queue if not item_scenes(i) & used), queue[0])
            queue.remove(item)
            used |= item_scenes(item)
            chosen.append(item)
    return chosen


def item_scenes(item: SelectionItem) -> set[str]:
    """Every scene that an item shows a frame of."""
    return {item.scene_id, *(c.scene_id for c in item.candidates)}


def count_shared_scenes(items: Sequence[SelectionItem]) -> int:
    """The number of items that show a scene of another item."""
    counts = Counter(name for item in items for name in item_scenes(item))
    return sum(any(counts[name] > 1 for name in item_scenes(item)) for item in items)
