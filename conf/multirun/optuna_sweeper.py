"""Search for settings with Optuna: each job's settings depend on the results of earlier jobs.

study.json in the sweep's folder records the settings of each trial before its job starts; the
results are in the jobs' folders. A search that was killed resumes with the jobs that it had
started and then tries what it would have tried without the interruption.
"""

from __future__ import annotations

import json
import logging
import math
import random
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, RangeSweep
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from conf.errors import SettingsError, UserError
from conf.gpus import visible_gpus
from conf.multirun.table import is_lower_better
from conf.runs import other_settings_error, setting_differences, write_json

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution

log = logging.getLogger(__name__)

STUDY_FILE = "study.json"
METRICS = {"train.sft": "answer_letter_accuracy", "train.contrastive": "mrr"}
"""Default of hydra.sweeper.metric for each command."""


@dataclass
class OptunaSweeper(Sweeper):
    """A sweeper whose fields are the keys of conf/hydra/sweeper/optuna.yaml."""

    metric: str | None
    n_trials: int
    n_jobs: int | None
    seed: int
    params: dict[str, str] | None

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.loader = hydra_context.config_loader
        self.folder = Path(config.hydra.sweep.dir)
        self.metric = self.metric or METRICS.get(task_function.__module__)
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> None:
        """Run trials until the study has `n_trials`."""
        # Overrides of the command line replace the parameters of a sweep preset.
        lines = [*(f"{key}={value}" for key, value in (self.params or {}).items()), *arguments]
        parsed = OverridesParser.create(config_loader=self.loader).parse_overrides(lines)
        overrides = {override.get_key_element(): override for override in parsed}
        swept = {key: o for key, o in overrides.items() if o.is_sweep_override()}
        self.fixed = [str(o.input_line) for key, o in overrides.items() if key not in swept]
        if self.metric is None:
            raise SettingsError(
                "this command has no default metric to search by: give "
                "hydra.sweeper.metric=NAME, with a name in a run's metrics.json",
                code="missing-metric",
            )
        if not swept:
            raise SettingsError(
                "the search has no parameters: give a key several values, or an interval such as "
                "'train.lr=tag(log,interval(1e-5,1e-3))'",
                code="nothing-to-search",
            )
        optuna = _import_optuna()
        space = {key: distribution(override) for key, override in swept.items()}
        direction = "minimize" if is_lower_better(self.metric) else "maximize"
        study = optuna.create_study(direction=direction)
        settings = {key: str(o.input_line).partition("=")[2] for key, o in overrides.items()}
        for params in self._recorded_trials(settings):
            study.enqueue_trial(params)
            study.ask(space)
        log.info("search by %s: %d jobs", self.metric, self.n_trials)
        self._run_trials(study, first=0)
        batch = max(1, self.n_jobs or len(visible_gpus()))
        while (first := len(study.trials)) < self.n_trials:
            for number in range(first, min(first + batch, self.n_trials)):
                # One seed per trial, so that a resumed search samples the same trials.
                seed = random.Random(f"{self.seed}/{number}").getrandbits(32)
                study.sampler = optuna.samplers.TPESampler(seed=seed, constant_liar=True)
                study.ask(space)
            trials = [trial.params for trial in study.trials]
            self.folder.mkdir(parents=True, exist_ok=True)
            write_json(self.folder / STUDY_FILE, {"settings": settings, "trials": trials})
            self._run_trials(study, first)
        if any(trial.value is not None for trial in study.trials):
            best = study.best_trial
            params = " ".join(f"{key.lstrip('+')}={value}" for key, value in best.params.items())
            log.info("best: #%d %s, %s %.4g", best.number, params, self.metric, best.value)

    def _recorded_trials(self, settings: dict[str, str]) -> list[dict[str, Any]]:
        """Settings of the trials of an earlier start. Raises SettingsError for another search."""
        path = self.folder / STUDY_FILE
        if not path.exists():
            return []
        record = json.loads(path.read_text(encoding="utf-8"))
        if other := setting_differences(record["settings"], settings):
            raise other_settings_error(f"{self.folder} contains a search", other)
        return record["trials"]

    def _run_trials(self, study: Study, first: int) -> None:
        """Run the jobs of the trials from number `first`, and report their results to the study.

        The launcher skips finished jobs. A failed job has no result, so that a restart repeats it.
        """
        trials = study.trials[first:]
        jobs = [[*self.fixed, *(f"{k}={v}" for k, v in trial.params.items())] for trial in trials]
        for trial, job in zip(
            trials, self.launcher.launch(jobs, first) if jobs else [], strict=True
        ):
            if job.return_value is None:
                continue
            metrics = job.return_value
            if self.metric not in metrics:
                raise UserError(
                    f"hydra.sweeper.metric={self.metric} is not a metric of this command; the "
                    f"options are {', '.join(sorted(metrics)) or 'none'}",
                    code="unknown-metric",
                )
            value = metrics[self.metric]
            if math.isfinite(value):
                study.tell(trial.number, value)
            else:
                study.tell(trial.number, state=type(trial.state).FAIL)


def distribution(override: Override) -> BaseDistribution:
    """The distribution that Optuna samples a key from.

    An interval is continuous; int(interval(...)) has whole numbers and tag(log, interval(...)) a
    logarithmic scale. A range of whole numbers has its step. Any other sweep is a choice.

    Raises:
        SettingsError: The bounds are invalid.
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


def _import_optuna() -> Any:
    try:
        import optuna
    except ImportError as error:
        raise UserError(
            "hydra/sweeper=optuna needs Optuna: pip install -e '.[optuna]'", code="missing-package"
        ) from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)
    return optuna
