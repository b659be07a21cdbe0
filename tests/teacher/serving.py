"""A real vLLM server under a real `python -m teacher.serve`, to be started, killed and stopped."""

from __future__ import annotations

import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import psutil

from teacher.servers.health import health_problem

ROOT = Path(__file__).parents[2]
ENVIRONMENT = ROOT / ".venv-vllm"


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


class Serving:
    """The command on a model in a folder; `url` stays the same when it is started again."""

    def __init__(self, model: Path, folder: Path, *settings: str) -> None:
        self.model, self.folder, self.settings = model, folder, settings
        self.url = f"http://127.0.0.1:{free_port()}/v1"
        self.said = folder / "said.txt"
        self.command: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start it and wait until it is up."""
        with open(self.said, "ab") as said:
            self.command = subprocess.Popen(
                serve_arguments(self.url, self.folder, f"model={self.model}", *self.settings),
                stdout=said,
                stderr=said,
                cwd=ROOT,
            )
        while health_problem(self.url) is not None:
            assert self.command.poll() is None, self.said.read_text()
            time.sleep(0.2)

    def processes(self) -> list[psutil.Process]:
        """vLLM's processes, the one that was started first."""
        return psutil.Process(self.command.pid).children(recursive=True)

    def kill(self) -> None:
        """Kill vLLM, as a lack of memory would, and wait for the command to see it."""
        os.killpg(self.processes()[0].pid, signal.SIGKILL)
        self.command.wait()

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Tell the command to stop; its exit status."""
        if self.command.poll() is None:
            self.command.send_signal(number)
        return self.command.wait()


def serve_arguments(url: str, folder: Path, *overrides: str) -> list[str]:
    arguments = [sys.executable, "-m", "teacher.serve", f"teacher.url={url}", "teacher.model=tiny"]
    arguments += [f"environment={ENVIRONMENT}", f"checkpoints={folder}", "run=tiny"]
    return [*arguments, "teacher.max_tokens=512", "cache_gb=0.5", *overrides]
