"""A run's journal: what is logged while it trains, in its file, on its bar, and read again."""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

from transformers import ProgressCallback, TrainerCallback
from transformers.trainer_callback import TrainerControl, TrainerState

from conf.errors import UserError
from conf.multirun.table import AT_START_SUFFIX
from conf.runs import write_text
from train.common.curves import curves_figure

JOURNAL = "metrics.jsonl"
WRITTEN = "samples.jsonl"
"""What a student wrote at each evaluation of its run, one JSON line an answer."""
CURVES = "curves.png"
BEST_STEP = "best_step"
"""Name of the step whose checkpoint a run kept, among what it evaluated."""
UNSHARED = ("_runtime", "_per_second", "total_flos", "train_loss")
"""Ends of the logged names that no two runs share: timings, and the trainer's mean over the run,
which counts only the steps since it was resumed."""

SHOWN = {
    "generated_parse_rate": "parsed",
    "generated_accuracy": "right",
    "letter_accuracy": "letter",
    "token_accuracy": "token",
    "loss": "loss",
    "recall@10": "recall@10",
}
"""What the bar shows, by the end of its name, and what it is called there."""


class Journal(TrainerCallback):
    """Appends what the trainer logs to the run's metrics.jsonl, and on resuming drops the lines
    past the checkpoint from it and from samples.jsonl, so that both are an undisturbed run's. The
    curves are drawn with each checkpoint."""

    def __init__(self, folder: Path) -> None:
        self._path = folder / JOURNAL

    def on_train_begin(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        resumed = state.global_step > 0
        for path in (self._path, self._path.with_name(WRITTEN)):
            kept = [r for r in read_lines(path) if resumed and r["step"] <= state.global_step]
            if kept or path.exists():
                write_text(path, "".join(json.dumps(r) + "\n" for r in kept))

    def on_log(self, args, state: TrainerState, control: TrainerControl, logs=None, **_) -> None:
        values = {k: v for k, v in (logs or {}).items() if not k.endswith(UNSHARED)}
        if not values.keys() - {"epoch"}:
            return
        with open(self._path, "a") as file:
            file.write(json.dumps({"step": state.global_step, **values}) + "\n")

    def on_save(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        curves_figure(read_journal(self._path.parent), self._path.with_name(CURVES))


class NamedMeasure(TrainerCallback):
    """Holds train.best against what the evaluation at the start measured, before the first step."""

    def on_step_begin(self, args, state: TrainerState, control: TrainerControl, **_) -> None:
        best = args.metric_for_best_model
        if best is None or state.best_global_step:
            return
        names = {k for r in state.log_history for k in r if k.startswith("eval_")}
        names = sorted(k for k in names if not k.endswith((*UNSHARED, "_preparation_time")))
        if f"eval_{best.removeprefix('eval_')}" not in names:
            raise UserError(
                f"train.best={best} is nothing that an evaluation of this run measures; the "
                f"options are {', '.join(names)}"
            )


class Bar(ProgressCallback):
    """The trainer's bar with its newest figures in it."""

    def __init__(self, max_str_len: int = 100) -> None:
        super().__init__(max_str_len)
        self._figures: dict[str, dict[str, str]] = {"": {}}

    def on_prediction_step(self, args, state, control, **_) -> None:
        """An evaluation's own bar would break the line of the run's."""

    def on_log(self, args, state, control, logs=None, **_) -> None:
        for name, value in (logs or {}).items():
            shown = next((end for end in SHOWN if name.endswith(end)), None)
            if shown and not name.endswith(UNSHARED):
                mode = name.removesuffix(shown).removeprefix("eval_").strip("_")
                self._figures.setdefault(mode, {})[SHOWN[shown]] = f"{value:.3g}"
        if self.training_bar is not None:
            told = [
                " ".join([mode, *(f"{name}={value}" for name, value in figures.items())]).strip()
                for mode, figures in self._figures.items()
                if figures
            ]
            self.training_bar.set_postfix_str(", ".join(told))


def read_journal(folder: Path) -> list[dict[str, Any]]:
    """The lines of a run's metrics.jsonl; one torn by a kill is passed over."""
    return read_lines(folder / JOURNAL)


def read_lines(path: Path) -> list[dict[str, Any]]:
    """The JSON lines of a file that tell their step."""
    if not path.exists():
        return []
    records = []
    for line in path.read_text(errors="replace").splitlines():
        try:
            record = json.loads(line)
        except ValueError:
            continue
        if isinstance(record, dict) and "step" in record:
            records.append(record)
    return records


def evaluated(folder: Path, best: int | None = None) -> dict[str, float]:
    """What a run evaluated at first and of what it kept: `<name>_at_start` and `<name>`. What it
    kept is that of its last step, or of the step `best`, which is then given too."""
    records = [r for r in read_journal(folder) if any(k.startswith("eval_") for k in r)]
    results: dict[str, float] = {}
    if best is not None:
        records = [r for r in records if r["step"] <= best]
        results[BEST_STEP] = float(best)
    for record in records:
        for key, value in record.items():
            if key.startswith("eval_"):
                name = key.removeprefix("eval_")
                results.setdefault(f"{name}{AT_START_SUFFIX}", value)
                results[name] = value
    return results
