"""The server's process: start, wait until it is healthy, and stop with all its children."""

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
from teacher.servers.health import check_health

log = logging.getLogger(__name__)

CHECK_INTERVAL, LOG_INTERVAL = 0.5, 10.0
"""Seconds between two checks of the server, and between two log lines while it starts."""
GRACE_PERIOD = 30.0
"""Seconds between SIGTERM and SIGKILL."""
LOG_TAIL = 15
"""Lines of a dead server's log that are repeated."""

PR_SET_PDEATHSIG = 1
"""Option of Linux's prctl: the signal that a process gets when its parent dies."""


def get_clean_environment() -> dict[str, str]:
    """This process's environment without the variables that point at its own packages."""
    hidden = ("PYTHONPATH", "PYTHONHOME", "VIRTUAL_ENV")
    return {key: value for key, value in os.environ.items() if key not in hidden}


def stop_with_parent() -> None:
    """Let the kernel stop this process when its parent is killed, which cannot do so then."""
    ctypes.CDLL(None).prctl(PR_SET_PDEATHSIG, signal.SIGTERM)


@contextmanager
def run_server(
    python: Path, arguments: list[str], log_path: Path
) -> Iterator[subprocess.Popen[bytes]]:
    """Run vLLM in a new process group, and stop the whole group on exit."""
    environment = get_clean_environment() | {"PYTHONUNBUFFERED": "1"}
    if Path(arguments[arguments.index("--model") + 1]).is_dir():
        environment["HF_HUB_OFFLINE"] = "1"
    with open(log_path, "wb") as output:
        server = subprocess.Popen(
            [python, *arguments],
            stdin=subprocess.DEVNULL,
            stdout=output,
            stderr=subprocess.STDOUT,
            env=environment,
            start_new_session=True,
            preexec_fn=stop_with_parent if sys.platform == "linux" else None,
        )
    try:
        yield server
    finally:
        stop_group(server)


def wait_until_healthy(
    server: subprocess.Popen[bytes], url: str, log_path: Path, stop: threading.Event
) -> bool:
    """Wait until the server is up (True) or `stop` is set (False).

    Raises:
        UserError: The server exited.
    """
    started = logged = time.monotonic()
    while not stop.is_set():
        check_running(server, log_path)
        if check_health(url) is None:
            return True
        if time.monotonic() - logged >= LOG_INTERVAL:
            logged = time.monotonic()
            log.info(f"starting for {logged - started:.0f} s: {read_last_line(log_path)}")
        stop.wait(CHECK_INTERVAL)
    return False


def wait_for_stop(server: subprocess.Popen[bytes], log_path: Path, stop: threading.Event) -> None:
    """Wait until `stop` is set. Raises UserError if the server exits before."""
    while not stop.wait(CHECK_INTERVAL):
        check_running(server, log_path)


def check_running(server: subprocess.Popen[bytes], log_path: Path) -> None:
    """Raises UserError if the server has exited, and logs the end of its log."""
    if (status := server.poll()) is None:
        return
    for line in log_path.read_text(errors="replace").splitlines()[-LOG_TAIL:]:
        log.info(f"  {line}")
    cause = f"signal {-status}" if status < 0 else f"status {status}"
    raise UserError(
        f"the server exited with {cause}; the end of {log_path} is above", code="server-exited"
    )


def read_last_line(log_path: Path) -> str:
    lines = log_path.read_text(errors="replace").splitlines()
    return lines[-1].strip()[:120] if lines else "no output yet"


def stop_group(server: subprocess.Popen[bytes]) -> None:
    """Send SIGTERM to a process group, and SIGKILL to what is left after GRACE_PERIOD."""
    signal_group(server, signal.SIGTERM)
    with suppress(subprocess.TimeoutExpired):
        server.wait(GRACE_PERIOD)
    signal_group(server, signal.SIGKILL)
    server.wait()


def signal_group(server: subprocess.Popen[bytes], number: int) -> None:
    # The group may be gone already.
    with suppress(ProcessLookupError):
        os.killpg(server.pid, number)
