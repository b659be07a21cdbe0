"""Servers that tests start."""

from __future__ import annotations

import pytest

from tests.evaluation.talking import TalkingServer


@pytest.fixture
def talking(monkeypatch):
    monkeypatch.setattr("teacher.servers.pool.PAUSE", 0.01)
    monkeypatch.setattr("teacher.servers.pool.LONGEST_PAUSE", 0.05)
    servers = []

    def start(says, port=0):
        servers.append(TalkingServer(says, port))
        return servers[-1]

    yield start
    for server in servers:
        server.stop()
