"""A real vLLM server, started by `python -m teacher.serve`, which tests can kill and stop."""

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


class VllmServer:
    """The command with a model in a folder; `url` stays the same after a restart."""

    def __init__(self, model: Path, folder: Path, *settings: str) -> None:
        self.url = f"http://127.0.0.1:{free_port()}/v1"
        self.output = folder / "output.txt"
        self.arguments = [sys.executable, "-m", "teacher.serve", "run=tiny", "teacher.model=tiny"]
        self.arguments += [f"teacher.url={self.url}", "teacher.max_tokens=512", f"model={model}"]
        self.arguments += [f"environment={ENVIRONMENT}", f"checkpoints={folder}", "cache_gb=0.5"]
        self.arguments += settings
        self.process: subprocess.Popen[bytes] | None = None

    def start(self) -> None:
        """Start vLLM in a process group of its own, and wait until it is up."""
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
        """Kill vLLM and all its processes, as if the machine went down."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Send a signal to vLLM; returns its exit status."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait()
