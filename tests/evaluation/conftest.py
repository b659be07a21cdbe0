"""A fixture that starts chat servers."""

from __future__ import annotations

import pytest

from tests.evaluation.chat_server import ChatServer


@pytest.fixture
def start_server(monkeypatch):
    """Return a function that starts a server, which is stopped at the end of the test."""
    monkeypatch.setattr("dynapix.teacher.servers.pool.PAUSE", 0.01)
    monkeypatch.setattr("dynapix.teacher.servers.pool.LONGEST_PAUSE", 0.05)
    servers = []

    def start(reply, port=0):
        servers.append(ChatServer(reply, port))
        return servers[-1]

    yield start
    for server in servers:
        server.stop()
