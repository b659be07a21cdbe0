"""Spreads jobs over this machine's cores, or over a Ray cluster, by joblib.

A job leaves its work in files that are written whole or not at all, so that one whose worker died
is done again by another.
"""

from __future__ import annotations

import logging
import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import cache
from typing import Any

from tqdm import tqdm

from conf.errors import UserError

log = logging.getLogger(__name__)

Job = Callable[[], Any]
CHUNK = 32
"""Jobs for each worker that are handed out together; between two such rounds workers wait."""
DEATHS = 3
"""Workers that may die in a row before a job is finished."""


@dataclass(frozen=True)
class Workers:
    """How many processes work, and where: `loky` for this machine, `ray` for a cluster (the one at
    RAY_ADDRESS, or else one that is started here)."""

    count: int
    engine: str = "loky"

    def run(
        self, jobs: Mapping[str, Job], title: str, unit: str, done: int = 0
    ) -> Iterator[tuple[str, Any]]:
        """Run jobs and give their results by name, as they come, under a progress bar on which
        `done` others count as done before.

        Raises:
            UserError: workers die again and again without finishing a job.
        """
        left = dict(jobs)
        bar = tqdm(total=done + len(left), initial=done, desc=title, unit=unit, mininterval=1.0)
        with bar:
            deaths = 0
            while left:
                try:
                    for name, result in self._results(left):
                        del left[name]
                        bar.update()
                        deaths = 0
                        yield name, result
                except _worker_died(self.engine) as error:
                    deaths += 1
                    if deaths > DEATHS:
                        raise UserError(
                            f"{title}: workers die before they finish a {unit}, probably for want "
                            f"of memory; try workers={max(self.count // 2, 1)}"
                        ) from error
                    log.warning("a worker died; its jobs are done again")

    def _results(self, jobs: Mapping[str, Job]) -> Iterator[tuple[str, Any]]:
        from joblib import Parallel, delayed

        if self.engine == "ray":
            _join_cluster(self.count)
            # Ray's backend gives results only once all of them are there.
            parallel = Parallel(self.count, backend="ray")
        else:
            parallel = Parallel(
                self.count,
                backend="loky",
                return_as="generator_unordered",
                initializer=_end_with_parent,
            )
        # Loky renews a worker whose memory grows, as that of one does which keeps scenes.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs")
        for some in batched(list(jobs.items()), CHUNK * self.count):
            yield from parallel(delayed(_named)(name, job) for name, job in some)


def batched(jobs: list[tuple[str, Job]], size: int) -> Iterator[list[tuple[str, Job]]]:
    return (jobs[k : k + size] for k in range(0, len(jobs), size))


def _named(name: str, job: Job) -> tuple[str, Any]:
    return name, job()


def _worker_died(engine: str) -> tuple[type[Exception], ...]:
    if engine == "ray":
        from ray.exceptions import RayActorError, WorkerCrashedError

        return RayActorError, WorkerCrashedError
    from joblib.externals.loky import BrokenProcessPool

    return (BrokenProcessPool,)


@cache
def _join_cluster(count: int) -> None:
    try:
        import ray
        from ray.util.joblib import register_ray
    except ImportError as error:
        raise UserError("parallel=ray needs Ray: pip install -e '.[ray]'") from error
    if not ray.is_initialized():
        here = {} if os.environ.get("RAY_ADDRESS") else {"num_cpus": count}
        ray.init(log_to_driver=False, include_dashboard=False, **here)
    register_ray()


def _end_with_parent() -> None:
    """A worker would wait for work for minutes after its parent was killed."""
    parent = os.getppid()

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
