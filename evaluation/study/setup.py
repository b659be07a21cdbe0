"""Create a study: choose its items and encode their media."""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path

from tqdm import tqdm

from dynapix.conf.errors import UserError
from dynapix.conf.schema import StudyCommand
from dynapix.conf.schema.benchmark import MATCHED_ANCHOR
from dynapix.data.build import ensure_benchmark
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import FAMILIES, SelectionItem
from dynapix.data.seeded_order import interleave, named_rng
from dynapix.data.store import Store
from dynapix.evaluation.study import storage
from dynapix.evaluation.study.assignment import assign_items
from dynapix.evaluation.study.media import encode_media


def create_study(cfg: StudyCommand, path: Path) -> None:
    """Create a study. Raises UserError if its items cannot be chosen or their frames be read."""
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    items = choose_items(cfg, store)
    names = [f"A{k + 1}" for k in range(cfg.annotators)]
    about = {"benchmark": store.name, "identity": store.identity}
    frames = FrameReader(store)
    media = (
        (item.item_id, medium)
        for item in tqdm(items, desc="encoding items", unit="item")
        for medium in encode_media(item, frames)
    )
    storage.create(path, about, items, media, names, assign_items(items, names, cfg.seed))


def choose_items(cfg: StudyCommand, store: Store) -> list[SelectionItem]:
    """Return the test items that `cfg.items` lists, or as many as it says. Raises UserError."""
    if cfg.items.isdecimal():
        return sample_items(store.selection("test"), int(cfg.items), cfg.seed)
    pool = store.selection("test") + store.selection("test", MATCHED_ANCHOR)
    by_id = {item.item_id: item for item in pool}
    ids = read_item_ids(Path(cfg.items))
    if missing := [item_id for item_id in ids if item_id not in by_id]:
        more = f" ({len(missing) - 1} more are missing)" if len(missing) > 1 else ""
        raise UserError(
            f"item {missing[0]} is not a test item of {store.folder}{more}: list items of its "
            "selection.parquet, or give another benchmark=NAME",
            code="unknown-item",
        )
    return [by_id[item_id] for item_id in ids]


def read_item_ids(path: Path) -> list[str]:
    """Return the item ids in a file, one in each line. Raises UserError if it cannot be read."""
    try:
        lines = path.read_text("utf-8-sig").splitlines()
    except (OSError, UnicodeDecodeError) as error:
        raise UserError(
            f"items={path} cannot be read ({error}): give a number of items, or a file with one "
            "item_id per line",
            code="invalid-items",
        ) from error
    ids = list(dict.fromkeys(line.strip() for line in lines if line.strip()))
    if not ids:
        raise UserError(
            f"items={path} lists no item: give one item_id per line", code="invalid-items"
        )
    return ids


def sample_items(pool: Sequence[SelectionItem], count: int, seed: int) -> list[SelectionItem]:
    """Sample `count` items, spread evenly over the families, and over the subtypes of a family.

    The images of an item could answer another item of the same scene. An item whose scenes were
    already used is therefore sampled only if its family has no other items left.

    Raises:
        UserError: `pool` has fewer than `count` items.
    """
    if count > len(pool):
        raise UserError(
            f"items={count} is more than the {len(pool)} items of the benchmark's split: "
            "lower it, or choose a larger benchmark",
            code="too-few-items",
        )
    rng = named_rng(seed, "study", "items")
    shuffled = [pool[k] for k in rng.permutation(len(pool))]
    queues = [
        interleave([i for i in shuffled if i.family == family], lambda i: i.subtype)
        for family in FAMILIES
    ]
    chosen: list[SelectionItem] = []
    used: set[str] = set()
    while len(chosen) < count:
        for queue in [q for q in queues if q][: count - len(chosen)]:
            item = next((i for i in queue if not item_scenes(i) & used), queue[0])
            queue.remove(item)
            used |= item_scenes(item)
            chosen.append(item)
    return chosen


def item_scenes(item: SelectionItem) -> set[str]:
    """Return the scenes whose frames an item shows."""
    return {item.scene_id, *(c.scene_id for c in item.candidates)}
