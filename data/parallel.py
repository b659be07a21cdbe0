"""Runs jobs in worker processes of this machine, with joblib, or of a Ray cluster.

A job writes its files atomically, so that another worker can repeat the job of a worker that died.
"""

from __future__ import annotations

import logging
import os
import threading
import time
import warnings
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from functools import partial
from itertools import islice
from pathlib import Path
from typing import Any, TypeVar

from tqdm import tqdm

from dynapix.conf.errors import UserError, import_extra

log = logging.getLogger(__name__)

Element = TypeVar("Element")
Name = TypeVar("Name", str, Path)
Job = Callable[[], Any]
CHUNK = 32
"""Jobs per worker in one batch; all workers finish a batch before the next one starts."""
MAX_DEATHS = 3
"""Number of consecutive worker deaths that `run` tolerates; a finished job resets the count."""


@dataclass(frozen=True)
class Workers:
    """A pool of worker processes.

    Attributes:
        count: Number of processes.
        engine: `loky` uses this machine. `ray` uses the cluster at the environment variable
            RAY_ADDRESS, or starts one on this machine if the variable is not set.
    """

    count: int
    engine: str = "loky"

    def run(
        self,
        jobs: Mapping[Name, Job],
        title: str,
        unit: str,
        done: int = 0,
        sizes: Mapping[Name, int] | None = None,
    ) -> Iterator[tuple[Name, Any]]:
        """Run jobs and yield their names and results in order of completion. Raises UserError if
        workers die repeatedly without finishing a job.

        Args:
            unit: What the progress bar counts, in the singular.
            done: What has been done besides `jobs`, in units.
            sizes: Units of each job; one each by default.
        """
        remaining, sizes = dict(jobs), sizes or dict.fromkeys(jobs, 1)
        total = done + sum(sizes[name] for name in jobs)
        with tqdm(total=total, initial=done, desc=title, unit=unit, mininterval=1.0) as bar:
            deaths = 0
            while remaining:
                try:
                    for name, result in self._results(remaining):
                        del remaining[name]
                        bar.update(sizes[name])
                        deaths = 0
                        yield name, result
                except _death_errors(self.engine) as error:
                    deaths += 1
                    if deaths > MAX_DEATHS:
                        raise UserError(
                            f"{title}: workers die before they finish a job, probably because "
                            f"memory is short; try workers={max(self.count // 2, 1)}",
                            code="dying-workers",
                        ) from error
                    log.warning("a worker died; retrying its jobs")

    def write_files(
        self,
        jobs: Mapping[Path, Job],
        title: str,
        unit: str,
        sizes: Mapping[Path, int] | None = None,
    ) -> None:
        """Run the jobs whose files do not exist; see `run`. Each job must write this file last."""
        missing = {path: job for path, job in jobs.items() if not path.exists()}
        done = sum(sizes[path] if sizes else 1 for path in jobs if path not in missing)
        for _ in self.run(missing, title, unit, done, sizes):
            pass

    def _results(self, jobs: Mapping[Name, Job]) -> Iterator[tuple[Name, Any]]:
        return _run_on_ray(jobs, self.count) if self.engine == "ray" else self._run_here(jobs)

    def _run_here(self, jobs: Mapping[Name, Job]) -> Iterator[tuple[Name, Any]]:
        from joblib import Parallel, delayed

        # A worker that asked for its parent could start too late, after the parent was killed.
        watch = partial(_exit_with_parent, os.getpid())
        parallel = Parallel(self.count, return_as="generator_unordered", initializer=watch)
        # Loky restarts a worker whose memory grows; workers grow because they cache scenes.
        warnings.filterwarnings("ignore", "A worker stopped while some jobs")
        # A caller may stop before the last result.
        warnings.filterwarnings("ignore", r"\d+ tasks have been successfully executed")
        for batch in batched(list(jobs.items()), CHUNK * self.count):
            yield from parallel(delayed(_run_job)(name, job) for name, job in batch)


def batched(elements: list[Element], size: int) -> Iterator[list[Element]]:
    """Yield lists of at most `size` consecutive elements."""
    return (elements[k : k + size] for k in range(0, len(elements), size))


def _run_job(name: Name, job: Job) -> tuple[Name, Any]:
    return name, job()


def _death_errors(engine: str) -> tuple[type[Exception], ...]:
    if engine == "ray":
        from ray.exceptions import OutOfMemoryError, WorkerCrashedError

        return OutOfMemoryError, WorkerCrashedError
    from joblib.externals.loky import BrokenProcessPool

    return (BrokenProcessPool,)


def _run_on_ray(jobs: Mapping[Name, Job], count: int) -> Iterator[tuple[Name, Any]]:
    """Run jobs on a Ray cluster, `count` at a time."""
    ray = import_extra("ray", "parallel=ray")
    if not ray.is_initialized():
        local = {} if os.environ.get("RAY_ADDRESS") else {"num_cpus": count}
        ray.init(log_to_driver=False, include_dashboard=False, **local)
    # `run` repeats the jobs of a worker that dies.
    submit = ray.remote(_run_job).options(max_retries=0).remote
    waiting = iter([*jobs.items()])
    running = [submit(*each) for each in islice(waiting, count)]
    while running:
        [finished], running = ray.wait(running)
        running += [submit(*each) for each in islice(waiting, 1)]
        try:
            yield ray.get(finished)
        except ray.exceptions.RayTaskError as error:
            raise error.cause from None


def _exit_with_parent(parent: int) -> None:
    """End this worker when its parent, a process id, is killed; it would otherwise wait for jobs
    for minutes."""

    def watch() -> None:
        while os.getppid() == parent:
            time.sleep(0.5)
        os._exit(1)

    threading.Thread(target=watch, daemon=True).start()
