"""Does many jobs at once, and no more of them than there are lanes."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import TypeVar

Job = TypeVar("Job")


async def run_limited(
    jobs: Sequence[Job], lanes: int, do: Callable[[Job], Awaitable[None]]
) -> None:
    """Await `do` of each job, in order of their start; where one fails, none is begun after it and
    those under way are given up."""
    waiting = iter(jobs)

    async def lane() -> None:
        for job in waiting:
            await do(job)

    tasks = [asyncio.create_task(lane()) for _ in range(min(lanes, len(jobs)))]
    try:
        await asyncio.gather(*tasks)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
