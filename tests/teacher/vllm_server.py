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

from teacher.servers.health import check_health

ROOT = Path(__file__).parents[2]
ENVIRONMENT = ROOT / ".venv-vllm"


def free_port() -> int:
    with socket.socket() as listener:
        listener.bind(("127.0.0.1", 0))
        return listener.getsockname()[1]


class VllmServer:
    """The command with a model in a folder; `url` stays the same after a restart."""

    def __init__(self, model: Path, folder: Path, *settings: str) -> None:
        self.url = f"http://127.0.0.1:{free_port()}/v1"
        self.output = folder / "output.txt"
        self.arguments = [sys.executable, "-m", "teacher.serve", "run=tiny", "teacher.model=tiny"]
        self.arguments += [f"teacher.url={self.url}", "teacher.max_tokens=512", f"model={model}"]
        self.arguments += [f"environment={ENVIRONMENT}", f"checkpoints={folder}", "cache_gb=0.5"]
        self.arguments += settings
        self.command: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start the command and wait until the server is up."""
        with open(self.output, "ab") as output:
            self.command = subprocess.Popen(self.arguments, stdout=output, stderr=output, cwd=ROOT)
        while check_health(self.url) is not None:
            assert self.command.poll() is None, self.output.read_text()
            time.sleep(0.2)

    def processes(self) -> list[psutil.Process]:
        """vLLM's processes; the first is the parent of the others."""
        return psutil.Process(self.command.pid).children(recursive=True)

    def kill(self) -> None:
        """Kill vLLM, as the system does when out of memory, and wait for the command to exit."""
        os.killpg(self.processes()[0].pid, signal.SIGKILL)
        self.command.wait()

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Send a signal to the command; returns its exit status."""
        if self.command.poll() is None:
            self.command.send_signal(number)
        return self.command.wait()
