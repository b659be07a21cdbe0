"""Callbacks of both trainers."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from transformers import ProgressCallback, TrainerCallback
from transformers.trainer_callback import TrainerControl, TrainerState

from dynapix.conf.files import write_json_lines
from dynapix.train.common.curves import plot_curves
from dynapix.train.common.journal import ANSWERS, CURVES, JOURNAL, read_journal, read_lines

NOT_REPRODUCIBLE = ("_runtime", "_per_second", "step_time", "total_flos", "train_loss")
"""Suffixes of logged names that the journal leaves out: timings, numbers of operations, and the
trainer's mean loss, which in a resumed run counts only the steps since it resumed."""
BAR_MEASURES = (
    "loss", "letter_accuracy", "token_accuracy", "recall@10", "sampled_accuracy", "reward",
    "answer/mean", "truth/mean", "following/mean", "no_numbers/mean", "form/mean",
)  # fmt: skip
"""Suffixes of the measures that the progress bar shows."""


class JournalCallback(TrainerCallback):
    """Appends what the trainer logs to metrics.jsonl, and plots the curves at the end.

    A run that resumes first deletes the lines of steps after its checkpoint from metrics.jsonl and
    samples.jsonl, and a run that starts again deletes all lines.
    """

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOURNAL

    def on_train_begin(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        resumed = state.global_step > 0
        for path in (self._path, self._path.with_name(ANSWERS)):
            kept = [r for r in read_lines(path) if resumed and r["step"] <= state.global_step]
            if kept or path.exists():
                write_json_lines(path, kept)

    def on_log(self, args, state: TrainerState, control: TrainerControl, logs=None, **_) -> None:
        values = {k: v for k, v in (logs or {}).items() if not k.endswith(NOT_REPRODUCIBLE)}
        if not values.keys() - {"epoch"}:
            return
        with open(self._path, "a") as file:
            file.write(json.dumps({"step": state.global_step, **values}) + "\n")

    def on_train_end(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        plot_curves(read_journal(self._path.parent), self._path.with_name(CURVES))


class EpochCallback(TrainerCallback):
    """Calls `set_epoch` of datasets and samplers at the beginning of each epoch. The library does
    not reach a sampler that it has wrapped to resume within an epoch."""

    def __init__(self, *datasets_and_samplers: Any) -> None:
        self._datasets_and_samplers = datasets_and_samplers

    def on_epoch_begin(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        # The epoch is fractional if the run resumed within an epoch.
        for part in self._datasets_and_samplers:
            part.set_epoch(int(state.epoch or 0))


class MetricsBar(ProgressCallback):
    """The library's progress bar, followed by the latest measures."""

    def __init__(self) -> None:
        super().__init__()
        self._latest: dict[str, float] = {}

    def on_prediction_step(self, args, state, control, **_) -> None:
        """Show no bar for an evaluation: it would break the line of the training bar."""

    def on_log(self, args, state, control, logs=None, **_) -> None:
        for name, value in (logs or {}).items():
            if name.endswith(BAR_MEASURES) and name != "train_loss":
                self._latest[name.removeprefix("eval_")] = value
        if self.training_bar is not None:
            self.training_bar.set_postfix(self._latest)
