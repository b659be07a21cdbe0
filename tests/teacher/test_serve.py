"""teacher.serve: its checks and vLLM's flags, the server's process, and a real vLLM server."""

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

from conf.schema import ServeCommand, TeacherConfig
from teacher import serve
from teacher.grammar import GRAMMAR_VERSION
from teacher.narrate import narrate_store
from teacher.rationale_log import read_rationales
from teacher.server_narrator import request_fields
from teacher.servers import process
from teacher.servers.pool import ServerPool
from tests.teacher.memory_store import make_store, prompts_and_rationales
from tests.teacher.tiny_qwen3 import save_tiny_qwen3
from tests.teacher.vllm_server import ROOT, VllmServer, free_port
from tests.user_errors import raises_user_error

URL = "http://127.0.0.1:8000/v1"
ITEMS = 200


def command(url=URL, **settings):
    teacher = TeacherConfig(name="q", url=url, model="Qwen/Qwen3-32B")
    return ServeCommand(teacher=teacher, **settings)


def flags(available, **settings):
    machine = serve.Machine("0.32.0", available)
    return serve.vllm_arguments(command(**settings), "/weights", "127.0.0.1", 8000, machine)


@pytest.fixture(scope="module")
def model(tmp_path_factory):
    folder = tmp_path_factory.mktemp("qwen3")
    texts = prompts_and_rationales(make_store(folder, 60))
    return save_tiny_qwen3(folder, [part for item in texts for part in item])


@pytest.fixture(scope="module")
def server(model, tmp_path_factory):
    server = VllmServer(model, tmp_path_factory.mktemp("serve"))
    server.start()
    yield server
    server.stop()


def complete(server, constraint=None, n=1):
    cfg = TeacherConfig(name="tiny", url=server.url, model="tiny", max_tokens=8)
    fields = request_fields(cfg)
    fields["extra_body"]["structured_outputs"] = constraint

    async def main():
        async with ServerPool(cfg, fields) as pool:
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
    assert f"--max-lora-rank 16 --lora-modules adapter={tmp_path}" in text
    with raises_user_error("missing-adapter"):
        serve.read_adapter_rank(str(tmp_path / "none"))


@pytest.mark.parametrize(("gpus", "used"), [(1, 1), (2, 2), (3, 2), (4, 4), (7, 4), (8, 8)])
def test_model_is_sharded_over_a_power_of_two(gpus, used):
    arguments = flags(gpus)
    assert arguments[arguments.index("--tensor-parallel-size") + 1] == str(used)


def test_number_of_gpus_can_be_reduced_but_not_exceeded():
    arguments = flags(4, gpus=1)
    assert arguments[arguments.index("--tensor-parallel-size") + 1] == "1"
    with raises_user_error("too-few-gpus", contains="gpus=5"):
        flags(4, gpus=5)


@pytest.mark.parametrize(
    ("url", "address"),
    [
        (URL, ("127.0.0.1", 8000)),
        ("http://[::1]:8001/v1/", ("::1", 8001)),
        ("http://localhost/v1", ("localhost", 80)),
    ],
)
def test_url_determines_the_address(url, address):
    assert serve.parse_address(url) == address


@pytest.mark.parametrize("url", ["https://127.0.0.1:8000/v1", "http://127.0.0.1:8000"])
def test_url_that_vllm_cannot_serve_is_reported(url):
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
    with raises_user_error("missing-vllm", contains="make vllm-env"):
        serve.find_python(str(tmp_path))
    with raises_user_error("missing-vllm", contains="make vllm-env"):
        serve.inspect_machine(Path(sys.executable))


def test_missing_model_is_reported(tmp_path):
    with raises_user_error("missing-model", contains="model=no/where"):
        serve.find_model(command(model="no/where"))
    with raises_user_error("missing-model", contains="config.json"):
        serve.find_model(command(model=str(tmp_path)))


def test_several_urls_are_refused():
    [problem] = command(url=["http://a/v1", "http://b/v1"]).check()
    assert "teacher.url=['http://a/v1', 'http://b/v1']" in problem


def run_script(script, folder, stop):
    """Run a Python script in vLLM's place until it is healthy, exits, or `stop` is set."""
    log, arguments = folder / "server.log", ["-c", script, "--model", "none"]
    with process.run_server(Path(sys.executable), arguments, log) as server:
        url = f"http://127.0.0.1:{free_port()}/v1"
        return process.wait_until_healthy(server, url, log, stop)


