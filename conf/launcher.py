"""Runs each job of a sweep as its own process, so that one's failure or leak is its own."""

from __future__ import annotations

import json
import logging
import math
import signal
import subprocess
import sys
import time
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from types import ModuleType
from typing import Any

from hydra.core.config_store import ConfigStore
from hydra.core.plugins import Plugins
from hydra.core.utils import JobReturn, JobStatus, configure_log, setup_globals
from hydra.experimental.callback import Callback
from hydra.plugins.launcher import Launcher
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig, OmegaConf, open_dict

from conf.runs import differences, run_name, write_json
from conf.sweep import JOB_FILE, outcome, read_jobs, report, varying

log = logging.getLogger(__name__)

NOT_FOR_CHILDREN = (
    "hydra.mode",
    "hydra.sweep",
    "hydra.launcher",
    "hydra/sweeper",
    "hydra/launcher",
)


class ProcessLauncher(Launcher):
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
        """Run the jobs one after another; a failed one counts as NaN and the others go on."""
        setup_globals()
        hydra = self.config.hydra
        configure_log(hydra.hydra_logging, hydra.verbose)
        # Killed politely, the sweep takes its child along, as with Ctrl-C.
        signal.signal(signal.SIGTERM, signal.default_int_handler)
        sweep = run_name(self.config.run, hydra.overrides.task)
        jobs = [list(overrides) for overrides in job_overrides]
        log.info("sweep %s: %d jobs", hydra.sweep.dir, len(jobs))
        if initial_job_idx == 0:
            _forget_from(Path(hydra.sweep.dir), len(jobs))
        labels = [" ".join(f"{k}={v}" for k, v in told.items()) for told in varying(jobs)]
        returns = []
        for number, (overrides, label) in enumerate(
            zip(jobs, labels, strict=True), initial_job_idx
        ):
            folder = Path(hydra.sweep.dir) / str(number)
            title = f"#{number} {label}".rstrip()
            metrics = self._job(folder, title, overrides, f"{sweep}/{number}")
            objective = math.nan if metrics is None else metrics.get("objective")
            returns.append(
                JobReturn(overrides, status=JobStatus.COMPLETED, _return_value=objective)
            )
        return returns

    def _job(
        self, folder: Path, title: str, overrides: list[str], run: str
    ) -> dict[str, float] | None:
        """The metrics of a job, None where it failed."""
        folder.mkdir(parents=True, exist_ok=True)
        metrics = folder / "metrics.json"
        if metrics.exists() and not differences(folder, self._settings(overrides)):
            log.info("%s: finished before, skipped", title)
            _record(folder, overrides, "done", None)
            return json.loads(metrics.read_text())
        log.info("%s: started", title)
        start = time.monotonic()
        code = self._child(folder / "output.log", [*overrides, f"run='{run}'"])
        seconds = round(time.monotonic() - start, 1)
        _record(folder, overrides, "failed" if code else "done", seconds)
        if code:
            tail = (folder / "output.log").read_text(errors="replace").splitlines()[-5:]
            lines = "".join(f"\n    {line}" for line in tail)
            log.error("%s: failed after %s s, %s/output.log ends:%s", title, seconds, folder, lines)
            return None
        found = json.loads(metrics.read_text()) if metrics.exists() else {}
        told = "".join(f", {name} {value:.4g}" for name, value in list(outcome(found).items())[:3])
        log.info("%s: done in %s s%s", title, seconds, told)
        return found

    def _settings(self, overrides: list[str]) -> Any:
        cfg = self.loader.load_sweep_config(self.config, overrides)
        with open_dict(cfg):
            del cfg["hydra"]
        return OmegaConf.to_container(cfg, resolve=True)

    def _child(self, output: Path, overrides: list[str]) -> int:
        forwarded = [
            o
            for o in self.config.hydra.overrides.hydra
            if not o.lstrip("+").startswith(NOT_FOR_CHILDREN)
        ]
        command = [sys.executable, "-m", self.module, *overrides, *forwarded]
        with output.open("wb") as out:
            child = subprocess.Popen(
                command, stdin=subprocess.DEVNULL, stdout=out, stderr=subprocess.STDOUT
            )
            try:
                return child.wait()
            except KeyboardInterrupt:
                child.terminate()
                try:
                    child.wait(timeout=10)
                except subprocess.TimeoutExpired:
                    child.kill()
                raise


def _record(folder: Path, overrides: list[str], status: str, seconds: float | None) -> None:
    path = folder / JOB_FILE
    now = {"overrides": overrides, "status": status, "seconds": seconds}
    if seconds is None and path.exists():
        before = json.loads(path.read_text())
        # How long it took is known where this sweep ran it before.
        now["seconds"] = before["seconds"] if before["status"] == status else None
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
        print(report(folder))
        if any(job.status == "failed" for job in jobs):
            sys.exit(1)


@dataclass
class ProcessLauncherConf:
    _target_: str = "hydra_plugins.dynapix.ProcessLauncher"


ConfigStore.instance().store(group="hydra/launcher", name="process", node=ProcessLauncherConf)
Plugins.instance().register(ProcessLauncher)
# Hydra looks a plugin up by this name even when it is registered. Its scan for plugins, just
# above, has imported the namespace package if any other plugin is installed.
_hydra_plugins = sys.modules.setdefault("hydra_plugins", ModuleType("hydra_plugins"))
_hydra_plugins.dynapix = sys.modules[__name__]
