"""How a step's samples or queries are split, and whether activations are recomputed: what the
settings leave to the trainer (`auto`) is tried on the run's longest and noted in the run's folder.

Neither changes what is learnt. Keeping activations is faster than recomputing them, so they are
kept wherever that fits; the micro-batch then grows as long as it fits and makes a step faster.
"""

from __future__ import annotations

import json
import logging
import math
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Protocol

import torch
from accelerate import PartialState
from accelerate.utils import gather_object
from torch import nn

from conf.runs import write_json
from conf.schema import SftTrainConfig
from models.distributed import is_sharded
from models.memory import available_bytes, is_out_of_memory, peak_bytes, reset_peak
from models.student.collator import Collator
from train.student.lazy_samples import LengthSampler, Samples
from train.student.trainer import token_mean

log = logging.getLogger(__name__)

NOTE = "memory.json"
"""What was chosen, in the run's folder; a run that goes on takes it from there."""
SHARE = 0.8
"""Of the free memory that a step may take: blocks do not fill it without gaps, and which samples
are longest is known only about."""
FASTER = 0.97
"""A bigger micro-batch must take less than this share of the time that a step took before."""
MOMENTS = 8
"""Bytes of AdamW's two fp32 moments of a trained weight."""


@dataclass(frozen=True)
class Choice:
    """How many samples or queries pass at once, and whether activations are recomputed; of what is
    asked for, either may be auto."""

    micro_batch: int | str
    gradient_checkpointing: bool | str


class Trial(Protocol):
    """What a step takes with so many samples at once, recomputing activations or not."""

    def bytes(self, micro_batch: int, recompute: bool) -> int | None:
        """The most that the longest samples hold, on top of what was held before; None where
        memory ran out."""

    def seconds(self, micro_batch: int, recompute: bool) -> float:
        """What all samples of a step take, one micro-batch after the other."""


def settle(
    train: SftTrainConfig,
    folder: Path,
    model: nn.Module,
    collator: Collator,
    training: Samples,
    lengths: Sequence[int],
) -> SftTrainConfig:
    """The settings with a number for `micro_batch` and a truth for `gradient_checkpointing`: what
    was given, what a run's folder notes, or what a probe of the samples leads to."""

    def trial(share: int) -> Trial:
        return Passes(model, collator, training, lengths, train, share)

    asked = Choice(train.micro_batch, train.gradient_checkpointing)
    spare = spare_beside(train.reuse_features)
    found = decide(asked, train.batch, folder, model, trial, "micro-batch", spare)
    return replace(train, **asdict(found))


def spare_beside(features: bool) -> float:
    """The share of the free memory that a step may have where features are kept beside it, or are
    not: on a CPU they take half of what is the step's too."""
    return SHARE / 2 if features and not torch.cuda.is_available() else SHARE


def decide(
    asked: Choice,
    batch: int,
    folder: Path,
    model: nn.Module,
    trial: Callable[[int], Trial],
    named: str,
    spare: float = SHARE,
) -> Choice:
    """What was asked for, with a number and a truth in the place of auto; `trial` tries what a rank
    takes of a step of `batch` samples, `spare` is the share of the free memory that it may have,
    and `named` is how its parts are called."""
    if "auto" not in (asked.micro_batch, asked.gradient_checkpointing):
        return asked
    if is_sharded():
        # What is to be sharded may not fit a rank before it is.
        least_of = {"micro_batch": 1, "gradient_checkpointing": True}
        return Choice(**{k: least_of[k] if v == "auto" else v for k, v in vars(asked).items()})
    state = PartialState(cpu=not torch.cuda.is_available())
    share = batch // state.num_processes
    noted = read_note(folder)
    if noted and (asked.micro_batch == noted.micro_batch or share % noted.micro_batch == 0):
        return noted
    model.to(state.device)
    # Ranks on CPUs share one memory.
    sharing = state.num_processes if state.device.type == "cpu" else 1
    limit = int(spare * available_bytes(state.device) / sharing) - optimizer_bytes(model)
    with probing(model):
        choice, needed = choose(trial(share), asked, share, limit)
    # All ranks have to make the same steps.
    choice = least(gather_object([choice]))
    if state.is_main_process:
        log.info(
            "%s %d of %d, activations %s: %s",
            named,
            choice.micro_batch,
            batch,
            "recomputed" if choice.gradient_checkpointing else "kept",
            f"more than the {gib(limit)} that are free"
            if needed is None
            else f"{gib(needed)} of {gib(limit)}",
        )
        write_json(folder / NOTE, asdict(choice))
    return choice


def read_note(folder: Path) -> Choice | None:
    """What an earlier start of a run chose; a note that cannot be read is none."""
    try:
        return Choice(**json.loads((folder / NOTE).read_text()))
    except (OSError, ValueError, TypeError):
        return None


def least(choices: Sequence[Choice]) -> Choice:
    """What fits every rank."""
    return Choice(
        min(c.micro_batch for c in choices), any(c.gradient_checkpointing for c in choices)
    )


