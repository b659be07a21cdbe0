"""teacher.serve: its checks, the command-line arguments of vLLM, and a real vLLM server."""

from __future__ import annotations

import asyncio
import json
import re
import signal
import socket
import subprocess
import sys
import time
from collections import Counter
from pathlib import Path

import psutil
import pytest

from dynapix.conf.schema import ServeCommand, TeacherConfig
from dynapix.teacher import serve
from dynapix.teacher.cited_rationales import compose_rationale, list_facts
from dynapix.teacher.journal import read_rationales
from dynapix.teacher.narrate import narrate_store
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.vocabulary import choose_vocabulary, describe_item
from dynapix.teacher.prompts import build_messages
from dynapix.teacher.sections import GRAMMAR_VERSION
from dynapix.teacher.server_narrator import request_fields
from dynapix.teacher.servers.pool import ServerPool
from tests.teacher.memory_store import make_store
from tests.teacher.server_process import ROOT, vllm_server
from tests.teacher.test_cited_rationales import cite_all
from tests.teacher.tiny_qwen3 import teach
from tests.user_errors import raises_user_error

FORMS = ("free", "cited")
URL = "http://127.0.0.1:8000/v1"
ITEMS = 200


def command(url=URL, **settings):
    teacher = TeacherConfig(name="q", url=url, model="Qwen/Qwen3-32B")
    return ServeCommand(teacher=teacher, **settings)


def flags(available, **settings):
    """Return the arguments of vLLM on a machine with `available` GPUs."""
    return serve.vllm_arguments(command(**settings), "/weights", "127.0.0.1", 8000, available)


def teacher(form, url="http://a/v1"):
    return TeacherConfig(
        name="tiny", url=url, model="tiny", attempts=1, max_tokens=1024, temperature=0.1,
        form=form, grammar=form == "free", min_words=20, predicates="relational",
    )  # fmt: skip


def respond(form, folder):
    """Return the messages about the only training item of a store, a response that is true, and the
    text of its rationale."""
    cfg, store = teacher(form), make_store(folder, 2)
    [item] = store.selection("train")
    vocabulary = choose_vocabulary(describe_item(item, store, cfg), cfg)
    messages = build_messages(vocabulary, item, cfg)
    if form == "free":
        text = write_rationale(vocabulary, item, 0)
        return messages, text, text
    # vLLM admits no spaces between the elements of JSON.
    facts = list_facts(vocabulary, item)
    response = json.dumps(cite_all(facts), separators=(",", ":"))
    return messages, response, compose_rationale(response, facts, item.letter)


@pytest.fixture(scope="module")
def server(model, tmp_path_factory):
    """A server of a model that has learnt a response in each form."""
    teach(model, [respond(form, tmp_path_factory.mktemp("item"))[:2] for form in FORMS])
    server = vllm_server(model, tmp_path_factory.mktemp("serve"))
    server.start()
    yield server
    server.stop()


def complete(server, n):
    """Return `n` responses of a server to one prompt."""
    cfg = TeacherConfig(name="tiny", url=server.url, model="tiny", max_tokens=8)

    async def main():
        async with ServerPool(cfg, request_fields(cfg)) as pool:
            messages = [{"role": "user", "content": "Where does the red cube go?"}]
            return await pool.complete(messages, n)

    return asyncio.run(main())


def test_flags_of_a_gpu_server():
    text = " ".join(flags(1))
    assert "--model /weights --served-model-name Qwen/Qwen3-32B" in text
    assert "--host 127.0.0.1 --port 8000" in text
    assert f"--max-model-len {3072 + 640}" in text
    assert "--tensor-parallel-size 1 --gpu-memory-utilization 0.9" in text
    assert "--enable-prefix-caching" in text
    for absent in ("--enforce-eager", "--reasoning-parser", "--trust-request-mm-kwargs"):
        assert absent not in text


def test_flags_of_a_cpu_server():
    arguments = flags(0, cache_gb=2)
    assert {"--enforce-eager", "--no-enable-chunked-prefill"} <= set(arguments)
    assert arguments[arguments.index("--kv-cache-memory-bytes") + 1] == str(2 * 2**30)
    assert "--tensor-parallel-size" not in arguments


def test_flags_for_frames_and_adapter(tmp_path):
    assert "--trust-request-mm-kwargs" in flags(1, frames=True)
    (tmp_path / "adapter_config.json").write_text('{"r": 16}')
    text = " ".join(flags(1, adapter=str(tmp_path)))
    assert f"--lora-modules adapter={tmp_path} --enable-lora --max-lora-rank 16" in text
    text = " ".join(flags(1, adapter=str(tmp_path), adapter_rank=20))
    assert "--enable-lora --max-lora-rank 32" in text
    assert "--logprobs-mode processed_logprobs" in text
    assert "--lora-modules" not in " ".join(flags(1, adapter_rank=8))
    assert "--logprobs-mode" not in flags(1)
    with raises_user_error("missing-adapter"):
        serve.read_adapter_rank(str(tmp_path / "none"))


@pytest.mark.parametrize(
    ("available", "gpus", "used"),
    [(1, None, 1), (3, None, 2), (4, None, 4), (7, None, 4), (8, None, 8), (4, 1, 1)],
)
def test_gpu_count_is_as_given_or_the_largest_power_of_two(available, gpus, used):
    arguments = flags(available, gpus=gpus)
    assert arguments[arguments.index("--tensor-parallel-size") + 1] == str(used)


def test_too_few_gpus_are_reported():
    with raises_user_error("too-few-gpus", contains="gpus=5"):
        flags(4, gpus=5)
    with raises_user_error("too-few-gpus", contains="only 0"):
        flags(0, gpus=2)


