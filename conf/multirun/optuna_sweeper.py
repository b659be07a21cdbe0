"""Chooses the settings of a sweep's next jobs by what the jobs before them measured, with Optuna.

The study is kept in the sweep's folder: each trial before its job starts, its value after. So a
sweep that was killed goes on with the jobs it had begun, and a finished one adds none.
"""

from __future__ import annotations

import logging
import math
import random
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING

from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override, RangeSweep
from hydra.core.plugins import Plugins
from hydra.plugins.sweeper import Sweeper
from hydra.types import HydraContext, TaskFunction
from omegaconf import DictConfig

from conf.errors import SettingsError, UserError
from conf.multirun.launcher import job_settings
from conf.multirun.processes import visible_gpus
from conf.multirun.summary import final_metrics, is_lower_better
from conf.runs import differences

if TYPE_CHECKING:
    from optuna import Study
    from optuna.distributions import BaseDistribution
    from optuna.trial import FrozenTrial

log = logging.getLogger(__name__)

JOURNAL = "study.journal"
METRICS = {"train.sft": "answer_letter_accuracy", "train.contrastive": "mrr"}
"""What a command's jobs are compared by where hydra.sweeper.metric is not given."""


class OptunaSweeper(Sweeper):
    # Hydra takes sweepers of this package only.
    __module__ = "hydra_plugins.dynapix"

    def __init__(
        self,
        metric: str | None,
        n_trials: int,
        n_jobs: int | None,
        seed: int,
        params: dict[str, str] | None,
    ) -> None:
        self.metric = metric
        self.n_trials = n_trials
        self.n_jobs = n_jobs
        self.seed = seed
        self.params = params or {}

    def setup(
        self, *, hydra_context: HydraContext, task_function: TaskFunction, config: DictConfig
    ) -> None:
        self.config = config
        self.loader = hydra_context.config_loader
        self.command = task_function.__module__
        self.launcher = Plugins.instance().instantiate_launcher(
            hydra_context=hydra_context, task_function=task_function, config=config
        )

    def sweep(self, arguments: list[str]) -> None:
        """Run trials until the study has as many as were asked for."""
        self.metric = self.metric or METRICS.get(self.command)
        if self.metric is None:
            raise SettingsError(
                f"{self.command} has no usual metric to search by: give hydra.sweeper.metric=NAME, "
                "a name in a run's metrics.json"
            )
        overrides = self._overrides(arguments)
        swept = {key: o for key, o in overrides.items() if o.is_sweep_override()}
        if not swept:
            raise SettingsError(
                "there is nothing to search: give a key several values, or an interval as "
                "'train.lr=tag(log,interval(1e-5,1e-3))'"
            )
        space = {key: distribution(override) for key, override in swept.items()}
        self.fixed = [str(o.input_line) for key, o in overrides.items() if key not in swept]
        study = self._open(swept)
        log.info("search by %s: %d jobs", self.metric, self.n_trials)
        self._launch(study, study.trials)
        at_once = max(1, self.n_jobs or len(visible_gpus()))
        while (asked := len(study.trials)) < self.n_trials:
            for number in range(asked, min(asked + at_once, self.n_trials)):
                self._begin_trial(study, space, number)
            self._launch(study, study.trials[asked:])
        _tell_best(study, str(self.metric))

    def _overrides(self, arguments: list[str]) -> dict[str, Override]:
        """What a preset sweeps over and, before it, what was typed; by key."""
        lines = [*(f"{key}={value}" for key, value in self.params.items()), *arguments]
        parsed = OverridesParser.create(config_loader=self.loader).parse_overrides(lines)
        return {override.get_key_element(): override for override in parsed}

    def _open(self, swept: dict[str, Override]) -> Study:
        """The study of the sweep's folder. Raises SettingsError where it is one of another kind."""
        folder = Path(self.config.hydra.sweep.dir)
        folder.mkdir(parents=True, exist_ok=True)
        study = open_study(folder / JOURNAL, str(self.metric))
        now = {
            "hydra.sweeper.metric": str(self.metric),
            **{key: str(o.input_line).partition("=")[2] for key, o in swept.items()},
        }
        there = study.user_attrs.get("asked", now)
        other = [
            f"{key} is {there.get(key, 'fixed')} there and {now.get(key, 'fixed')} now"
            for key in sorted(there.keys() | now.keys())
            if there.get(key) != now.get(key)
        ]
        if study.trials and not other:
            # Every job of a sweep has the first one's fixed settings.
            first = job_settings(self.loader, self.config, self._job(study.trials[0]))
            other = differences(folder / "0", first)
        if other:
            raise SettingsError(
                f"{folder} holds a search with other settings: {'; '.join(other[:3])}. "
                "Choose another folder with run=NAME, or delete this one."
            )
        if not study.user_attrs:
            study.set_user_attr("asked", now)
        return study

    def _begin_trial(self, study: Study, space: dict[str, BaseDistribution], number: int) -> None:
        from optuna import create_study
        from optuna.samplers import TPESampler
        from optuna.trial import TrialState, create_trial

        # Seeded for each trial, so that a search that was killed draws what it would have.
        seed = random.Random(f"{self.seed}/{number}").getrandbits(32)
        drawing = create_study(
            sampler=TPESampler(seed=seed, constant_liar=True), direction=study.direction
        )
        drawing.add_trials(study.trials)
        drawn = drawing.ask(space)
        # Optuna would write one key after another, and a kill might come between them.
        study.add_trial(
            create_trial(
                state=TrialState.RUNNING, params=drawn.params, distributions=drawn.distributions
            )
        )

    def _job(self, trial: FrozenTrial) -> list[str]:
        return [*self.fixed, *(f"{key}={value}" for key, value in trial.params.items())]

    def _launch(self, study: Study, trials: Sequence[FrozenTrial]) -> None:
        """Run the jobs of trials and give the study their values. Trials of jobs that have finished
        come too: the launcher passes over them, and their place in the table is kept."""
        if not trials:
            return
        jobs = [self._job(trial) for trial in trials]
        returns = self.launcher.launch(jobs, initial_job_idx=trials[0].number)
        for trial, returned in zip(trials, returns, strict=True):
            # A failed job gets no value, so that the same command tries it again.
            if (metrics := returned.return_value) is not None:
                self._tell(study, trial.number, final_metrics(metrics))

    def _tell(self, study: Study, number: int, metrics: dict[str, float]) -> None:
        from optuna.trial import TrialState

        if self.metric not in metrics:
            raise UserError(
                f"hydra.sweeper.metric={self.metric}: a job of {self.command} measures "
                f"{', '.join(sorted(metrics)) or 'nothing'} here"
            )
        value = metrics[self.metric]
        if math.isfinite(value):
            study.tell(number, value, skip_if_finished=True)
        else:
            study.tell(number, state=TrialState.FAIL, skip_if_finished=True)


