"""Real model servers, which tests start, stop and kill: vLLM, llama.cpp and transformers."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
import urllib.request
from pathlib import Path

from tests.local import free_port

ROOT = Path(__file__).parents[2]
ENVIRONMENT = ROOT / ".venv-vllm"


class ServerProcess:
    """A server in a process group of its own. `url` stays the same after a restart.

    Args:
        folder: Receives the output of the server.
        port: The port at which it listens.
        arguments: The command that starts it.
    """

    def __init__(self, folder: Path, port: int, arguments: list[str]) -> None:
        self.url = f"http://127.0.0.1:{port}/v1"
        self.output = folder / "output.txt"
        self.arguments = arguments
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the server, and wait until it is up."""
        with open(self.output, "ab") as output:
            self.process = subprocess.Popen(
                self.arguments, stdout=output, stderr=output, cwd=ROOT, start_new_session=True
            )
        while not self.is_up():
            assert self.process.poll() is None, self.output.read_text()
            time.sleep(0.2)

    def is_up(self) -> bool:
        try:
            urllib.request.urlopen(self.url.removesuffix("/v1") + "/health", timeout=10).close()
        except OSError:
            return False
        return True

    def kill(self) -> None:
        """Kill all processes of the server, as if the machine went down."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Send a signal to the server, and return its exit status."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait()


def vllm_server(model: Path, folder: Path, *settings: str) -> ServerProcess:
    """Return vLLM with a model, started with `python -m teacher.serve` and more settings, such as
    "frames=true"."""
    port = free_port()
    arguments = [sys.executable, "-m", "teacher.serve", "run=tiny", "teacher.model=tiny"]
    arguments += [f"teacher.url=http://127.0.0.1:{port}/v1", "teacher.max_tokens=512"]
    arguments += [f"model={model}", f"environment={ENVIRONMENT}", f"checkpoints={folder}"]
    return ServerProcess(folder, port, [*arguments, "cache_gb=0.5", *settings])


def llama_server(model: Path, folder: Path, slots: int) -> ServerProcess:
    """Return llama.cpp's server with a model that `tiny_qwen3` saved."""
    port = free_port()
    arguments = [sys.executable, "-m", "tests.teacher.llama", str(model), str(port), str(slots)]
    return ServerProcess(folder, port, arguments)


def transformers_server(model: Path, folder: Path) -> ServerProcess:
    """Return `transformers serve` with a model, which it serves under the name of its folder."""
    port = free_port()
    arguments = [str(Path(sys.executable).parent / "transformers"), "serve", str(model)]
    arguments += ["--host", "127.0.0.1", "--port", str(port), "--device", "cpu"]
    return ServerProcess(folder, port, arguments)
