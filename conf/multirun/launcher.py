"""Runs each job of a sweep as its own process, so that one's failure or leak is its own."""

from __future__ import annotations

import json
import logging
import signal
import subprocess
import sys
import time
from collections.abc import Iterator, Sequence
from contextlib import closing
from dataclasses import dataclass
from pathlib import Path
from typing import Any

from hydra.core.config_loader import ConfigLoader
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.utils import JobReturn, JobStatus, configure_log, setup_globals
from hydra.experimental.callback import Callback
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from conf.multirun.processes import LOOK_EVERY, end, start, visible_gpus
from conf.multirun.summary import JOB_FILE, final_metrics, read_jobs, write_sweep_table
from conf.runs import differences, run_name, write_json

log = logging.getLogger(__name__)

NOT_FOR_CHILDREN = (
    "hydra.mode",
    "hydra.sweep",
    "hydra.launcher",
    "hydra/sweeper",
    "hydra/launcher",
)


@dataclass(frozen=True)
class Child:
    """A job as a process."""

    folder: Path
    title: str
    overrides: list[str]
    command: list[str]

    @property
    def output(self) -> Path:
        return self.folder / "output.log"


class ProcessLauncher(Launcher):
    """Runs as many jobs at once as there are GPUs, each on its own; one at a time without any."""

    # Hydra takes launchers of this package only.
    __module__ = "hydra_plugins.dynapix"

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.config = config
        self.loader = hydra_context.config_loader
        self.module = task_function.__module__

    def launch(
        self, job_overrides: Sequence[Sequence[str]], initial_job_idx: int
    ) -> Sequence[JobReturn]:
        """Run the jobs that have not finished before. A job returns its metrics, None where it
        failed; the others go on."""
        setup_globals()
        hydra = self.config.hydra
        configure_log(hydra.hydra_logging, hydra.verbose)
        # Killed politely, the sweep takes its children along, as with Ctrl-C.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        sweep = Path(hydra.sweep.dir)
        children = self._children([list(overrides) for overrides in job_overrides], initial_job_idx)
        if len(children) > 1:
            log.info("sweep %s: %d jobs", sweep, len(children))
        if initial_job_idx == 0:
            _forget_from(sweep, len(children))
        with closing(self.run([child for child in children if not self._finished(child)])) as ended:
            for child, code, seconds in ended:
                _ended(child, code, seconds)
        return [
            JobReturn(child.overrides, status=JobStatus.COMPLETED, _return_value=_metrics(child))
            for child in children
        ]

    def run(self, children: list[Child]) -> Iterator[tuple[Child, int | None, float | None]]:
        """Each child with its exit code and wall time (s), as it ends. Those that still run when
        the iterator is closed are ended."""
        waiting, free = children[::-1], visible_gpus() or [None]
        running: list[tuple[Child, subprocess.Popen, str | None, float]] = []
        try:
            while waiting or running:
                while waiting and free:
                    child, gpu = waiting.pop(), free.pop(0)
                    log.info("%s: started%s", child.title, f" on GPU {gpu}" if gpu else "")
                    process = start(child.command, child.output, gpu)
                    running.append((child, process, gpu, time.monotonic()))
                time.sleep(LOOK_EVERY)
                for one in [one for one in running if one[1].poll() is not None]:
                    running.remove(one)
                    child, process, gpu, started = one
                    free.append(gpu)
                    yield child, process.returncode, time.monotonic() - started
        finally:
            end([process for _, process, *_ in running])

    def _children(self, jobs: list[list[str]], first: int) -> list[Child]:
        hydra = self.config.hydra
        sweep = run_name(self.config.run, hydra.overrides.task)
        fixed = _as_typed(hydra.overrides.task, self.loader)
        forwarded = [
            o for o in hydra.overrides.hydra if not o.lstrip("+").startswith(NOT_FOR_CHILDREN)
        ]
        children = []
        for number, overrides in enumerate(jobs, first):
            told = " ".join(o.lstrip("+") for o in overrides if o not in fixed)
            command = [sys.executable, "-m", self.module, *overrides, f"run='{sweep}/{number}'"]
            # What a preset sweeps over is spread over its jobs by now.
            command += [*forwarded, "hydra.sweeper.params=null"]
            folder = Path(hydra.sweep.dir) / str(number)
            children.append(Child(folder, f"#{number} {told}".rstrip(), overrides, command))
        return children

    def _finished(self, child: Child) -> bool:
        if not (child.folder / "metrics.json").exists() or differences(
            child.folder, job_settings(self.loader, self.config, child.overrides)
        ):
            return False
        log.info("%s: finished before, skipped", child.title)
        _record(child, "done", None)
        return True