def ends(pid):
    """Whether a process ends soon; a zombie has ended, and some machines never reap it."""
    for _ in range(100):
        try:
            if psutil.Process(pid).status() == psutil.STATUS_ZOMBIE:
                return True
        except psutil.NoSuchProcess:
            return True
        time.sleep(0.05)
    return False


def test_exit_of_the_server_is_reported_with_its_log(tmp_path, caplog):
    caplog.set_level("INFO")
    with raises_user_error("server-exited", contains=("status 3", "server.log")):
        run_script("import sys; print('no memory'); sys.exit(3)", tmp_path, threading.Event())
    assert "no memory" in caplog.messages[-1]


def test_server_that_ignores_sigterm_is_killed_with_its_children(tmp_path, monkeypatch):
    monkeypatch.setattr(process, "GRACE_PERIOD", 0.5)
    script = (
        "import os, signal, subprocess, sys, time\n"
        "signal.signal(signal.SIGTERM, signal.SIG_IGN)\n"
        "child = subprocess.Popen([sys.executable, '-c', 'import time; time.sleep(600)'])\n"
        "print('ready', os.getpid(), child.pid, flush=True)\n"
        "time.sleep(600)"
    )
    stop = threading.Event()

    def stop_when_ready():
        while "ready" not in process.read_last_line(tmp_path / "server.log"):
            time.sleep(0.02)
        stop.set()

    (tmp_path / "server.log").touch()
    threading.Thread(target=stop_when_ready).start()
    assert run_script(script, tmp_path, stop) is False
    for pid in map(int, process.read_last_line(tmp_path / "server.log").split()[1:]):
        assert ends(pid)


def test_server_ends_when_the_command_is_killed(tmp_path):
    log = tmp_path / "server.log"
    log.touch()
    script = "import os, time; print(os.getpid(), flush=True); time.sleep(600)"
    arguments = ["-c", script, "--model", "none"]
    code = (
        "import sys, time\nfrom pathlib import Path\nfrom teacher.servers import process\n"
        f"with process.run_server(Path(sys.executable), {arguments!r}, Path({str(log)!r})):\n"
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
def test_vllm_answers_chats(server):
    responses = complete(server, n=3)
    assert [response.flaw for response in responses] == ["cut off"] * 3
    assert sum(response.completion_tokens for response in responses) == 3 * 8
    assert [response.prompt_tokens > 0 for response in responses] == [True, False, False]


@pytest.mark.slow
@pytest.mark.parametrize(
    "constraint",
    [{"choice": ["east", "west"]}, {"grammar": 'root ::= "east" | "west"'}],
    ids=["choice", "grammar"],
)
def test_vllm_enforces_a_constraint(server, constraint):
    responses = complete(server, constraint, n=4)
    assert {response.text for response in responses} <= {"east", "west"}
    assert [response.flaw for response in responses] == [None] * 4


@pytest.mark.slow
def test_vllm_enforces_the_grammar_of_rationales(server, tmp_path):
    cfg = TeacherConfig(
        name="tiny", url=server.url, model="tiny", attempts=1, max_tokens=32, grammar=True
    )
    narrate_store(make_store(tmp_path, 5), cfg)
    rationales = read_rationales(tmp_path / "rationales.jsonl")
    assert [r.grammar for r in rationales] == [GRAMMAR_VERSION] * 4
    form = re.compile(r"Scene parse:[A-Za-z' ,.;:\n-]*")
    assert [r.text for r in rationales if not form.fullmatch(r.text)] == []


@pytest.mark.slow
def test_kills_neither_lose_nor_repeat_a_response(server, tmp_path):
    store = make_store(tmp_path, ITEMS + 2)
    path = tmp_path / "rationales.jsonl"
    client = narrate_in_process(tmp_path, server.url)
    wait_for_lines(path, 40, client)
    server.kill()
    assert b"[server-exited]" in server.output.read_bytes()
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
    # The outage of the server is not a reason to reject a response.
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
    pids = [process.pid for process in server.processes()]
    assert len(pids) > 1
    assert server.stop(signal.SIGINT) == 0
    assert all(ends(pid) for pid in pids)
