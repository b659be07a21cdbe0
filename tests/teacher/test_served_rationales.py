"""Rationales of a model on a real vLLM server are accepted, in both forms."""

from __future__ import annotations

import json
from collections.abc import Iterator
from pathlib import Path

import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.cited_rationales import compose_rationale, list_facts
from dynapix.teacher.journal import read_rationales
from dynapix.teacher.narrate import narrate_store
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.vocabulary import choose_vocabulary, describe_item
from dynapix.teacher.prompts import build_messages
from tests.teacher.memory_store import make_store
from tests.teacher.server_process import ServerProcess, vllm_server
from tests.teacher.test_cited_rationales import cite_all
from tests.teacher.tiny_qwen3 import save_tiny_qwen3, teach

pytestmark = pytest.mark.slow
FORMS = ("free", "cited")


def teacher(form: str, url: str = "http://a/v1") -> TeacherConfig:
    return TeacherConfig(
        name="tiny", url=url, model="tiny", attempts=1, max_tokens=1024, temperature=0.1,
        form=form, grammar=form == "free", min_words=20, predicates="relational",
    )  # fmt: skip


def respond(form: str, folder: Path) -> tuple[list[dict[str, str]], str, str]:
    """Return the messages about the only training item of a store, a response that is true, and the
    text of its rationale."""
    cfg, store = teacher(form), make_store(folder, 2)
    [item] = store.selection("train")
    predicates = describe_item(item, store, cfg)
    vocabulary = choose_vocabulary(predicates, cfg)
    messages = build_messages(vocabulary, item, cfg)
    if form == "free":
        text = write_rationale(vocabulary, item, 0)
        return messages, text, text
    # vLLM admits no spaces between the elements of JSON.
    facts = list_facts(vocabulary, item)
    response = json.dumps(cite_all(facts), separators=(",", ":"))
    return messages, response, compose_rationale(response, facts, item.letter)


@pytest.fixture(scope="module")
def server(tmp_path_factory) -> Iterator[ServerProcess]:
    """A server of a model that has learnt a response in each form."""
    folder = tmp_path_factory.mktemp("qwen3")
    dialogues = [respond(form, folder) for form in FORMS]
    texts = [text for messages, response, _ in dialogues
             for text in (*(m["content"] for m in messages), response)]  # fmt: skip
    teach(save_tiny_qwen3(folder, texts), [dialogue[:2] for dialogue in dialogues])
    server = vllm_server(folder, tmp_path_factory.mktemp("serve"))
    server.start()
    yield server
    server.stop()


@pytest.mark.parametrize("form", FORMS)
def test_true_rationales_of_a_served_model_are_accepted(server, form, tmp_path) -> None:
    narrate_store(make_store(tmp_path, 2), teacher(form, server.url))
    [rationale] = read_rationales(tmp_path / "rationales.jsonl")
    assert rationale.accepted, (rationale.reasons, rationale.text)
    assert rationale.text == respond(form, tmp_path)[-1]