def test_url_determines_the_address():
    assert serve.parse_address(URL) == ("127.0.0.1", 8000)
    assert serve.parse_address("http://[::1]:8001/v1/") == ("::1", 8001)
    assert serve.parse_address("http://localhost/v1") == ("localhost", 80)
    for url in ("https://127.0.0.1:8000/v1", "http://127.0.0.1:8000"):
        with raises_user_error("invalid-url", contains=url):
            serve.parse_address(url)


def test_unavailable_address_is_reported():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        with raises_user_error("address-unavailable", contains="in use"):
            serve.check_port("url", "127.0.0.1", port)
    serve.check_port("url", "127.0.0.1", port)
    for host in ("192.0.2.1", "no-such-host.invalid"):
        with raises_user_error("address-unavailable"):
            serve.check_port("url", host, 8000)


def test_missing_vllm_is_reported(tmp_path):
    for python in (tmp_path / "bin" / "python", Path(sys.executable)):
        with raises_user_error("missing-vllm", contains="make vllm-env"):
            serve.count_gpus(python)


def test_missing_model_is_reported(tmp_path):
    with raises_user_error("missing-model", contains="model=no/where"):
        serve.find_model(command(model="no/where"))
    with raises_user_error("missing-model", contains="config.json"):
        serve.find_model(command(model=str(tmp_path)))


def test_several_urls_are_refused():
    [problem] = command(url=["http://a/v1", "http://b/v1"]).check()
    assert "teacher.url=['http://a/v1', 'http://b/v1']" in problem


def ends(pid):
    """Return whether a process ends within 5 s. A zombie has ended: the first process of a
    container may never reap it."""
    for _ in range(100):
        try:
            if psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
                return True
        except psutil.NoSuchProcess:
            return True
        time.sleep(0.05)
    return False


@pytest.mark.slow
def test_vllm_answers_chats(server):
    responses = complete(server, n=3)
    assert [response.flaw for response in responses] == ["cut off"] * 3
    assert sum(response.completion_tokens for response in responses) == 3 * 8
    assert [response.prompt_tokens > 0 for response in responses] == [True, False, False]


@pytest.mark.slow
def test_vllm_enforces_the_grammar_of_rationales(server, tmp_path, caplog):
    caplog.set_level("INFO")
    cfg = TeacherConfig(
        name="tiny", url=server.url, model="tiny", attempts=1, max_tokens=32, grammar=True
    )
    narrate_store(make_store(tmp_path, 5), cfg)
    assert "takes top_k, chat_template_kwargs; applies the grammar as structured" in caplog.text
    rationales = read_rationales(tmp_path / "rationales.jsonl")
    assert [r.grammar for r in rationales] == [GRAMMAR_VERSION] * 4
    form = re.compile(r"Scene parse:[A-Za-z' ,.;:\n-]*")
    assert [r.text for r in rationales if not form.fullmatch(r.text)] == []


@pytest.mark.slow
def test_vllm_enforces_the_schema_of_cited_rationales(server, tmp_path):
    cfg = TeacherConfig(
        name="tiny", url=server.url, model="tiny", attempts=1, max_tokens=64, form="cited"
    )
    narrate_store(make_store(tmp_path, 5), cfg)
    rationales = read_rationales(tmp_path / "rationales.jsonl")
    assert len(rationales) == 4
    begin = '{"Scene parse":[{"text":"'
    assert [r.text for r in rationales if not r.text.startswith(begin)] == []
    assert {r.reasons for r in rationales} == {("cut off",)}


@pytest.mark.slow
@pytest.mark.parametrize("form", FORMS)
def test_true_rationales_of_a_served_model_are_accepted(server, form, tmp_path):
    narrate_store(make_store(tmp_path, 2), teacher(form, server.url))
    [rationale] = read_rationales(tmp_path / "rationales.jsonl")
    assert rationale.accepted, (rationale.reasons, rationale.text)
    assert rationale.text == respond(form, tmp_path)[-1]


@pytest.mark.slow
def test_killing_the_server_or_client_neither_loses_nor_repeats_a_response(server, tmp_path):
    store = make_store(tmp_path, ITEMS + 2)
    path = tmp_path / "rationales.jsonl"
    client = narrate_in_process(tmp_path, server.url)
    wait_for_lines(path, 40, client)
    server.kill()
    server.start()
    wait_for_lines(path, 100, client)
    client.kill()
    assert client.wait() == -signal.SIGKILL
    kept = path.read_bytes()
    assert 100 <= kept.count(b"\n") < ITEMS
    assert narrate_in_process(tmp_path, server.url).wait() == 0
    rationales = read_rationales(path)
    expected = [item.item_id for item in store.selection("train") if item.item_id != "item-5"]
    assert len(expected) == ITEMS
    assert Counter((r.item_id, r.attempt) for r in rationales) == Counter(
        (item_id, 0) for item_id in expected
    )
    # Responses are not rejected because the server was down.
    assert not [r for r in rationales if "unanswered" in "".join(r.reasons)]
    assert path.read_bytes().startswith(kept[: kept.rindex(b"\n") + 1])


def narrate_in_process(folder, url):
    module = "tests.teacher.narrate_memory_store"
    arguments = [sys.executable, "-m", module, folder, str(ITEMS + 2), url]
    return subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.DEVNULL)


def wait_for_lines(path, count, client):
    while not path.exists() or path.read_bytes().count(b"\n") < count:
        assert client.poll() is None
        time.sleep(0.02)


@pytest.mark.slow
def test_ctrl_c_stops_all_processes_of_vllm(server):
    children = psutil.Process(server.process.pid).children(recursive=True)
    assert children
    assert server.stop(signal.SIGINT) == 0
    assert all(ends(child.pid) for child in children)
