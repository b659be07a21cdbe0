"""Studies of the benchmark `micro`, which are prepared once, and servers of copies of them."""

from __future__ import annotations

import shutil
from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from dynapix.conf.schema import StudyCommand
from dynapix.evaluation.study import setup, storage
from tests.evaluation.study.running import Server, Visitor

ITEMS = 59
SMALL = 4


def prepare(micro, micro_store, root: Path, items: int) -> Path:
    """Create a study, and return its run folder."""
    cfg = StudyCommand(
        benchmark=micro, store=str(micro_store.folder.parent), items=str(items), annotators=3
    )
    folder = root / "study" / str(items)
    folder.mkdir(parents=True)
    setup.create_study(cfg, folder / storage.DATABASE)
    return folder


@pytest.fixture(scope="session")
def prepared(tmp_path_factory, micro, micro_store) -> Path:
    """The run folder of a study of 59 items by three annotators, before it is served."""
    return prepare(micro, micro_store, tmp_path_factory.mktemp("prepared"), ITEMS)


@pytest.fixture(scope="session")
def prepared_small(tmp_path_factory, micro, micro_store) -> Path:
    """The run folder of a study of four items by three annotators, before it is served."""
    return prepare(micro, micro_store, tmp_path_factory.mktemp("prepared"), SMALL)


Serve = Callable[..., Server]


@pytest.fixture(scope="module")
def serve(tmp_path_factory) -> Iterator[Serve]:
    """Return a function that starts the command on a copy of a prepared run folder."""
    servers = []

    def start(prepared: Path, *settings: str) -> Server:
        folder = tmp_path_factory.mktemp("checkpoints") / "study" / prepared.name
        shutil.copytree(prepared, folder)
        servers.append(Server(folder, f"items={prepared.name}", *settings))
        return servers[-1].start()

    yield start
    for server in servers:
        server.kill()


@pytest.fixture(scope="module")
def small(serve, prepared_small):
    """A server of a study of four items, which several tests share."""
    return serve(prepared_small)


@pytest.fixture
def visitor(small) -> Visitor:
    """The annotator A1, signed in."""
    return Visitor(small.port).sign_in(small.links()["A1"])
