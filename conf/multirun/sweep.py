"""Run the unfinished jobs of a sweep or a search, and print the table of all its jobs."""

from __future__ import annotations

import logging
import signal
import sys
from contextlib import closing
from dataclasses import asdict
from itertools import product
from pathlib import Path
from typing import Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.core.utils import configure_log
from hydra.types import RunMode
from hydra.utils import instantiate

from dynapix.conf.compose import compose, compose_config, open_hydra
from dynapix.conf.errors import SettingsError
from dynapix.conf.files import refuse_broken_link, write_json
from dynapix.conf.multirun.launchers import Job
from dynapix.conf.multirun.search import Search
from dynapix.conf.multirun.table import JOB_FILE, read_job, read_jobs, write_sweep_table
from dynapix.conf.runs import changed_settings, run_name
from dynapix.conf.typed_text import adapt_override

log = logging.getLogger(__name__)

LAUNCHERS = ("process", "submitit_local", "submitit_slurm")
PARENT_ONLY = ("hydra.mode", "hydra.sweep", "hydra.launcher", "hydra/sweeper", "hydra/launcher")
"""Prefixes of the Hydra overrides that configure the sweep itself. Jobs do not get them."""


def run_sweep(command: str, schema: type, overrides: list[str]) -> None:
    """Run a sweep or a search and print its table. Exits with status 1 if a job failed."""
    sweep = Sweep(command, schema, overrides)
    configure_log(sweep.hydra.hydra_logging, sweep.hydra.verbose)
    # SIGTERM, like Ctrl-C, raises KeyboardInterrupt, on which the launcher ends its processes.
    signal.signal(signal.SIGTERM, signal.default_int_handler)
    if sweep.is_search:
        search: Search = instantiate(sweep.hydra.sweeper)
        search.run(sweep.overrides, sweep.folder, sweep.run_jobs)
    else:
        sweep.run_jobs(sweep.jobs)
    if jobs := read_jobs(sweep.folder):
        print(write_sweep_table(sweep.folder))
        if any(job["status"] == "failed" for job in jobs):
            sys.exit(1)


class Sweep:
    """The jobs of a sweep or a search. Job N runs in folder N below the sweep's folder.

    Raises:
        SettingsError: The settings of a job are invalid.

    Attributes:
        hydra: Hydra's settings.
        task_overrides: The overrides of the command line, without those of Hydra's settings.
        overrides: The parsed overrides by key, both swept and fixed.
        jobs: The overrides of each job. For a search, which chooses its jobs while it runs, these
            are not the jobs: they cover all listed values and both ends of each interval, so that
            `__init__` can check them.
    """

    def __init__(self, command: str, schema: type, overrides: list[str]) -> None:
        self.command, self.schema = command, schema
        with open_hydra(command, schema) as loader:
            cfg = compose_config(command, overrides, RunMode.MULTIRUN)
            self.hydra, self.task_overrides = cfg.hydra, cfg.hydra.overrides.task
            # Overrides of the command line replace the parameters of a sweep preset.
            lines = [f"{key}={value}" for key, value in (cfg.hydra.sweeper.params or {}).items()]
            lines += [line for line in self.task_overrides if not line.startswith("+sweep=")]
            lines = [adapt_override(line, schema) for line in lines]
            parsed = OverridesParser.create(config_loader=loader).parse_overrides(lines)
        self.overrides = {override.get_key_element(): override for override in parsed}
        choices = self.hydra.runtime.choices
        if (launcher := choices["hydra/launcher"]) not in LAUNCHERS:
            raise SettingsError(
                f"hydra/launcher={launcher}: the options are {', '.join(LAUNCHERS)}"
            )
        self.is_search = choices["hydra/sweeper"] != "basic"
        self.folder = Path(cfg.hydra.sweep.dir)
        refuse_broken_link(self.folder)
        self.name = run_name(cfg.run, self.task_overrides)
        self.jobs = self._list_jobs()
        if "run" in self.overrides and self.overrides["run"].is_sweep_override():
            raise SettingsError(
                "run= has several values: the jobs of a sweep are numbered, and run=NAME names the "
                "sweep; repeat a job with seed=0,1",
                code="swept-run",
            )
        if not self.jobs:
            raise SettingsError(
                "the sweep has no jobs: give every swept key at least one value", code="no-jobs"
            )
        for job in self.jobs:
            compose(command, schema, job)

    def _list_jobs(self) -> list[list[str]]:
        values = [list_values(override) for override in self.overrides.values()]
        if self.is_search:
            count = max(map(len, values), default=1)
            return [[lines[job % len(lines)] for lines in values] for job in range(count)]
        if intervals := [o.input_line for o in self.overrides.values() if o.is_interval_sweep()]:
            raise SettingsError(
                f"{intervals[0]}: add hydra/sweeper=optuna to sample from an interval",
                code="needs-search",
            )
        return [list(job) for job in product(*values)]

    def run_jobs(self, overrides: list[list[str]], first: int = 0) -> list[dict[str, Any]]:
        """Run the jobs that are not finished, and log how each job ended.

        A failed job does not stop the others.

        Args:
            overrides: The overrides of each job.
            first: Number of the first job; the others follow.

        Returns:
            The record of each job (`conf.multirun.table.read_job`).
        """
        jobs = [self._job(number, o) for number, o in enumerate(overrides, first)]
        if len(jobs) > 1:
            log.info("sweep %s: %d jobs", self.folder, len(jobs))
        if first == 0:
            # Delete the records of additional jobs of an earlier sweep from the table.
            for number in [old["job"] for old in read_jobs(self.folder) if old["job"] >= len(jobs)]:
                (self.folder / str(number) / JOB_FILE).unlink()
        unfinished = [job for job in jobs if not self._skip_if_finished(job)]
        launcher = instantiate(self.hydra.launcher, _convert_="all")
        with closing(launcher.run(unfinished)) as ended:
            for job, succeeded in ended:
                _record_end(job, succeeded)
        return [read_job(job.folder) for job in jobs]

    def _job(self, number: int, overrides: list[str]) -> Job:
        title = " ".join(o.lstrip("+") for o in overrides if o not in self.task_overrides)
        hydra = self.hydra.overrides.hydra
        passed_on = [o for o in hydra if not o.lstrip("+").startswith(PARENT_ONLY)]
        run = f"run='{self.name}/{number}'"
        command = [sys.executable, "-m", self.command, *overrides, run, *passed_on]
        return Job(self.folder / str(number), f"#{number} {title}", overrides, command)

    def _skip_if_finished(self, job: Job) -> bool:
        """Return whether the job finished earlier with the same settings; if so, record it as
        done."""
        if not (job.folder / "metrics.json").exists():
            return False
        settings = compose(self.command, self.schema, job.overrides)
        if changed_settings(job.folder, asdict(settings)):
            return False
        log.info("%s: already finished, skipped", job.title)
        _record(job, "done")
        return True


def list_values(override: Override) -> list[str]:
    """Return "key=value" for each value of a swept key, or for both ends of an interval; for an
    override that is not swept, return a list with this override."""
    key = override.get_key_element()
    if override.is_interval_sweep():
        interval = override.value()
        return [f"{key}={interval.start}", f"{key}={interval.end}"]
    if override.is_sweep_override():
        return [f"{key}={value}" for value in override.sweep_string_iterator()]
    return [str(override.input_line)]


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
    # The folder does not exist if the cluster never started the job.
    job.folder.mkdir(parents=True, exist_ok=True)
    write_json(job.folder / JOB_FILE, {"overrides": job.overrides, "status": status})
