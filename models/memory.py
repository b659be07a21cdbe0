"""How much memory is free, and the most of it that was held from some moment on."""

from __future__ import annotations

import ctypes
import resource
import sys
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
"""Where a container's limit, what of it is in use, and what of that is a mere cache of files stand,
in both versions of the kernel's interface."""

TOO_LITTLE = ("can't allocate memory", "CUDA error: out of memory", "CUBLAS_STATUS_ALLOC_FAILED")
"""What torch says of too little memory in errors of no kind of their own."""


def reset_peak(device: torch.device) -> int:
    """Bytes held now, from which on `peak` counts: of the card's tensors, else of the process."""
    if device.type == "cuda":
        torch.cuda.reset_peak_memory_stats(device)
        return torch.cuda.memory_allocated(device)
    if sys.platform.startswith("linux"):
        libc = ctypes.CDLL(None)
        if hasattr(libc, "malloc_trim"):
            # What earlier steps held and freed would hide what this one takes.
            libc.malloc_trim(0)
        with suppress(OSError):
            Path("/proc/self/clear_refs").write_text("5")
    return psutil.Process().memory_info().rss


def peak_bytes(device: torch.device) -> int:
    """The most bytes held since `start_peak`; where the system cannot count from there, since the
    process began."""
    if device.type == "cuda":
        return torch.cuda.max_memory_allocated(device)
    if sys.platform.startswith("linux"):
        status = Path("/proc/self/status").read_text()
        return int(status.partition("VmHWM:")[2].split()[0]) << 10
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss


def available_bytes(device: torch.device) -> int:
    """Bytes that may still be taken: of a card, else of the machine or the container on it."""
    if device.type == "cuda":
        reserved = torch.cuda.memory_reserved(device) - torch.cuda.memory_allocated(device)
        return torch.cuda.mem_get_info(device)[0] + reserved
    free = psutil.virtual_memory().available
    for folder, limit, used, cache in CGROUPS:
        # Where there is no limit, a word or no file stands for it.
        with suppress(OSError, ValueError, KeyError):
            most, taken = (int(Path(folder, name).read_text()) for name in (limit, used))
            stat = dict(
                line.split() for line in Path(folder, "memory.stat").read_text().splitlines()
            )
            free = min(free, most - taken + int(stat[cache]))
    return free


def keep_freed_memory() -> None:
    """Tell glibc to keep the memory of big tensors between steps. By default it gives every block
    back to the kernel at once, and on a CPU half of a training step goes into page faults."""
    if not sys.platform.startswith("linux"):
        return
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(mmap_threshold, 1 << 30)
        libc.mallopt(trim_threshold, (1 << 31) - 1)
        libc.mallopt(top_pad, 64 << 20)


def is_out_of_memory(error: RuntimeError) -> bool:
    """Whether a card's or the machine's memory was too small."""
    return isinstance(error, torch.OutOfMemoryError) or any(
        sign in str(error) for sign in TOO_LITTLE
    )


@contextmanager
def explain_out_of_memory(when: str, lower: str) -> Iterator[None]:
    """Turn a lack of memory into a sentence of when it was, and by which keys less is taken."""
    try:
        yield
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        raise UserError(f"out of memory {when}: {lower}") from error
