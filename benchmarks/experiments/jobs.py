"""Runs the project's own commands as subprocesses, several at a time.

A command whose run is finished exits at once, so an interrupted experiment resumes when its script
is started again.
"""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Job = TypeVar("Job")


def run(command: Sequence[str], threads: int | None = None) -> None:
    """Run `python -m` with a command and wait for it.

    Raises:
        SystemExit: The command fails; the message holds the end of its standard error.
    """
    print("python -m", *command, flush=True)
    environment = {**os.environ, **({"OMP_NUM_THREADS": str(threads)} if threads else {})}
    done = subprocess.run(
        [sys.executable, "-m", *command], env=environment, capture_output=True, text=True
    )
    if done.returncode:
        raise SystemExit(f"error: {' '.join(command)} failed:\n{done.stderr[-2000:]}")


def run_all(work: Callable[[Job, int], None], jobs: Iterable[Job], parallel: int) -> None:
    """Call `work(job, threads)` for every job, `parallel` at a time, with the cores divided."""
    threads = max(1, (os.cpu_count() or 1) // parallel)
    with ThreadPoolExecutor(parallel) as pool:
        for future in [pool.submit(work, job, threads) for job in jobs]:
            future.result()