def choose(trial: Trial, asked: Choice, share: int, limit: int) -> tuple[Choice, int | None]:
    """What of a rank's `share` samples a step fits into `limit` bytes, and the bytes that it takes;
    the least that there is, and None, where nothing fits."""
    given, mode = asked.micro_batch, asked.gradient_checkpointing
    candidates = sizes(share) if given == "auto" else [1]
    modes = (False, True) if mode == "auto" else (bool(mode),)
    for recompute in modes:
        if (best := climb(trial, recompute, candidates, limit)) is not None:
            tried, held = best
            size = tried if given == "auto" else int(given)
            needed = held * size // tried
            if needed <= limit:
                return Choice(size, recompute), needed
    return Choice(1 if given == "auto" else int(given), modes[-1]), None


def climb(
    trial: Trial, recompute: bool, candidates: Sequence[int], limit: int
) -> tuple[int, int] | None:
    """The fastest of growing micro-batches that fits into `limit` bytes, and its bytes; none is
    tried that might not fit, by what the one before took: on a CPU the kernel would end the
    process."""
    best, best_seconds = None, math.inf
    for size in candidates:
        if best is not None and best[1] * size > limit * best[0]:
            break
        held = trial.bytes(size, recompute)
        if held is None or held > limit:
            break
        # One candidate needs no comparing.
        seconds = trial.seconds(size, recompute) if len(candidates) > 1 else 0.0
        if seconds > FASTER * best_seconds:
            break
        best, best_seconds = (size, held), seconds
    return best


def sizes(share: int) -> list[int]:
    """Divisors of a rank's samples a step, each at least twice the one before."""
    found = [1]
    for size in range(2, share + 1):
        if share % size == 0 and size >= 2 * found[-1]:
            found.append(size)
    return found


@contextmanager
def probing(model: nn.Module) -> Iterator[None]:
    """Leave a model that has no gradients, and what is drawn after, as if nothing were tried."""
    device = next(model.parameters()).device
    was_training = model.training
    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        try:
            model.train()
            yield
        finally:
            switch(model, False)
            model.train(was_training)
            if device.type == "cuda":
                torch.cuda.empty_cache()


class Passes:
    """Trials by forward and backward passes of the run's own samples."""

    def __init__(
        self,
        model: nn.Module,
        collator: Collator,
        training: Samples,
        lengths: Sequence[int],
        train: SftTrainConfig,
        share: int,
    ) -> None:
        self._model = model
        self._collator = collator
        self._training = training
        self._longest = sorted(range(len(lengths)), key=lambda k: -lengths[k])
        self._step = list(LengthSampler(lengths, train.batch, 0))[:share]
        self._bf16 = train.precision == "bf16"
        self._device = next(model.parameters()).device

    def bytes(self, micro_batch: int, recompute: bool) -> int | None:
        switch(self._model, recompute)
        longest = self._longest
        batch = self._batch([longest[k % len(longest)] for k in range(micro_batch)])
        held = reset_peak(self._device)
        try:
            self._pass(batch)
        except RuntimeError as error:
            if not is_out_of_memory(error):
                raise
            return None
        return max(0, peak_bytes(self._device) - held)

    def seconds(self, micro_batch: int, recompute: bool) -> float:
        switch(self._model, recompute)
        # Making the samples is no part of it: workers may do that.
        batches = [
            self._batch(self._step[k : k + micro_batch])
            for k in range(0, len(self._step), micro_batch)
        ]
        self._pass(batches[0])
        started = time.perf_counter()
        for batch in batches:
            self._pass(batch)
        return time.perf_counter() - started

    def _batch(self, indices: Sequence[int]) -> dict[str, torch.Tensor]:
        batch = self._collator([self._training[k] for k in indices])
        return {
            name: value.to(self._device) if isinstance(value, torch.Tensor) else value
            for name, value in batch.items()
        }

    def _pass(self, batch: dict[str, torch.Tensor]) -> None:
        labels = batch["labels"]
        inputs = {k: value for k, value in batch.items() if k not in ("labels", "sights")}
        try:
            with torch.autocast(self._device.type, torch.bfloat16, enabled=self._bf16):
                loss = token_mean(self._model(**inputs), labels)
            loss.backward()
        finally:
            self._model.zero_grad()
        if self._device.type == "cuda":
            torch.cuda.synchronize(self._device)


def switch(model: nn.Module, recompute: bool) -> None:
    """Recompute activations in the backward pass, or keep them, by the name that this version of
    transformers has for it."""
    new = hasattr(model, "activation_checkpointing_enable")
    name = "activation_checkpointing" if new else "gradient_checkpointing"
    if recompute:
        getattr(model, f"{name}_enable")(**{f"{name}_kwargs": {"use_reentrant": False}})
    else:
        getattr(model, f"{name}_disable")()


def lower(train: SftTrainConfig) -> str:
    """By which keys a run that was out of memory takes less of it."""
    named = "student.image_size or student.frames"
    if train.micro_batch != 1:
        named = f"train.micro_batch, which is {train.micro_batch}"
    return lowered(named, train)


def lowered(named: str, train: SftTrainConfig) -> str:
    """That what is `named` is to be lowered, and which switches are left to turn."""
    switched = {"gradient_checkpointing": True, "reuse_features": False}
    left = [
        f"set train.{key}={str(spares).lower()}"
        for key, spares in switched.items()
        if getattr(train, key) is not spares
    ]
    return f"{', or '.join([f'lower {named}', *left])}, in a run of its own (run=NAME)"


def gib(size: int) -> str:
    return f"{size / 2**30:.2f} GiB"


def optimizer_bytes(model: nn.Module) -> int:
    return MOMENTS * sum(p.numel() for p in model.parameters() if p.requires_grad)
