"""A real server: started, asked, killed and stopped; and what is told where none can start."""

from __future__ import annotations

import asyncio
import re
import signal
import socket
import subprocess
import sys
import threading
import time
from collections import Counter
from pathlib import Path

import psutil
import pytest

from conf.errors import UserError
from conf.schema import ServeCommand, TeacherConfig
from teacher import serve
from teacher.grammar import GRAMMAR_VERSION
from teacher.narrate import narrate_store
from teacher.rationale_log import read_rationales
from teacher.serve import Machine
from teacher.server_narrator import request_fields
from teacher.servers import process
from teacher.servers.pool import ServerPool
from tests.teacher.made import corpus, made_store
from tests.teacher.serving import ROOT, Serving, free_port
from tests.teacher.tiny_qwen3 import save_tiny_qwen3

URL = "http://127.0.0.1:8000/v1"
ITEMS = 200


def command(url=URL, **settings):
    return ServeCommand(
        teacher=TeacherConfig(name="q", url=url, model="Qwen/Qwen3-32B"), **settings
    )


def flags(cfg, cards):
    return serve.vllm_arguments(cfg, "/weights", "127.0.0.1", 8000, Machine("0.32.0", cards))


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("qwen3")
    return save_tiny_qwen3(folder, corpus(made_store(folder, 60)))


@pytest.fixture(scope="module")
def server(model, tmp_path_factory):
    serving = Serving(model, tmp_path_factory.mktemp("serve"))
    serving.start()
    yield serving
    serving.stop()


def ask(server, constraint=None, n=1, text="Where does the red cube go?"):
    cfg = TeacherConfig(name="tiny", url=server.url, model="tiny", max_tokens=8)
    request = request_fields(cfg)
    request["extra_body"]["structured_outputs"] = constraint

    async def main():
        async with ServerPool(cfg, request) as client:
            return await client.complete([{"role": "user", "content": text}], n)

    return asyncio.run(main())


def test_a_gpu_server_has_the_presets_flags():
    told = " ".join(flags(command(), 1))
    assert "--model /weights --served-model-name Qwen/Qwen3-32B" in told
    assert "--host 127.0.0.1 --port 8000" in told
    assert f"--max-model-len {3072 + 640}" in told
    assert "--tensor-parallel-size 1 --gpu-memory-utilization 0.9" in told
    assert "--enable-prefix-caching" in told
    assert "--enforce-eager" not in told
    assert "--reasoning-parser" not in told


def test_a_server_is_asked_with_frames_where_it_is_told_so(tmp_path):
    assert "--trust-request-mm-kwargs" not in flags(command(), 1)
    assert "--trust-request-mm-kwargs" in flags(command(frames=True), 1)
    (tmp_path / "adapter_config.json").write_text('{"r": 16}')
    told = " ".join(flags(command(adapter=str(tmp_path)), 1))
    assert f"--max-lora-rank 16 --lora-modules adapter={tmp_path}" in told
    with pytest.raises(UserError, match="holds no adapters"):
        serve.adapter_rank(str(tmp_path / "none"))


@pytest.mark.parametrize(("there", "used"), [(1, 1), (2, 2), (3, 2), (4, 4), (7, 4), (8, 8)])
def test_cards_share_the_model_by_powers_of_two(there, used):
    told = flags(command(), there)
    assert told[told.index("--tensor-parallel-size") + 1] == str(used)


def test_fewer_cards_can_be_asked_for_but_not_more():
    told = flags(command(gpus=1), 4)
    assert told[told.index("--tensor-parallel-size") + 1] == "1"
    with pytest.raises(UserError, match="gpus=5: vLLM finds 4"):
        flags(command(gpus=5), 4)


def test_a_cpu_server_runs_eagerly():
    told = flags(command(cache_gb=2), 0)
    assert {"--enforce-eager", "--no-enable-chunked-prefill"} <= set(told)
    assert told[told.index("--kv-cache-memory-bytes") + 1] == str(2 * 2**30)
    assert "--tensor-parallel-size" not in told


