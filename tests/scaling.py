"""Check how the time of a function grows with the length of its text."""

from __future__ import annotations

import time
from collections.abc import Callable

SIZE, FACTOR = 5000, 8
"""Length of the shorter text, and the ratio of the two lengths."""
ATTEMPTS = 5
"""Number of measurements; the fastest counts, because other programs only slow a measurement."""


def is_linear(read: Callable[[str], object], text: Callable[[int], str], size: int = SIZE) -> bool:
    """Return whether a text of `FACTOR` times the length takes less than 3 * `FACTOR` times the
    CPU time. A quadratic function takes `FACTOR` ** 2 times the time.

    Args:
        text: Returns a text of about the given length.
    """
    shorter, longer = text(size), text(size * FACTOR)
    for _ in range(ATTEMPTS):
        if _cpu_time(read, longer) < 3 * FACTOR * _cpu_time(read, shorter):
            return True
    return False


def _cpu_time(read: Callable[[str], object], text: str) -> float:
    began = time.process_time()
    read(text)
    return time.process_time() - began
