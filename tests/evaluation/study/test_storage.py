"""The files and the settings of a study; a study that cannot be resumed is refused."""

from __future__ import annotations

import os
import shutil
import sqlite3
import stat
import subprocess
from pathlib import Path

import pytest

from dynapix.conf.schema import StudyCommand
from dynapix.evaluation.study import routes, storage
from tests.evaluation.study.running import ROOT, Server
from tests.user_errors import raises_user_error


@pytest.fixture
def path(tmp_path, prepared_small) -> Path:
    """The database of a copy of the prepared study."""
    shutil.copytree(prepared_small, tmp_path / "study")
    return tmp_path / "study" / storage.DATABASE


def test_a_study_of_another_version_is_refused(path) -> None:
    db = sqlite3.connect(path)
    db.execute(f"PRAGMA user_version = {storage.VERSION + 1}")
    db.close()
    with raises_user_error("unknown-version", contains=str(storage.VERSION + 1)):
        storage.open_study(path)


@pytest.mark.parametrize("content", [b"not a database" * 100, None])
def test_a_damaged_study_is_refused(path, content) -> None:
    complete = path.read_bytes()
    path.write_bytes(content or complete[: len(complete) // 2])
    with raises_user_error("damaged-file", contains=str(path)):
        storage.open_study(path)


def test_only_the_owner_can_read_a_study_whose_creation_is_complete(tmp_path) -> None:
    path, before = tmp_path / storage.DATABASE, os.umask(0)

    def fail():
        yield from ()
        raise KeyboardInterrupt

    try:
        with pytest.raises(KeyboardInterrupt):
            storage.create(path, {}, [], fail(), ["A1"], [])
        with raises_user_error("missing-run"):
            storage.open_study(path)
        storage.create(path, {}, [], [], ["A1"], [])
        db = storage.open_study(path)
    finally:
        os.umask(before)
    storage.write_links(db, tmp_path / storage.LINKS_FILE, "http://here")
    with storage.transaction(db):
        db.execute("INSERT INTO about VALUES ('benchmark', 'tiny')")
    files = list(tmp_path.iterdir())
    assert len(files) == 4
    assert {stat.S_IMODE(file.stat().st_mode) for file in files} == {0o600}


def test_a_failed_transaction_changes_nothing(path) -> None:
    db = storage.open_study(path)

    def fail() -> None:
        with storage.transaction(db):
            db.execute("UPDATE annotator SET consented = 9")
            raise RuntimeError

    with pytest.raises(RuntimeError):
        fail()
    assert db.execute("SELECT max(consented) FROM annotator").fetchone()[0] is None


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
