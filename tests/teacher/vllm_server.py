"""A real vLLM server, which tests start with `python -m teacher.serve`, stop and kill."""

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
    """Runs `python -m teacher.serve` with a model. `url` stays the same after a restart.

    Args:
        model: The folder of the model.
        folder: Receives the output of the command.
        settings: More settings of the command, such as "frames=true".
    """

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
        """Kill all processes of vLLM, as if the machine went down."""
        os.killpg(self.process.pid, signal.SIGKILL)
        self.process.wait()

    def stop(self, number: int = signal.SIGTERM) -> int:
        """Send a signal to vLLM, and return its exit status."""
        if self.process.poll() is None:
            self.process.send_signal(number)
        return self.process.wait()
