"""Search for settings with Optuna, which chooses a job's settings by the results of earlier jobs.

Each Optuna trial is one job. study.json in the sweep's folder records the settings of each trial
before its job starts; the results are in the jobs' folders. When a killed search is started again,
it first completes the recorded trials, and then samples the same trials as an uninterrupted search.
"""

from __future__ import annotations

import logging
import math
import random
from collections.abc import Callable
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.types import Override, RangeSweep

from dynapix.conf.errors import SettingsError, UserError, import_extra
from dynapix.conf.files import read_json, write_json
from dynapix.conf.gpus import visible_gpus
from dynapix.conf.multirun.table import is_lower_better
from dynapix.conf.runs import compare_settings, other_settings_error

if TYPE_CHECKING:
    from optuna.distributions import BaseDistribution
    from optuna.study import Study

log = logging.getLogger(__name__)

RunJobs = Callable[[list[list[str]], int], list[dict[str, Any]]]
"""`Sweep.run_jobs`: runs jobs, given their overrides and the first one's number."""
STUDY_FILE = "study.json"


@dataclass(frozen=True)
class Search:
    """A search. Its fields are the keys of conf/hydra/sweeper/optuna.yaml, which describes them."""

    metric: str | None
    n_trials: int
    n_jobs: int | None
    seed: int
    params: dict[str, str] | None
    """The sweeps of a sweep preset by key. `Sweep` adds them to its overrides; the field exists so
    that Hydra accepts the key."""

    def run(self, overrides: dict[str, Override], folder: Path, run_jobs: RunJobs) -> None:
        """Run trials in the sweep's folder until the study has `n_trials`.

        `overrides` contains the swept and the fixed overrides by key.
        """
        swept = {key: o for key, o in overrides.items() if o.is_sweep_override()}
        fixed = [str(o.input_line) for key, o in overrides.items() if key not in swept]
        for key in ("n_trials", "n_jobs"):
            value = getattr(self, key)
            if value is not None and not (isinstance(value, int) and value > 0):
                raise SettingsError(f"hydra.sweeper.{key}={value}: give 1 or more")
        metric = self.metric
        if metric is None:
            raise SettingsError(
                "the search has nothing to optimise: give hydra.sweeper.metric=NAME, the name of a "
                "metric in the metrics.json of a run, such as reasoning_generated_accuracy",
                code="missing-metric",
            )
        if not swept:
            raise SettingsError(
                "the search has no parameters: give at least one key several values, or an "
                "interval such as 'train.lr=tag(log,interval(1e-5,1e-3))'",
                code="nothing-to-search",
            )
        optuna = import_extra("optuna", "hydra/sweeper=optuna")
        optuna.logging.set_verbosity(optuna.logging.WARNING)
        space = {key: distribution(override) for key, override in swept.items()}
        direction = "minimize" if is_lower_better(metric) else "maximize"
        study = optuna.create_study(direction=direction)
        settings = {key: str(o.input_line).partition("=")[2] for key, o in overrides.items()}
        for params in _recorded_trials(folder, settings):
            study.enqueue_trial(params)
            study.ask(space)
        log.info("search: %d jobs; %s %s", self.n_trials, direction, metric)
        _run_trials(study, 0, fixed, metric, run_jobs)
        batch = max(1, self.n_jobs or len(visible_gpus()))
        while (first := len(study.trials)) < self.n_trials:
            for number in range(first, min(first + batch, self.n_trials)):
                # With one seed per trial, a resumed search samples the same trials.
                seed = random.Random(f"{self.seed}/{number}").getrandbits(32)
                study.sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
                study.ask(space)
            folder.mkdir(parents=True, exist_ok=True)
            record = {"settings": settings, "trials": [trial.params for trial in study.trials]}
            write_json(folder / STUDY_FILE, record)
            _run_trials(study, first, fixed, metric, run_jobs)
        if any(trial.value is not None for trial in study.trials):
            best = study.best_trial
            params = " ".join(f"{key.lstrip('+')}={value}" for key, value in best.params.items())
            log.info("best: #%d %s, %s %.4g", best.number, params, metric, best.value)


def _run_trials(study: Study, first: int, fixed: list[str], metric: str, run_jobs: RunJobs) -> None:
    """Run the jobs of the trials from number `first` on, and report their metrics to the study.

    A trial whose job failed gets no result: the same command, started again, repeats the job.

    Raises:
        UserError: A finished job has no such metric.
    """
    from optuna.trial import TrialState

    trials = study.trials[first:]
    jobs = [[*fixed, *(f"{k}={v}" for k, v in t.params.items())] for t in trials]
    for trial, job in zip(trials, run_jobs(jobs, first) if jobs else [], strict=True):
        if job["status"] == "failed":
            continue
        if metric not in job["metrics"]:
            raise UserError(
                f"hydra.sweeper.metric={metric} is not a metric of this command; the options are "
                f"{', '.join(sorted(job['metrics'])) or 'none'}",
                code="unknown-metric",
            )
        if math.isfinite(value := job["metrics"][metric]):
            study.tell(trial.number, value)
        else:
            study.tell(trial.number, state=TrialState.FAIL)


def _recorded_trials(folder: Path, settings: dict[str, str]) -> list[dict[str, Any]]:
    """Settings of each trial that an earlier start of the search recorded in `folder`. Raises
    SettingsError if the folder contains another search."""
    path = folder / STUDY_FILE
    if not path.exists():
        return []
    record = read_json(path)
    if other := compare_settings(record["settings"], settings):
        raise other_settings_error(f"{folder} contains a search", other)
    return record["trials"]


def distribution(override: Override) -> BaseDistribution:
    """Return the distribution from which Optuna samples the values of a swept key.

    interval(...) gives real numbers, int(interval(...)) integers, and tag(log,interval(...)) a
    logarithmic scale. A range of integers is sampled as integers, any other sweep as categories.

    Raises:
        SettingsError: The bounds of an interval or a range are invalid.
    """
    from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

    value = override.value()
    try:
        if override.is_interval_sweep():
            whole = isinstance(value.start, int) and isinstance(value.end, int)
            kind = IntDistribution if whole else FloatDistribution
            return kind(value.start, value.end, log="log" in value.tags)
        values = list(override.sweep_iterator())
        if isinstance(value, RangeSweep) and all(isinstance(v, int) for v in values):
            return IntDistribution(min(values), max(values), step=abs(int(value.step)))
        return CategoricalDistribution(list(override.sweep_string_iterator()))
    except ValueError as error:
        raise SettingsError(f"{override.input_line}: {error}", code="invalid-interval") from error
