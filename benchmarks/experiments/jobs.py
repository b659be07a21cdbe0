"""The project's own commands as jobs: several at a time, each with its share of the cores. A
command that was done is over at once, so a comparison may be stopped and started again."""

from __future__ import annotations

import os
import subprocess
import sys
from collections.abc import Callable, Iterable, Sequence
from concurrent.futures import ThreadPoolExecutor
from typing import TypeVar

Wanted = TypeVar("Wanted")


def run(command: Sequence[str], threads: int | None = None) -> None:
    """Run `python -m` with a command.

    Raises:
        SystemExit: it fails; the end of what it said is told.
    """
    print("python -m", *command, flush=True)
    done = subprocess.run(
        [sys.executable, "-m", *command],
        env={**os.environ, **({} if threads is None else {"OMP_NUM_THREADS": str(threads)})},
        capture_output=True,
        text=True,
    )
    if done.returncode:
        raise SystemExit(f"{' '.join(command)} has failed:\n{done.stderr[-2000:]}")


def run_all(make: Callable[[Wanted, int], None], wanted: Iterable[Wanted], at_once: int) -> None:
    """Make all that is wanted, so many at once; each is told of its threads."""
    threads = max(1, (os.cpu_count() or 1) // at_once)
    with ThreadPoolExecutor(at_once) as pool:
        for made in [pool.submit(make, one, threads) for one in wanted]:
            made.result()
