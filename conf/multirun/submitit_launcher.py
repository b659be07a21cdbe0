"""Run each job of a sweep as a job of a SLURM cluster, with submitit."""

from __future__ import annotations

import logging
from collections.abc import Iterator
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from conf.errors import UserError
from conf.multirun.launcher import Job, ProcessLauncher, end_processes, start_process

log = logging.getLogger(__name__)

POLL = 0.5
"""Time (s) between two looks at the jobs; submitit queries the cluster less often."""


class SubmititLauncher(ProcessLauncher):
    """Submits all unfinished jobs to a cluster and waits for them; leaving early cancels them."""

    def __init__(self, cluster: str, submitit_folder: str, **parameters: Any) -> None:
        self.cluster = cluster
        self.folder = submitit_folder
        self.parameters = {
            name: OmegaConf.to_container(value) if OmegaConf.is_config(value) else value
            for name, value in parameters.items()
            if value is not None
        }

    def run(self, jobs: list[Job]) -> Iterator[tuple[Job, bool]]:
        if not jobs:
            return
        handles = dict(zip(self._submit(jobs), jobs, strict=True))
        try:
            from submitit.helpers import as_completed

            for handle, job in handles.items():
                log.info("%s: submitted to %s as job %s", job.title, self.cluster, handle.job_id)
            for handle in as_completed(list(handles), poll_frequency=POLL):
                yield handles.pop(handle), _exit_status(handle) == 0
        finally:
            for handle in handles:
                handle.cancel(check=False)

    def _submit(self, jobs: list[Job]) -> list[Any]:
        typed = f"hydra/launcher=submitit_{self.cluster}"
        try:
            import submitit
        except ImportError as error:
            raise UserError(
                f"{typed} needs submitit: pip install -e '.[submitit]'", code="missing-package"
            ) from error
        try:
            executor = submitit.AutoExecutor(folder=self.folder, cluster=self.cluster)
            executor.update_parameters(**self.parameters)
            return executor.map_array(
                run_command, [job.command for job in jobs], [job.output for job in jobs]
            )
        # No cluster on this machine, an unknown parameter, or one that the cluster refuses.
        except (RuntimeError, NameError) as error:
            raise UserError(f"{typed}: {error}", code="cluster-refused") from error


def run_command(command: list[str], output: Path) -> int:
    """Run a job on its node of the cluster; returns its exit status."""
    process = start_process(command, output)
    try:
        return process.wait()
    finally:
        end_processes([process])


def _exit_status(handle: Any) -> int | None:
    from submitit.core.utils import UncompletedJobError

    try:
        return handle.result()
    except UncompletedJobError as error:
        log.error("%s", str(error).strip())
        return None
