"""Free memory, and what to tell a user when it runs out."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager, suppress
from pathlib import Path

import psutil
import torch

from conf.errors import UserError

CGROUPS = (
    ("/sys/fs/cgroup", "memory.max", "memory.current", "inactive_file"),
    (
        "/sys/fs/cgroup/memory",
        "memory.limit_in_bytes",
        "memory.usage_in_bytes",
        "total_inactive_file",
    ),
)
"""Files with a container's limit and use, and the name of its file cache in memory.stat, in both
versions of the kernel's interface."""

OUT_OF_MEMORY = ("can't allocate memory", "CUDA error: out of memory", "CUBLAS_STATUS_ALLOC_FAILED")
"""Messages of torch for errors that have no class of their own."""


def available_cpu_bytes() -> int:
    """Return the free bytes of the machine, or of the container that limits this process."""
    free = psutil.virtual_memory().available
    for folder, limit, used, cache in CGROUPS:
        # Without a limit, the file is missing or holds a word.
        with suppress(OSError, ValueError, KeyError):
            most, taken = (int(Path(folder, name).read_text()) for name in (limit, used))
            lines = Path(folder, "memory.stat").read_text().splitlines()
            stat = dict(line.split() for line in lines)
            free = min(free, most - taken + int(stat[cache]))
    return free


def is_out_of_memory(error: RuntimeError) -> bool:
    """Whether the memory of a GPU or of the machine ran out."""
    return isinstance(error, torch.OutOfMemoryError) or any(
        message in str(error) for message in OUT_OF_MEMORY
    )


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
        if not is_out_of_memory(error):
            raise
        raise UserError(f"out of memory {when}: {lower}", code="out-of-memory") from error
