"""Fixtures of the teacher's tests."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from pathlib import Path

import pytest

from tests.teacher.faulty_server import FaultyServer
from tests.teacher.memory_store import MemoryStore, make_store, prompts_and_rationales
from tests.teacher.tiny_qwen3 import save_tiny_qwen3


@pytest.fixture
def store(tmp_path: Path) -> MemoryStore:
    """A store with 14 items, of which 12 are training items that get a rationale."""
    return make_store(tmp_path, 14)


@pytest.fixture
def start_server(
    store: MemoryStore, monkeypatch: pytest.MonkeyPatch
) -> Iterator[Callable[..., FaultyServer]]:
    """A function that starts a server. Its arguments are the faults of the first responses, in
    order. The pauses of the server pool are short."""
    monkeypatch.setattr("dynapix.teacher.servers.pool.PAUSE", 0.01)
    monkeypatch.setattr("dynapix.teacher.servers.pool.LONGEST_PAUSE", 0.05)
    servers = []

    def start(*faults: object) -> FaultyServer:
        servers.append(FaultyServer(store, faults))
        return servers[-1]

    yield start
    for server in servers:
        server.stop()


@pytest.fixture(scope="module")
def model(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """A tiny random language model that real servers serve."""
    folder = tmp_path_factory.mktemp("qwen3")
    texts = prompts_and_rationales(make_store(folder, 60))
    return save_tiny_qwen3(folder, [part for item in texts for part in item])