@pytest.mark.parametrize(
    ("url", "there"),
    [
        (URL, ("127.0.0.1", 8000)),
        ("http://[::1]:8001/v1/", ("::1", 8001)),
        ("http://localhost/v1", ("localhost", 80)),
    ],
)
def test_an_address_says_where_to_listen(url, there):
    assert serve.address(url) == there


@pytest.mark.parametrize("url", ["https://127.0.0.1:8000/v1", "http://127.0.0.1:8000"])
def test_an_address_that_vllm_does_not_serve_is_told(url):
    with pytest.raises(UserError, match="cannot be served: vLLM's addresses are of the form"):
        serve.address(url)


def test_a_taken_port_is_told():
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        listener.listen()
        port = listener.getsockname()[1]
        with pytest.raises(UserError, match=f"port {port} is taken"):
            serve.check_free("url", "127.0.0.1", port)
    serve.check_free("url", "127.0.0.1", port)


def test_an_address_of_another_machine_is_told():
    with pytest.raises(UserError, match=r"192\.0\.2\.1 is no address of this machine"):
        serve.check_free("url", "192.0.2.1", 8000)


def test_a_missing_environment_is_told(tmp_path):
    with pytest.raises(UserError, match=r"holds no Python environment.*make vllm-env"):
        serve.find_python(str(tmp_path))


def test_an_environment_without_vllm_is_told():
    with pytest.raises(UserError, match=r"no working vLLM .*make vllm-env"):
        serve.ask_machine(Path(sys.executable))


def test_a_missing_model_is_told(tmp_path):
    with pytest.raises(UserError, match="model=no/where is no folder here"):
        serve.find_model(command(model="no/where"))
    with pytest.raises(UserError, match=r"config\.json is missing"):
        serve.find_model(command(model=str(tmp_path)))


def test_servers_of_several_addresses_are_started_one_by_one():
    problems = command(url=["http://a/v1", "http://b/v1"]).check()
    assert problems == [
        "teacher.url=['http://a/v1', 'http://b/v1']: a server needs one address, such as "
        "teacher.url=http://127.0.0.1:8000/v1"
    ]


def run_script(script, folder, stop):
    """A server's life, with a script in the place of vLLM."""
    log, arguments = folder / "server.log", ["-c", script, "--model", "none"]
    with process.running(Path(sys.executable), arguments, log) as server:
        return process.await_health(server, f"http://127.0.0.1:{free_port()}/v1", log, stop)


def ends(pid):
    """Whether a process is dead soon: a kill takes a moment, and some machines never bury."""
    for _ in range(100):
        try:
            if psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
                return True
        except psutil.NoSuchProcess:
            return True
        time.sleep(0.05)
    return False


def test_a_server_that_dies_ends_with_its_log(tmp_path, caplog):
    caplog.set_level("INFO")
    with pytest.raises(UserError, match=r"ended by itself with status 3; .*server\.log ends as"):
        run_script("import sys; print('no memory'); sys.exit(3)", tmp_path, threading.Event())
    assert "no memory" in caplog.messages[-1]


def test_what_does_not_end_is_killed_with_all_that_it_started(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "GRACE", 0.5)
    script = (
        "import os, signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        "print('deaf', os.getpid(), child.pid, flush=True)\n"
        "time.sleep(600)"
    )
    stop = threading.Event()

    def stop_once_deaf():
        while "deaf" not in process.last_line(tmp_path / "server.log"):
            time.sleep(0.02)
        stop.set()

    (tmp_path / "server.log").touch()
    threading.Thread(target=stop_once_deaf).start()
    assert run_script(script, tmp_path, stop) is False
    for pid in map(int, process.last_line(tmp_path / "server.log").split()[1:]):
        assert ends(pid)


