"""Runs each job of a sweep as a job of a SLURM cluster, through submitit."""

from __future__ import annotations

import logging
import time
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from conf.errors import UserError
from conf.multirun.launcher import Child, ProcessLauncher
from conf.multirun.processes import end, start

log = logging.getLogger(__name__)

LOOK_EVERY = 0.5
"""Seconds between two looks at what the cluster says; submitit asks it less often."""


class SubmititLauncher(ProcessLauncher):
    """Hands the jobs to a cluster, all at once, and waits for them. Jobs that ended before are not
    handed over again, and leaving early cancels those that are left."""

    __module__ = "hydra_plugins.dynapix"

    def __init__(self, cluster: str, submitit_folder: str, **parameters: Any) -> None:
        self.cluster = cluster
        self.logs = submitit_folder
        self.parameters = {
            name: OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
            for name, value in parameters.items()
            if value is not None
        }

    def run(self, children: list[Child]) -> Iterator[tuple[Child, int | None, float | None]]:
        left = list(zip(children, self._submit(children), strict=True)) if children else []
        try:
            for child, job in left:
                log.info("%s: handed to %s as job %s", child.title, self.cluster, job.job_id)
            while left:
                for child, job in [(child, job) for child, job in left if job.done()]:
                    left.remove((child, job))
                    yield child, *_result(job)
                time.sleep(LOOK_EVERY)
        finally:
            for _, job in left:
                job.cancel(check=False)

    def _submit(self, children: list[Child]) -> list[Any]:
        chosen = f"hydra/launcher=submitit_{self.cluster}"
        try:
            import submitit
        except ImportError as error:
            raise UserError(f"{chosen} needs submitit: pip install -e '.[submitit]'") from error
        try:
            executor = submitit.AutoExecutor(folder=self.logs, cluster=self.cluster)
            executor.update_parameters(**self.parameters)
            return executor.map_array(
                run_child, [c.command for c in children], [c.output for c in children]
            )
        # No cluster here, a setting that submitit does not know, or one that the cluster refuses.
        except (RuntimeError, NameError) as error:
            raise UserError(f"{chosen}: {error}") from error


def run_child(command: list[str], output: Path) -> tuple[int, float]:
    """A job's exit code and wall time (s), on the machine that the cluster chose for it."""
    started = time.monotonic()
    process = start(command, output)
    try:
        return process.wait(), time.monotonic() - started
    finally:
        end([process])


def _result(job: Any) -> tuple[int | None, float | None]:
    from submitit.core.utils import UncompletedJobError

    try:
        return job.result()
    except UncompletedJobError as error:
        log.error("%s", str(error).strip())
        return None, None
