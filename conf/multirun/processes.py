"""The GPUs that there are, and the processes that a sweep starts and ends."""

from __future__ import annotations

import logging
import os
import re
import subprocess
import time
from itertools import takewhile
from pathlib import Path

log = logging.getLogger(__name__)

LOOK_EVERY = 0.05
"""Seconds between two looks at whether a child has ended."""
GRACE = 10.0
"""Seconds that a child has to end in once it is told to."""
A_GPU = r"\d+|(GPU|MIG)-\S+"


def visible_gpus() -> list[str]:
    """The GPUs that may be used, as CUDA_VISIBLE_DEVICES names them. Torch, which knows too, takes
    seconds to import and holds memory on the first of them."""
    named = os.environ.get("CUDA_VISIBLE_DEVICES")
    if named is not None:
        # CUDA too stops at the first that is none.
        return list(
            takewhile(lambda gpu: re.fullmatch(A_GPU, gpu), map(str.strip, named.split(",")))
        )
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return []
    count = sum(line.startswith("GPU ") for line in listed.stdout.splitlines())
    return [str(number) for number in range(count)]


def restrict_to_one_gpu() -> None:
    """See the first GPU alone where no launcher has started several ranks: a trainer would spread
    each micro-batch over all of them, and train on more samples a step than the settings say.

    Takes effect only before anything looks for GPUs, as bitsandbytes does when it is imported.
    """
    gpus = visible_gpus()
    if len(gpus) > 1 and "LOCAL_RANK" not in os.environ:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[0]
        log.info("training on GPU %s of %d; several take accelerate launch", gpus[0], len(gpus))


def start(command: list[str], output: Path, gpu: str | None = None) -> subprocess.Popen:
    """A process that writes all it says to a file, and sees one GPU where one is given."""
    output.parent.mkdir(parents=True, exist_ok=True)
    environment = os.environ if gpu is None else {**os.environ, "CUDA_VISIBLE_DEVICES": gpu}
    with output.open("wb") as out:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            env=environment,
        )


def end(processes: list[subprocess.Popen]) -> None:
    """End processes politely, and by force those that do not heed it."""
    for process in processes:
        process.terminate()
    until = time.monotonic() + GRACE
    try:
        while any(p.poll() is None for p in processes) and time.monotonic() < until:
            time.sleep(LOOK_EVERY)
    finally:
        # A second Ctrl-C comes here too.
        for process in processes:
            process.kill()
            process.wait()
