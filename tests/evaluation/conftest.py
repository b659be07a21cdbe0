"""Servers that tests start."""

from __future__ import annotations

import pytest

from tests.evaluation.chat_server import ChatServer


@pytest.fixture
def start_server(monkeypatch):
    monkeypatch.setattr("teacher.servers.pool.PAUSE", 0.01)
    monkeypatch.setattr("teacher.servers.pool.LONGEST_PAUSE", 0.05)
    servers = []

    def start(reply, port=0):
        servers.append(ChatServer(reply, port))
        return servers[-1]

    yield start
    for server in servers:
        server.stop()
