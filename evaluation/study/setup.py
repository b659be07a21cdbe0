"""Creates a study and encodes the media of its items."""

from __future__ import annotations

import logging
import sqlite3
from pathlib import Path

from tqdm import tqdm

from conf.errors import UserError
from conf.schema import StudyCommand
from data.build import ensure_benchmark
from data.records import SelectionItem
from data.render.frame_cache import FrameReader
from data.store import Store
from data.tracks.controls import MATCHED_ANCHOR
from evaluation.study import auth, storage
from evaluation.study.assignment import assign_items
from evaluation.study.items import count_shared_scenes, find_items, read_item_ids, sample_items
from evaluation.study.media import encode_media

log = logging.getLogger(__name__)


def create_study(cfg: StudyCommand, path: Path) -> sqlite3.Connection:
    """A new study, still without media. Raises UserError."""
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    items = choose_items(cfg, store)
    practice = sample_items(store.selection("train"), cfg.practice, cfg.seed, "practice")
    if shared := count_shared_scenes(items):
        log.warning(
            "%d of %d items show a scene of another item; of one scene, the earliest prefix comes "
            "first",
            shared,
            len(items),
        )
    names = [f"A{k + 1}" for k in range(cfg.annotators)]
    assignments = [a for of in (items, practice) for a in assign_items(of, names, cfg.seed)]
    links = {name: auth.new_token() for name in names}
    about = {"benchmark": store.name, "identity": store.identity}
    return storage.create(path, about, items, practice, links, assignments)


def add_missing_media(cfg: StudyCommand, db: sqlite3.Connection, path: Path) -> None:
    """Encode the media that the study lacks: all of them for a new study.

    Raises:
        UserError: the benchmark was rebuilt, or lacks the frames.
    """
    missing = storage.items_without_media(db)
    if not missing:
        return
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    if store.identity != storage.read_about(db)["identity"]:
        raise UserError(
            f"{path} lacks the images and videos of {len(missing)} items, and {store.folder} is "
            "another benchmark than the study's: start another study with run=NAME",
            code="different-builds",
        )
    by_id = {i.item_id: i for i in store.selection() + store.selection(suite=MATCHED_ANCHOR)}
    frames = FrameReader(store)
    total = len(storage.item_ids(db, False)) + len(storage.item_ids(db, True))
    with tqdm(total=total, initial=total - len(missing), desc="encoding items", unit="item") as bar:
        for item_id in missing:
            storage.add_media(db, item_id, encode_media(by_id[item_id], frames))
            bar.update()


def choose_items(cfg: StudyCommand, store: Store) -> list[SelectionItem]:
    """The test items that `items` names or counts. Raises UserError."""
    if cfg.items.isdecimal():
        return sample_items(store.selection("test"), int(cfg.items), cfg.seed, "items")
    pool = store.selection("test") + store.selection("test", MATCHED_ANCHOR)
    return find_items(pool, read_item_ids(Path(cfg.items)), str(store.folder))


def check_items(cfg: StudyCommand, db: sqlite3.Connection) -> None:
    """Raises UserError if the file `items` names other items than those of the study."""
    if cfg.items.isdecimal():
        return
    if read_item_ids(Path(cfg.items)) != storage.item_ids(db, practice=False):
        raise UserError(
            f"items={cfg.items} names other items than the study in this run has: restore the "
            "file, or start another study with run=NAME",
            code="different-items",
        )
