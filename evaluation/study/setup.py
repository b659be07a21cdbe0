"""Begins a study, or finds it as it was left, and makes what its pages show."""

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
from evaluation.study import auth, sampling, storage
from evaluation.study.assignment import plan
from evaluation.study.media import media_of

log = logging.getLogger(__name__)


def begin(cfg: StudyCommand, path: Path) -> sqlite3.Connection:
    """A new study of the test items that `items` names or counts. Raises UserError."""
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    items = asked_items(cfg, store)
    practice = practice_items(cfg, store)
    if shared := sampling.sharing(items):
        log.warning(
            "%d of %d items show a scene that another one shows too: of one scene the earliest is "
            "asked first",
            shared,
            len(items),
        )
    names = auth.annotator_names(cfg.annotators)
    planned = plan(items, names, cfg.seed) + plan(practice, names, cfg.seed)
    links = {name: auth.new_token() for name in names}
    noted = {"benchmark": store.name, "identity": store.identity}
    return storage.create(path, noted, items, practice, links, planned)


def add_media(cfg: StudyCommand, db: sqlite3.Connection, path: Path) -> None:
    """Encode what is still to be shown of the items, all of it at a study's beginning.

    Raises:
        UserError: the benchmark is another one by now, or lacks the frames.
    """
    lacking = storage.without_media(db)
    if not lacking:
        return
    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    if store.identity != storage.about(db)["identity"]:
        raise UserError(
            f"{path} lacks what it shows of {len(lacking)} items, and {store.folder} is another "
            "benchmark than the one it was begun with: begin another study with run=NAME"
        )
    item_of = {i.item_id: i for suite in suites(store) for i in store.selection(suite=suite)}
    frames = FrameReader(store)
    total = len(storage.item_ids(db, False)) + len(storage.item_ids(db, True))
    with tqdm(total=total, initial=total - len(lacking), desc="encoding items", unit="item") as bar:
        for item_id in lacking:
            storage.add_media(db, item_id, media_of(item_of[item_id], frames))
            bar.update()


def asked_items(cfg: StudyCommand, store: Store) -> list[SelectionItem]:
    """The test items that `items` names or counts. Raises UserError."""
    if not cfg.items.isdecimal():
        pool = [i for suite in suites(store) for i in store.selection("test", suite)]
        return sampling.chosen(pool, sampling.read_names(Path(cfg.items)), str(store.folder))
    try:
        return sampling.drawn(store.selection("test"), int(cfg.items), cfg.seed)
    except ValueError as error:
        raise UserError(
            f"items={cfg.items} are more than the test items of {store.folder}: {error}"
        ) from error


def practice_items(cfg: StudyCommand, store: Store) -> list[SelectionItem]:
    """Items of the training split. Raises UserError where there are not so many."""
    try:
        return sampling.drawn(store.selection("train"), cfg.practice, cfg.seed)
    except ValueError as error:
        raise UserError(
            f"practice={cfg.practice} are more than the training items of {store.folder}: {error}"
        ) from error


def check_names(cfg: StudyCommand, db: sqlite3.Connection) -> None:
    """Raises UserError where the file of `items` names others than those that are asked."""
    if cfg.items.isdecimal():
        return
    if sampling.read_names(Path(cfg.items)) != storage.item_ids(db, practice=False):
        raise UserError(
            f"items={cfg.items} names other items than this study was begun with: bring the file "
            "back, or begin another study with run=NAME"
        )


def suites(store: Store) -> list[str]:
    """Suites whose items a study may ask."""
    from data.tracks.controls import MATCHED_ANCHOR

    return [store.suite, MATCHED_ANCHOR]
