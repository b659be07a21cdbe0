"""Determine the available memory, and report running out of memory as a UserError."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import torch

from dynapix.conf.errors import UserError

CGROUP = Path("/sys/fs/cgroup")
"""Folder of the files (cgroup v2) that describe the limits of a container."""
OUT_OF_MEMORY = ("can't allocate memory", "CUDA error: out of memory", "CUBLAS_STATUS_ALLOC_FAILED")
"""Messages of torch's out-of-memory errors that are plain RuntimeErrors."""


def available_cpu_bytes() -> int:
    """Return the free memory (bytes) of the machine, or of this process's container if it has
    less."""
    free = psutil.virtual_memory().available
    # If there is no limit, memory.max is missing or contains "max" instead of a number.
    with suppress(OSError, ValueError):
        limit, used = (int((CGROUP / f"memory.{name}").read_text()) for name in ("max", "current"))
        stat = dict(line.split() for line in (CGROUP / "memory.stat").read_text().splitlines())
        free = min(free, limit - used + int(stat["inactive_file"]))
    return free


@contextmanager
def explain_out_of_memory(when: str, lower: str) -> Iterator[None]:
    """Turn an out-of-memory error of the block into a UserError.

    Args:
        when: What the program was doing, as in "out of memory {when}".
        lower: The advice which settings to lower.
    """
    try:
        yield
    except RuntimeError as error:
        known = any(message in str(error) for message in OUT_OF_MEMORY)
        if not known and not isinstance(error, torch.OutOfMemoryError):
            raise
        raise UserError(f"out of memory {when}: {lower}", code="out-of-memory") from error