def job_settings(loader: ConfigLoader, config: DictConfig, overrides: list[str]) -> Any:
    """The settings of one job of a sweep, composed and resolved."""
    cfg = loader.load_sweep_config(config, overrides)
    with open_dict(cfg):
        del cfg["hydra"]
    return OmegaConf.to_container(cfg, resolve=True)


def _as_typed(overrides: Sequence[str], loader: ConfigLoader) -> set[str]:
    """Overrides as they were typed, and as Hydra's own sweeper passes them on."""
    parsed = OverridesParser.create(config_loader=loader).parse_overrides(list(overrides))
    passed_on = {
        f"{o.get_key_element()}={o.get_value_element_as_str()}"
        for o in parsed
        if not o.is_sweep_override()
    }
    return passed_on | set(overrides)


def _ended(child: Child, code: int | None, seconds: float | None) -> None:
    """Record and tell how a child ended; its code is None where that is not known."""
    seconds = seconds and round(seconds, 1)
    _record(child, "done" if code == 0 else "failed", seconds)
    took = f" {'in' if code == 0 else 'after'} {seconds} s" if seconds is not None else ""
    if code == 0:
        found = list(final_metrics(_metrics(child) or {}).items())[:3]
        told = "".join(f", {name} {value:.4g}" for name, value in found)
        log.info("%s: done%s%s", child.title, took, told)
        return
    said = child.output.read_text(errors="replace") if child.output.exists() else ""
    lines = "".join(f"\n    {line}" for line in said.splitlines()[-5:])
    log.error("%s: failed%s, %s ends:%s", child.title, took, child.output, lines)


def _metrics(child: Child) -> dict[str, float] | None:
    """What a job that ended well measured; None for one that failed."""
    if json.loads((child.folder / JOB_FILE).read_text())["status"] == "failed":
        return None
    path = child.folder / "metrics.json"
    return json.loads(path.read_text()) if path.exists() else {}


def _record(child: Child, status: str, seconds: float | None) -> None:
    path = child.folder / JOB_FILE
    now = {"overrides": child.overrides, "status": status, "seconds": seconds}
    if seconds is None and path.exists():
        before = json.loads(path.read_text())
        # How long it took is known where this sweep ran it before.
        now["seconds"] = before["seconds"] if before["status"] == status else None
    # A job that a cluster never started has no folder.
    path.parent.mkdir(parents=True, exist_ok=True)
    write_json(path, now)


def _forget_from(folder: Path, count: int) -> None:
    """Leave the jobs of an earlier, longer sweep in this folder out of the table."""
    for job in read_jobs(folder):
        if job.number >= count:
            (folder / str(job.number) / JOB_FILE).unlink()


class TableCallback(Callback):
    """Ends a sweep with its table, and with exit code 1 where a job failed."""

    def on_multirun_end(self, config: DictConfig, **kwargs: Any) -> None:
        folder = Path(config.hydra.sweep.dir)
        jobs = read_jobs(folder)
        if not jobs:
            return
        print(write_sweep_table(folder))
        if any(job.status == "failed" for job in jobs):
            sys.exit(1)
