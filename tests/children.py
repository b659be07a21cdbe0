"""Start child processes that cannot outlive their test."""

from __future__ import annotations

import os
import signal
import subprocess
from collections.abc import Sequence
from typing import Any

TIMEOUT = 500
"""Seconds after which a child is killed: fewer than pytest gives a test, so that nothing is left
behind."""


def run_child(
    command: Sequence[object], check: bool = False, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end and capture its output; with `check`, it must succeed.

    If it takes longer than `TIMEOUT`, or the test is interrupted, it is killed together with its
    own children, such as ranks that wait for each other.
    """
    pipes = {"stdout": subprocess.PIPE, "stderr": subprocess.PIPE, "text": True}
    command = [str(part) for part in command]
    with subprocess.Popen(command, start_new_session=True, **pipes, **options) as child:
        try:
            output, errors = child.communicate(timeout=TIMEOUT)
        except BaseException:
            os.killpg(child.pid, signal.SIGKILL)
            raise
    assert not check or child.returncode == 0, errors
    return subprocess.CompletedProcess(command, child.returncode, output, errors)
