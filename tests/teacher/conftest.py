"""What several of the teacher's tests stand on."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.teacher.made import MadeStore, made_store
from tests.teacher.odd import OddServer


@pytest.fixture
def store(tmp_path: Path) -> MadeStore:
    return made_store(tmp_path, 14)


@pytest.fixture
def odd(store: MadeStore, monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[..., OddServer]]:
    """Starts servers with the faults that they begin with; pauses are short."""
    monkeypatch.setattr("teacher.servers.pool.PAUSE", 0.01)
    monkeypatch.setattr("teacher.servers.pool.LONGEST_PAUSE", 0.05)
    servers = []

    def start(*faults: object) -> OddServer:
        servers.append(OddServer(store, faults))
        return servers[-1]

    yield start
    for server in servers:
        server.stop()
