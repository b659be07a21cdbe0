"""Launchers, which run the jobs of a sweep as processes of this machine or on a cluster."""

from __future__ import annotations

import logging
import os
import subprocess
import time
from collections.abc import Iterator
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from dynapix.conf.errors import UserError, import_extra
from dynapix.conf.gpus import visible_gpus

log = logging.getLogger(__name__)

POLL = 0.05
"""Interval (s) at which child processes are polled."""
CLUSTER_POLL = 0.5
"""Interval (s) at which submitit's jobs are polled. submitit queries the cluster less often."""
GRACE = 10.0
"""Time (s) for a terminated child process to end before it is killed."""


@dataclass(frozen=True)
class Job:
    """A job of a sweep: its run folder and the command line that runs it."""

    folder: Path
    title: str
    """Number and swept values of the job, for the log."""
    overrides: list[str]
    command: list[str]

    @property
    def output(self) -> Path:
        """File with the job's stdout and stderr."""
        return self.folder / "output.log"


class ProcessLauncher:
    """Runs one job at a time on each visible GPU, or one job at a time if there is no GPU.

    Each job is a child process, so that a crash or a memory leak affects no other job.
    """

    def run(self, jobs: list[Job]) -> Iterator[tuple[Job, bool]]:
        """Run jobs. When a job ends, yield the job and whether it succeeded.

        Closing the iterator terminates the jobs that are still running.
        """
        waiting, free = jobs[::-1], visible_gpus() or [None]
        running: dict[subprocess.Popen, tuple[Job, str | None]] = {}
        try:
            while waiting or running:
                while waiting and free:
                    job, gpu = waiting.pop(), free.pop(0)
                    log.info("%s: started%s", job.title, f" on GPU {gpu}" if gpu else "")
                    running[start_process(job.command, job.output, gpu)] = job, gpu
                time.sleep(POLL)
                for process in [process for process in running if process.poll() is not None]:
                    job, gpu = running.pop(process)
                    free.append(gpu)
                    yield job, process.returncode == 0
        finally:
            end_processes(list(running))


class SubmititLauncher:
    """Submits all jobs to a cluster and waits for them.

    Args:
        cluster: slurm, or local for processes of this machine.
        submitit_folder: Folder of submitit's own files.
        parameters: Parameters of submitit's executor; those that are None are left out.
    """

    def __init__(self, cluster: str, submitit_folder: str, **parameters: Any) -> None:
        self.cluster = cluster
        self.folder = submitit_folder
        self.parameters = {name: v for name, v in parameters.items() if v is not None}

    def run(self, jobs: list[Job]) -> Iterator[tuple[Job, bool]]:
        """Run jobs like `ProcessLauncher.run`. Closing the iterator cancels unfinished jobs."""
        if not jobs:
            return
        handles = dict(zip(self._submit(jobs), jobs, strict=True))
        try:
            from submitit.core.utils import UncompletedJobError
            from submitit.helpers import as_completed

            for handle, job in handles.items():
                log.info("%s: submitted to %s as job %s", job.title, self.cluster, handle.job_id)
            for handle in as_completed(list(handles), poll_frequency=CLUSTER_POLL):
                job = handles.pop(handle)
                try:
                    yield job, handle.result() == 0
                except UncompletedJobError as error:
                    log.error("%s", str(error).strip())
                    yield job, False
        finally:
            for handle in handles:
                handle.cancel(check=False)

    def _submit(self, jobs: list[Job]) -> list[Any]:
        setting = f"hydra/launcher=submitit_{self.cluster}"
        submitit = import_extra("submitit", setting)
        try:
            executor = submitit.AutoExecutor(folder=self.folder, cluster=self.cluster)
            executor.update_parameters(**self.parameters)
            return executor.map_array(
                run_command, [job.command for job in jobs], [job.output for job in jobs]
            )
        # The machine has no cluster, or submitit or the cluster refuses a parameter.
        except (RuntimeError, NameError) as error:
            raise UserError(f"{setting}: {error}", code="cluster-refused") from error


def run_command(command: list[str], output: Path) -> int:
    """Run a job on its node of the cluster and return the exit status."""
    process = start_process(command, output)
    try:
        return process.wait()
    finally:
        end_processes([process])


def start_process(command: list[str], output: Path, gpu: str | None = None) -> subprocess.Popen:
    """Start a process that writes its output to a file. It sees only `gpu`, if that is given."""
    output.parent.mkdir(parents=True, exist_ok=True)
    visible = {} if gpu is None else {"CUDA_VISIBLE_DEVICES": gpu}
    with output.open("wb") as out:
        return subprocess.Popen(
            command,
            stdin=subprocess.DEVNULL,
            stdout=out,
            stderr=subprocess.STDOUT,
            env=os.environ | visible,
        )


def end_processes(processes: list[subprocess.Popen]) -> None:
    """Terminate processes, and kill those that are still running after GRACE seconds."""
    for process in processes:
        process.terminate()
    deadline = time.monotonic() + GRACE
    try:
        for process in processes:
            with suppress(subprocess.TimeoutExpired):
                process.wait(max(0.0, deadline - time.monotonic()))
    finally:
        # Kill them also if a second Ctrl-C interrupts the waiting.
        for process in processes:
            process.kill()
            process.wait()