def test_the_server_ends_when_the_command_is_killed(tmp_path):
    log = tmp_path / "server.log"
    log.touch()
    script = "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
    arguments = ["-c", script, "--model", "none"]
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom teacher.servers import process\n"
        f"with process.running(Path(sys.executable), {arguments!r}, Path({str(log)!r})):\n"
        "    time.sleep(600)"
    )
    command = subprocess.Popen([sys.executable, "-c", code], cwd=ROOT)
    while not log.read_text().endswith("\n"):
        assert command.poll() is None
        time.sleep(0.02)
    command.kill()
    command.wait()
    assert ends(int(log.read_text()))


@pytest.mark.slow
def test_the_server_answers_chats(server):
    replies = ask(server, n=3)
    assert len(replies) == 3
    assert [reply.flaw for reply in replies] == ["cut off"] * 3
    assert sum(reply.completion_tokens for reply in replies) == 3 * 8
    assert [reply.prompt_tokens > 0 for reply in replies] == [True, False, False]


@pytest.mark.slow
@pytest.mark.parametrize(
    "constraint",
    [{"choice": ["east", "west"]}, {"grammar": 'root ::= "east" | "west"'}],
    ids=["choice", "grammar"],
)
def test_the_server_holds_answers_to_a_constraint(server, constraint):
    replies = ask(server, constraint, n=4)
    assert {reply.text for reply in replies} <= {"east", "west"}
    assert [reply.flaw for reply in replies] == [None] * 4


@pytest.mark.slow
def test_the_server_holds_rationales_to_the_grammar(server, tmp_path):
    cfg = TeacherConfig(
        name="tiny", url=server.url, model="tiny", attempts=1, max_tokens=32, grammar=True
    )
    narrate_store(made_store(tmp_path, 5), cfg)
    answers = read_rationales(tmp_path / "rationales.jsonl")
    assert [r.grammar for r in answers] == [GRAMMAR_VERSION] * 4
    assert all(re.fullmatch(r"Scene parse:[A-Za-z' ,.;-]*", r.text) for r in answers)


@pytest.mark.slow
def test_no_answer_is_lost_or_doubled_by_kills(server, tmp_path):
    store = made_store(tmp_path, ITEMS + 2)
    client = narrate_made(tmp_path, server.url)
    await_lines(tmp_path, 40, client)
    server.kill()
    assert b"ended by itself with signal 9" in server.said.read_bytes()
    server.start()
    await_lines(tmp_path, 100, client)
    client.kill()
    assert client.wait() == -signal.SIGKILL
    kept = (tmp_path / "rationales.jsonl").read_bytes()
    assert 100 <= kept.count(b"\n") < ITEMS
    assert narrate_made(tmp_path, server.url).wait() == 0
    answers = read_rationales(tmp_path / "rationales.jsonl")
    asked = [item.item_id for item in store.selection("train") if item.item_id != "item-5"]
    assert len(asked) == ITEMS
    assert Counter((r.item_id, r.attempt) for r in answers) == Counter((i, 0) for i in asked)
    # A server that was away is no reason to reject.
    assert not [r for r in answers if "unanswered" in "".join(r.reasons)]
    whole = kept[: kept.rindex(b"\n") + 1]
    assert (tmp_path / "rationales.jsonl").read_bytes().startswith(whole)


def narrate_made(folder, url):
    arguments = [sys.executable, "-m", "tests.teacher.narrate_made", folder, str(ITEMS + 2), url]
    return subprocess.Popen(arguments, cwd=ROOT, stderr=subprocess.DEVNULL)


def await_lines(folder, count, client):
    path = folder / "rationales.jsonl"
    while not path.exists() or path.read_bytes().count(b"\n") < count:
        assert client.poll() is None
        time.sleep(0.02)


@pytest.mark.slow
def test_the_server_ends_with_all_that_it_started(server):
    pids = [process.pid for process in server.processes()]
    assert len(pids) > 1
    # As Ctrl-C does.
    assert server.stop(signal.SIGINT) == 0
    assert all(ends(pid) for pid in pids)
    assert server.said.read_text().endswith("has stopped\n")