def open_study(journal: Path, metric: str) -> Study:
    """The study of a journal, begun anew where no trial of it has ended: the metric, by which it
    goes which way is better, may have been mistyped so far. Raises UserError without Optuna."""
    try:
        import optuna
        from optuna.storages import JournalStorage
        from optuna.storages.journal import JournalFileBackend
    except ImportError as error:
        raise UserError("hydra/sweeper=optuna needs Optuna: pip install -e '.[optuna]'") from error
    optuna.logging.set_verbosity(optuna.logging.WARNING)

    def opened() -> Study:
        return optuna.create_study(
            storage=JournalStorage(JournalFileBackend(str(journal))),
            study_name="study",
            direction="minimize" if is_lower_better(metric) else "maximize",
            load_if_exists=True,
        )

    _end_torn_line(journal)
    study = opened()
    if any(trial.state.is_finished() for trial in study.trials):
        return study
    journal.unlink()
    return opened()


def distribution(override: Override) -> BaseDistribution:
    """What Optuna draws a key from: an interval, of whole numbers as int(interval(...)) and by
    magnitude as tag(log, ...); a range of whole numbers; or a choice."""
    from optuna.distributions import (
        CategoricalDistribution,
        FloatDistribution,
        IntDistribution,
    )

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
        raise SettingsError(f"{override.input_line}: {error}") from error


def _end_torn_line(journal: Path) -> None:
    """Drop what a kill or a full disk left of a line: the next one would be appended to it."""
    text = journal.read_bytes() if journal.exists() else b""
    if not text.endswith(b"\n"):
        journal.write_bytes(text[: text.rfind(b"\n") + 1])


def _tell_best(study: Study, metric: str) -> None:
    from optuna.trial import TrialState

    if study.get_trials(deepcopy=False, states=[TrialState.COMPLETE]):
        best = study.best_trial
        told = " ".join(f"{key.lstrip('+')}={value}" for key, value in best.params.items())
        log.info("best: #%d %s, %s %.4g", best.number, told, metric, best.value)
