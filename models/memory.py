"""Available memory, and the error for running out of it."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import torch

from conf.errors import UserError

CGROUP = Path("/sys/fs/cgroup")
"""Files of the container (version 2 of the kernel's interface)."""
OUT_OF_MEMORY = ("can't allocate memory", "CUDA error: out of memory", "CUBLAS_STATUS_ALLOC_FAILED")
"""Messages of torch for errors that have no class of their own."""


def available_cpu_bytes() -> int:
    """Return the free bytes of the machine, or of the container that limits this process."""
    free = psutil.virtual_memory().available
    # Without a limit, the file is missing or holds a word.
    with suppress(OSError, ValueError):
        limit, used = (int((CGROUP / f"memory.{name}").read_text()) for name in ("max", "current"))
        stat = dict(line.split() for line in (CGROUP / "memory.stat").read_text().splitlines())
        free = min(free, limit - used + int(stat["inactive_file"]))
    return free


@contextmanager
def explain_out_of_memory(when: str, lower: str) -> Iterator[None]:
    """Turn a lack of memory into a UserError.

    Args:
        when: What the program was doing.
        lower: The settings to lower.
    """
    try:
        yield
    except RuntimeError as error:
        known = any(message in str(error) for message in OUT_OF_MEMORY)
        if not known and not isinstance(error, torch.OutOfMemoryError):
            raise
        raise UserError(f"out of memory {when}: {lower}", code="out-of-memory") from error
