"""Wait for a condition instead of a fixed time."""

from __future__ import annotations

import time
from collections.abc import Callable

TIMEOUT = 120
"""Time (s) after which a condition counts as failed."""


def wait_until(condition: Callable[[], object]) -> None:
    """Return as soon as the condition holds; fail if it does not within `TIMEOUT`."""
    end = time.monotonic() + TIMEOUT
    while not condition():
        assert time.monotonic() < end, "the condition did not become true"
        time.sleep(0.005)
