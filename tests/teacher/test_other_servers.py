"""Narration with llama.cpp's server and `transformers serve`, which take less than vLLM."""

from __future__ import annotations

import asyncio
import json
import re
from collections.abc import Iterator
from pathlib import Path

import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.journal import read_rationales
from dynapix.teacher.narrate import narrate_store
from dynapix.teacher.sections import GRAMMAR_VERSION
from dynapix.teacher.server_narrator import request_fields
from dynapix.teacher.servers.capabilities import UNLIKELY, UNLIKELY_SCHEMA
from dynapix.teacher.servers.pool import NoResponseError, ServerPool
from tests.teacher.llama import CONTEXT
from tests.teacher.memory_store import make_store
from tests.teacher.server_process import ServerProcess, llama_server, transformers_server

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def llama(model: Path, tmp_path_factory) -> Iterator[ServerProcess]:
    """A server with two slots."""
    server = llama_server(model, tmp_path_factory.mktemp("serve"), slots=2)
    server.start()
    yield server
    server.stop()


def teacher_at(url: str, model: str = "tiny", **settings: object) -> TeacherConfig:
    options = {"attempts": 4, "samples": 3, "max_tokens": 32, "concurrency": 4, **settings}
    return TeacherConfig(name="tiny", url=url, model=model, unreachable_timeout=30, **options)


def test_llama_cpp_applies_the_grammar_and_gives_as_many_responses_as_it_has_slots(
    llama, tmp_path, caplog
) -> None:
    caplog.set_level("INFO")
    narration = narrate_store(make_store(tmp_path, 5), teacher_at(llama.url, grammar=True))
    assert (
        f"{llama.url} takes top_k, chat_template_kwargs; gives up to 2 of 3 responses to a "
        "request; applies the grammar as grammar"
    ) in caplog.text
    rationales = read_rationales(tmp_path / "rationales.jsonl")
    assert sorted(r.attempt for r in rationales) == sorted([0, 1, 2, 3] * 4)
    assert {r.grammar for r in rationales} == {GRAMMAR_VERSION}
    form = re.compile(r"Scene parse:[A-Za-z' ,.;:\n-]*")
    assert [r.text for r in rationales if not form.fullmatch(r.text)] == []
    assert narration.figures["constraints"] == {f"grammar {GRAMMAR_VERSION}": 16}


def test_llama_cpp_applies_json_schemas_and_explains_its_refusals(llama) -> None:
    cfg = teacher_at(llama.url, max_tokens=128)

    async def ask(text: str) -> str:
        messages = [{"role": "user", "content": text}]
        async with ServerPool(cfg, request_fields(cfg), constraint=UNLIKELY_SCHEMA) as pool:
            [response] = await pool.complete(messages)
            assert response.constrained
            return response.text

    assert json.loads(asyncio.run(ask("Hello?"))) == {"word": UNLIKELY}
    with pytest.raises(NoResponseError, match=r"400 - .*exceeds the available context size"):
        asyncio.run(ask("a " * 2 * CONTEXT))


def test_transformers_is_asked_without_top_k_and_its_missing_constraint_is_named(
    model, tmp_path, caplog
) -> None:
    caplog.set_level("INFO")
    server = transformers_server(model, tmp_path)
    server.start()
    try:
        cfg = teacher_at(server.url, str(model), grammar=True, attempts=3, max_tokens=8)
        narration = narrate_store(make_store(tmp_path, 4), cfg)
    finally:
        server.stop()
    assert (
        f"{server.url} takes chat_template_kwargs; refuses top_k, which requests leave out; gives "
        "up to 1 of 2 responses to a request; does not apply the grammar (constraint: none)"
    ) in caplog.text
    assert "does not apply the constraint that was asked for" in caplog.text
    rationales = read_rationales(tmp_path / "rationales.jsonl")
    assert sorted(r.attempt for r in rationales) == sorted([0, 1, 2] * 3)
    assert {r.grammar for r in rationales} == {None}
    assert narration.figures["constraints"] == {"none": 9}
