"""Start child processes that cannot outlive their test."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Sequence
from pathlib import Path
from typing import Any

TIMEOUT = 500
"""Time (s) after which a child is killed. It is below pytest's timeout of a test, so that no child
outlives its test."""


def run_child(
    command: Sequence[object], check: bool = False, **options: Any
) -> subprocess.CompletedProcess[str]:
    """Run a command to its end and capture its output.

    If the command takes longer than `TIMEOUT`, or the test is interrupted, it is killed together
    with its own children, such as ranks that wait for each other.

    Args:
        command: The program and its arguments, which are converted to strings.
        check: Fail if the exit status is not 0.
        options: Further arguments of `subprocess.Popen`.
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


RUN_CARDS = """
import sys

for card in sys.argv[1:]:
    exec(open(card).read().split("```python\\n")[1].split("```")[0], {})
"""


def run_cards(folders: Sequence[Path], elsewhere: Path) -> str:
    """Run the code in the cards of trained folders with the libraries alone, in another directory.
    Return what it prints."""
    environment = {k: v for k, v in os.environ.items() if k != "PYTHONPATH"}
    cards = [folder.resolve() / "README.md" for folder in folders]
    command = [sys.executable, "-c", RUN_CARDS, *cards]
    return run_child(command, check=True, cwd=elsewhere, env=environment).stdout
