"""A study that cannot be gone on with says so in one sentence; one that can loses nothing."""

from __future__ import annotations

import os
import shutil
import sqlite3
import stat
import subprocess
from pathlib import Path

import pytest

from conf.errors import UserError
from conf.schema import StudyCommand
from evaluation.study import serving, setup, storage
from tests.evaluation.study.running import ROOT, Server


@pytest.fixture
def path(tmp_path, prepared_small) -> Path:
    shutil.copytree(prepared_small, tmp_path / "study")
    return tmp_path / "study" / storage.DATABASE


def changed(path: Path, *statements: str) -> None:
    db = sqlite3.connect(path)
    for statement in statements:
        db.execute(statement)
    db.commit()
    db.close()


def test_a_study_of_another_version_is_refused(path) -> None:
    changed(path, f"PRAGMA user_version = {storage.VERSION + 1}")
    with pytest.raises(UserError, match=f"version {storage.VERSION + 1}, this is version"):
        storage.open_study(path)


def test_another_applications_database_is_refused(tmp_path) -> None:
    path = tmp_path / storage.DATABASE
    changed(path, "CREATE TABLE bookmarks (address TEXT)")
    assert storage.begun(path)
    with pytest.raises(UserError, match="no database of a study"):
        storage.open_study(path)


@pytest.mark.parametrize("content", [b"not a database" * 100, None])
def test_a_damaged_study_is_refused(path, content) -> None:
    if content is None:
        whole = path.read_bytes()
        content = whole[: len(whole) // 2]
    path.write_bytes(content)
    for beside in path.parent.glob("*.sqlite-*"):
        beside.unlink()
    assert storage.begun(path)
    with pytest.raises(UserError, match="damaged"):
        storage.open_study(path)


def test_nobody_else_reads_a_study_that_is_being_made(tmp_path) -> None:
    """SQLite keeps what was written last in files of their own."""
    before = os.umask(0)
    try:
        db = storage.create(tmp_path / storage.DATABASE, {}, [], [], {"A1": "link"}, [])
    finally:
        os.umask(before)
    made = list(tmp_path.iterdir())
    assert len(made) == 3
    assert {stat.S_IMODE(file.stat().st_mode) for file in made} == {0o600}
    db.close()


def test_a_study_whose_creation_was_killed_begins_anew(tmp_path) -> None:
    path = tmp_path / storage.DATABASE
    assert not storage.begun(path)
    path.touch()
    assert not storage.begun(path)


def test_lost_media_are_made_again_from_the_same_benchmark(path, micro, micro_store) -> None:
    before = path.read_bytes().count(b"IEND")
    changed(path, "DELETE FROM medium WHERE slot = 2")
    cfg = StudyCommand(benchmark=micro, store=str(micro_store.folder.parent), items="4")
    db = storage.open_study(path)
    assert len(storage.without_media(db)) == 7
    setup.add_media(cfg, db, path)
    assert storage.without_media(db) == []
    db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert path.read_bytes().count(b"IEND") >= before


def test_lost_media_of_another_benchmark_are_told(path, micro, micro_store) -> None:
    changed(path, "DELETE FROM medium", "UPDATE about SET value = 'x' WHERE key = 'identity'")
    cfg = StudyCommand(benchmark=micro, store=str(micro_store.folder.parent), items="4")
    with pytest.raises(UserError, match=r"of 7 items, and .* is another benchmark"):
        setup.add_media(cfg, storage.open_study(path), path)


def test_a_file_that_names_other_items_by_now_is_told(path, tmp_path) -> None:
    db = storage.open_study(path)
    names = storage.item_ids(db, practice=False)
    file = tmp_path / "items.txt"
    file.write_text("\n".join(names))
    setup.check_names(StudyCommand(items=str(file)), db)
    file.write_text("\n".join(names[1:]))
    with pytest.raises(UserError, match="names other items than this study was begun with"):
        setup.check_names(StudyCommand(items=str(file)), db)


def test_more_items_than_there_are_are_told(micro, micro_store) -> None:
    cfg = StudyCommand(benchmark=micro, items="1000")
    with pytest.raises(UserError, match=r"items=1000 are more .* there are \d+"):
        setup.asked_items(cfg, micro_store)
    cfg = StudyCommand(benchmark=micro, practice=1000)
    with pytest.raises(UserError, match="practice=1000 are more than the training items"):
        setup.practice_items(cfg, micro_store)


def test_practice_is_of_the_training_split(micro_store, prepared_small) -> None:
    db = storage.open_study(prepared_small / storage.DATABASE)
    split = {i.item_id: i.split for i in micro_store.selection()}
    assert {split[i] for i in storage.item_ids(db, practice=True)} == {"train"}
    assert {split[i] for i in storage.item_ids(db, practice=False)} == {"test"}
    db.close()


def test_a_transaction_happens_whole_or_not_at_all(path) -> None:
    db = storage.open_study(path)

    def fail() -> None:
        with storage.transaction(db):
            db.execute("UPDATE annotator SET rests = 9")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert db.execute("SELECT max(rests) FROM annotator").fetchone()[0] == 0


@pytest.mark.slow
def test_a_taken_port_ends_the_command_with_a_sentence(path) -> None:
    server = Server(path.parent, "items=4")
    with serving.listener("127.0.0.1", server.port):
        ended = subprocess.run(server.command(), cwd=ROOT, capture_output=True, text=True)
    assert ended.returncode == 1
    assert ended.stderr == (
        f"error: cannot serve the study: port={server.port} is taken: stop the server there, or "
        "choose another port=\n"
    )


@pytest.mark.parametrize(
    ("settings", "said"),
    [
        ({"items": "0"}, "items=0"),
        ({"items": ""}, "items= "),
        ({"annotators": 0}, "annotators=0 must be 1 or more"),
        ({"port": 70000}, "port=70000"),
        ({"public": "study.example.org"}, "public="),
        ({"public": "https://example.org/study"}, "public="),
        ({"host": "0.0.0.0"}, "host=0.0.0.0"),
    ],
)
def test_settings_that_cannot_work_are_told(settings, said) -> None:
    [problem] = StudyCommand(**settings).check()
    assert said in problem


@pytest.mark.parametrize(
    ("settings", "address"),
    [
        ({}, "http://127.0.0.1:8765"),
        ({"host": "::1", "port": 80}, "http://[::1]:80"),
        ({"host": "0.0.0.0", "public": "https://a.example/"}, "https://a.example"),
    ],
)
def test_links_begin_with_where_annotators_reach_the_study(settings, address) -> None:
    cfg = StudyCommand(**settings)
    assert cfg.check() == []
    assert cfg.address == address


def test_an_address_of_another_machine_is_told() -> None:
    with pytest.raises(UserError, match=r"host=192\.0\.2\.1 is no address of this machine"):
        serving.listener("192.0.2.1", 8765)
