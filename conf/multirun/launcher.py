"""Run each job of a sweep as a child process, so that failures and memory leaks stay in it."""

from __future__ import annotations

import logging
import os
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing, suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.utils import JobReturn, JobStatus, configure_log, setup_globals
from hydra.experimental.callback import Callback
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf

from conf.gpus import visible_gpus
from conf.multirun.table import JOB_FILE, read_job, read_jobs, write_sweep_table
from conf.runs import differences, run_name, write_json

log = logging.getLogger(__name__)

POLL = 0.05
"""Time (s) between two looks at the child processes."""
GRACE = 10.0
"""Time (s) for a terminated child process to end before it is killed."""
PARENT_ONLY = ("hydra.mode", "hydra.sweep", "hydra.launcher", "hydra/sweeper", "hydra/launcher")
"""Hydra overrides that are not passed on to the jobs."""


@dataclass(frozen=True)
class Job:
    """A job of a sweep: its run folder and the command that runs it."""

    folder: Path
    title: str
    overrides: list[str]
    command: list[str]

    @property
    def output(self) -> Path:
        """File with the job's stdout and stderr."""
        return self.folder / "output.log"


class ProcessLauncher(Launcher):
    """Runs one job at a time on each visible GPU, or one job at a time without a GPU."""

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.config = config
        self.loader = hydra_context.config_loader
        self.module = task_function.__module__

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run the jobs that are not finished, and log each as it ends.

        The value of a job is its metrics, or None if it failed; the other jobs still run.
        """
        setup_globals()
        hydra = self.config.hydra
        configure_log(hydra.hydra_logging, hydra.verbose)
        # On SIGTERM, as on Ctrl-C, the sweep ends its child processes.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        sweep = Path(hydra.sweep.dir)
        jobs = [self._job(n, list(o)) for n, o in enumerate(job_overrides, initial_job_idx)]
        if len(jobs) > 1:
            log.info("sweep %s: %d jobs", sweep, len(jobs))
        if initial_job_idx == 0:
            # Jobs of an earlier, longer sweep are not part of this sweep's table.
            for number in [old["job"] for old in read_jobs(sweep) if old["job"] >= len(jobs)]:
                (sweep / str(number) / JOB_FILE).unlink()
        with closing(self.run([job for job in jobs if not self._is_finished(job)])) as ended:
            for job, succeeded in ended:
                _record_end(job, succeeded)
        records = [read_job(job.folder) for job in jobs]
        return [
            JobReturn(
                record["overrides"],
                status=JobStatus.COMPLETED,
                _return_value=record["metrics"] if record["status"] == "done" else None,
            )
            for record in records
        ]

    def run(self, jobs: list[Job]) -> Iterator[tuple[Job, bool]]:
        """Run jobs, and yield each as it ends with whether it succeeded.

        Closing the iterator ends the jobs that still run.
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

    def _job(self, number: int, overrides: list[str]) -> Job:
        hydra = self.config.hydra
        title = " ".join(o.lstrip("+") for o in overrides if o not in hydra.overrides.task)
        run = f"{run_name(self.config.run, hydra.overrides.task)}/{number}"
        passed_on = [o for o in hydra.overrides.hydra if not o.lstrip("+").startswith(PARENT_ONLY)]
        # The parameters of a sweep preset are already in the job's overrides.
        passed_on.append("hydra.sweeper.params=null")
        command = [sys.executable, "-m", self.module, *overrides, f"run='{run}'", *passed_on]
        return Job(Path(hydra.sweep.dir) / str(number), f"#{number} {title}", overrides, command)

    def _is_finished(self, job: Job) -> bool:
        """Whether the job has run to its end before, with the settings of this sweep."""
        if not (job.folder / "metrics.json").exists():
            return False
        cfg = self.loader.load_sweep_config(self.config, job.overrides)
        own = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
        if differences(job.folder, OmegaConf.to_container(own, resolve=True)):
            return False
        log.info("%s: already finished, skipped", job.title)
        _record(job, "done")
        return True


def start_process(command: list[str], output: Path, gpu: str | None = None) -> subprocess.Popen:
    """Start a process that writes to a file and sees one GPU, if any is given."""
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
        # A second Ctrl-C arrives here too.
        for process in processes:
            process.kill()
            process.wait()


def _record_end(job: Job, succeeded: bool) -> None:
    """Record and log how a job ended."""
    _record(job, "done" if succeeded else "failed")
    if succeeded:
        values = list(read_job(job.folder)["metrics"].items())[:3]
        log.info("%s: done%s", job.title, "".join(f", {name} {v:.4g}" for name, v in values))
        return
    output = job.output.read_text(errors="replace") if job.output.exists() else ""
    lines = "".join(f"\n    {line}" for line in output.splitlines()[-5:])
    log.error("%s: failed, last lines of %s:%s", job.title, job.output, lines)


def _record(job: Job, status: str) -> None:
    # A job that the cluster did not start has no folder.
    job.folder.mkdir(parents=True, exist_ok=True)
    write_json(job.folder / JOB_FILE, {"overrides": job.overrides, "status": status})


class TableCallback(Callback):
    """Prints the table of a sweep at its end, and exits with status 1 if a job failed."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        if jobs := read_jobs(folder):
            print(write_sweep_table(folder))
            if any(job["status"] == "failed" for job in jobs):
                sys.exit(1)
