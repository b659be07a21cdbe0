"""A study that cannot be resumed is refused. A resumed study has lost no data."""

from __future__ import annotations

import os
import shutil
import sqlite3
import stat
import subprocess
from pathlib import Path

import pytest

from dynapix.conf.schema import StudyCommand
from dynapix.evaluation.study import routes, setup, storage
from tests.evaluation.study.running import ROOT, Server
from tests.user_errors import raises_user_error


@pytest.fixture
def path(tmp_path, prepared_small) -> Path:
    """The database of a copy of the prepared study."""
    shutil.copytree(prepared_small, tmp_path / "study")
    return tmp_path / "study" / storage.DATABASE


def modify(path: Path, *statements: str) -> None:
    db = sqlite3.connect(path)
    for statement in statements:
        db.execute(statement)
    db.commit()
    db.close()


def test_a_study_of_another_version_is_refused(path) -> None:
    modify(path, f"PRAGMA user_version = {storage.VERSION + 1}")
    with raises_user_error("unknown-version", contains=str(storage.VERSION + 1)):
        storage.open_study(path)


@pytest.mark.parametrize("content", [b"not a database" * 100, None])
def test_a_damaged_study_is_refused(path, content) -> None:
    if content is None:
        complete = path.read_bytes()
        content = complete[: len(complete) // 2]
    path.write_bytes(content)
    for side_file in path.parent.glob("*.sqlite-*"):
        side_file.unlink()
    with raises_user_error("damaged-file"):
        storage.open_study(path)


def test_an_unreadable_study_is_not_called_damaged(tmp_path) -> None:
    (tmp_path / storage.DATABASE).mkdir()
    with raises_user_error("unreadable-file"):
        storage.open_study(tmp_path / storage.DATABASE)


def test_only_the_owner_can_read_the_files_of_a_study(tmp_path) -> None:
    before = os.umask(0)
    try:
        db = storage.create(tmp_path / storage.DATABASE, {}, [], [], {"A1": "link"}, [])
    finally:
        os.umask(before)
    files = list(tmp_path.iterdir())
    assert len(files) == 3
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}
    db.close()


def test_a_study_whose_creation_was_interrupted_does_not_exist(tmp_path) -> None:
    path = tmp_path / storage.DATABASE
    assert storage.open_study(path) is None
    path.touch()
    assert storage.open_study(path) is None


def test_missing_media_are_encoded_from_the_same_benchmark(path, micro, micro_store) -> None:
    before = path.read_bytes().count(b"IEND")
    modify(path, "DELETE FROM medium WHERE slot = 2")
    cfg = StudyCommand(benchmark=micro, store=str(micro_store.folder.parent), items="4")
    db = storage.open_study(path)
    assert len(storage.items_without_media(db)) == 7
    setup.add_missing_media(cfg, db, path)
    assert storage.items_without_media(db) == []
    db.execute("PRAGMA wal_checkpoint(TRUNCATE)")
    assert path.read_bytes().count(b"IEND") >= before


def test_missing_media_are_not_encoded_from_another_benchmark(path, micro, micro_store) -> None:
    modify(path, "DELETE FROM medium", "UPDATE about SET value = 'x' WHERE key = 'identity'")
    cfg = StudyCommand(benchmark=micro, store=str(micro_store.folder.parent), items="4")
    with raises_user_error("different-builds", contains="7 items"):
        setup.add_missing_media(cfg, storage.open_study(path), path)


def test_a_changed_file_of_items_is_refused(path, tmp_path) -> None:
    db = storage.open_study(path)
    ids = storage.item_ids(db, practice=False)
    file = tmp_path / "items.txt"
    file.write_text("\n".join(ids))
    setup.check_items(StudyCommand(items=str(file)), db)
    file.write_text("\n".join(ids[1:]))
    with raises_user_error("different-items", contains=str(file)):
        setup.check_items(StudyCommand(items=str(file)), db)


def test_practice_items_are_from_the_training_split(micro_store, prepared_small) -> None:
    db = storage.open_study(prepared_small / storage.DATABASE)
    split = {i.item_id: i.split for i in micro_store.selection()}
    assert {split[i] for i in storage.item_ids(db, practice=True)} == {"train"}
    assert {split[i] for i in storage.item_ids(db, practice=False)} == {"test"}
    db.close()


def test_a_failed_transaction_changes_nothing(path) -> None:
    db = storage.open_study(path)

    def fail() -> None:
        with storage.transaction(db):
            db.execute("UPDATE annotator SET rests = 9")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert db.execute("SELECT max(rests) FROM annotator").fetchone()[0] == 0


@pytest.mark.slow
def test_a_port_in_use_ends_the_command_with_an_error(path) -> None:
    server = Server(path.parent, "items=4")
    with routes.listen("127.0.0.1", server.port):
        ended = subprocess.run(
            server.command(), cwd=ROOT, capture_output=True, text=True, timeout=120
        )
    assert ended.returncode == 1
    assert ended.stderr.startswith("error: ")
    assert ended.stderr.endswith("[invalid-address]\n")
    assert f"port={server.port}" in ended.stderr
    assert ended.stderr.count("\n") == 1


@pytest.mark.parametrize(
    ("settings", "named"),
    [
        ({"items": "0"}, "items=0"),
        ({"items": ""}, "items="),
        ({"annotators": 0}, "annotators=0"),
        ({"port": 70000}, "port=70000"),
        ({"public": "study.example.org"}, "public=study.example.org"),
        ({"public": "https://[example"}, "public=https://[example"),
        ({"public": "https://example.org/study"}, "public=https://example.org/study"),
        ({"host": "0.0.0.0"}, "host=0.0.0.0"),
        ({"host": "192.168.1.5", "public": "http://192.168.1.5:8765"}, "host=192.168.1.5"),
        ({"session_days": 0.0}, "session_days=0.0"),
    ],
)
def test_invalid_settings_are_refused(settings, named) -> None:
    [problem] = StudyCommand(**settings).check()
    assert named in problem


@pytest.mark.parametrize(
    ("settings", "address"),
    [
        ({}, "http://127.0.0.1:8765"),
        ({"host": "::1", "port": 80}, "http://[::1]:80"),
        ({"host": "0.0.0.0", "public": "https://a.example/"}, "https://a.example"),
    ],
)
def test_links_begin_with_the_address_that_annotators_reach(settings, address) -> None:
    cfg = StudyCommand(**settings)
    assert cfg.check() == []
    assert cfg.address == address


def test_an_address_of_another_machine_is_refused() -> None:
    with raises_user_error("invalid-address", contains="host=192.0.2.1"):
        routes.listen("192.0.2.1", 8765)
