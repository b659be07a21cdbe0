"""Bounded concurrency for asyncio."""

from __future__ import annotations

import asyncio
from collections.abc import Awaitable, Callable, Sequence
from typing import TypeVar

Job = TypeVar("Job")


async def run_limited(
    jobs: Sequence[Job], limit: int, run: Callable[[Job], Awaitable[None]]
) -> None:
    """Await `run(job)` for every job, with at most `limit` jobs in progress at a time.

    Jobs start in order. If one raises, no further job starts, the jobs in progress are cancelled,
    and the error is raised.
    """
    waiting = iter(jobs)

    async def work() -> None:
        for job in waiting:
            await run(job)

    workers = [asyncio.create_task(work()) for _ in range(min(limit, len(jobs)))]
    try:
        await asyncio.gather(*workers)
    finally:
        for worker in workers:
            worker.cancel()
        await asyncio.gather(*workers, return_exceptions=True)
