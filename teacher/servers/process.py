"""A server's process: started in a group of its own, awaited, and ended whole."""

from __future__ import annotations

import ctypes
import logging
import os
import signal
import subprocess
import sys
import threading
import time
from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

from conf.errors import UserError
from teacher.servers.health import health_problem

log = logging.getLogger(__name__)

LOOK, SAY = 0.5, 10.0
"""Seconds between two looks at the server, and between two lines about one that starts."""
GRACE = 30.0
"""Seconds that a server has to end by itself."""
TAIL = 15
"""Lines of a dead server's log that are shown."""

PR_SET_PDEATHSIG = 1
"""Of Linux's prctl: the signal that a process gets when its parent dies."""


def clean_environment() -> dict[str, str]:
    """This process's variables without those that would lead to its own packages."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    return {key: value for key, value in os.environ.items() if key not in hidden}


def end_with_parent() -> None:
    """Have the kernel end this process when its parent is killed, which then cannot."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


@contextmanager
def running(python: Path, arguments: list[str], path: Path) -> Iterator[subprocess.Popen[bytes]]:
    """vLLM in a process group of its own, which is gone when this ends."""
    environment = clean_environment() | {"PYTHONUNBUFFERED": "1"}
    if Path(arguments[arguments.index("--model") + 1]).is_dir():
        environment["HF_HUB_OFFLINE"] = "1"
    with open(path, "wb") as output:
        server = subprocess.Popen(
            [python, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
            preexec_fn=end_with_parent if sys.platform == "linux" else None,
        )
    try:
        yield server
    finally:
        end_group(server)


def await_health(
    server: subprocess.Popen[bytes], url: str, path: Path, stop: threading.Event
) -> bool:
    """Whether the server came up; False when it was told to stop before that. Raises UserError
    where it ended by itself."""
    since = said = time.monotonic()
    while not stop.is_set():
        check_alive(server, path)
        if health_problem(url) is None:
            return True
        if time.monotonic() - said >= SAY:
            said = time.monotonic()
            log.info(f"starting for {said - since:.0f} s: {last_line(path)}")
        stop.wait(LOOK)
    return False


def stay(server: subprocess.Popen[bytes], path: Path, stop: threading.Event) -> None:
    """Return when it is told to stop. Raises UserError where the server ended by itself."""
    while not stop.wait(LOOK):
        check_alive(server, path)


def check_alive(server: subprocess.Popen[bytes], path: Path) -> None:
    if (status := server.poll()) is None:
        return
    for line in path.read_text(errors="replace").splitlines()[-TAIL:]:
        log.info(f"  {line}")
    how = f"signal {-status}" if status < 0 else f"status {status}"
    raise UserError(f"the server ended by itself with {how}; {path} ends as shown above")


def last_line(path: Path) -> str:
    lines = path.read_text(errors="replace").splitlines()
    return lines[-1].strip()[:120] if lines else "no word from it yet"


def end_group(server: subprocess.Popen[bytes]) -> None:
    """Ask a process and what it started to end, and kill what does not."""
    send(server, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        server.wait(GRACE)
    send(server, signal.SIGKILL)
    server.wait()


def send(server: subprocess.Popen[bytes], number: int) -> None:
    # Nothing may be left of the group.
    with suppress(ProcessLookupError):
        os.killpg(server.pid, number)
