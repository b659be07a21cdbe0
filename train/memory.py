"""How a step's samples are split, and whether activations are recomputed: what the settings leave
to the trainer (`auto`) is tried on the run's longest samples and noted in the run's folder.

Neither changes what is learnt. Keeping activations is faster than recomputing them, so they are
kept wherever that fits; the micro-batch then grows as long as it fits and makes a sample faster.
"""

from __future__ import annotations

import json
import logging
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import torch
from accelerate import PartialState
from accelerate.utils import gather_object
from torch import nn

from conf.runs import write_json
from conf.schema import SftTrainConfig
from train.collate import Collator
from train.loop import is_out_of_memory
from train.planned import Samples
from train.room import available, peak, start_peak
from train.sft_trainer import token_mean

log = logging.getLogger(__name__)

NOTE = "memory.json"
"""What was chosen, in the run's folder; a run that goes on takes it from there."""
SHARE = 0.8
"""Of the free memory that a step may take: blocks do not fill it without gaps, and which samples
are longest is known only about."""
FASTER = 0.95
"""A bigger micro-batch must take less than this share of the time that a sample took before."""
MOMENTS = 8
"""Bytes of AdamW's two fp32 moments of a trained weight."""


@dataclass(frozen=True)
class Choice:
    micro_batch: int
    gradient_checkpointing: bool


@dataclass(frozen=True)
class Tried:
    """A forward and backward pass of `samples` samples: the most bytes that it held on top of what
    was held before, and how long it took."""

    samples: int
    bytes: int
    seconds: float


Try = Callable[[int, bool], Tried | None]
"""Passes so many samples, recomputing activations or not; None where memory ran out."""


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
    if "auto" not in (train.micro_batch, train.gradient_checkpointing):
        return train
    state = PartialState(cpu=not torch.cuda.is_available())
    share = train.batch // state.num_processes
    if (noted := read_note(folder)) and share % noted.micro_batch == 0:
        return replace(train, **asdict(noted))
    model.to(state.device)
    # Ranks on CPUs share one memory.
    sharing = state.num_processes if state.device.type == "cpu" else 1
    limit = int(SHARE * available(state.device) / sharing) - optimizer_bytes(model)
    with probe(model, collator, training, lengths, train.precision) as attempt:
        choice, needed = choose(attempt, train, share, limit)
    # All ranks have to make the same steps.
    choice = least(gather_object([choice]))
    log.info(
        "micro-batch %d of %d samples, activations %s: %s",
        choice.micro_batch,
        train.batch,
        "recomputed" if choice.gradient_checkpointing else "kept",
        f"more than the {gib(limit)} that are free"
        if needed is None
        else f"{gib(needed)} of {gib(limit)}",
    )
    if state.is_main_process:
        write_json(folder / NOTE, asdict(choice))
    return replace(train, **asdict(choice))


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


def choose(
    attempt: Try, train: SftTrainConfig, share: int, limit: int
) -> tuple[Choice, int | None]:
    """What of a rank's `share` samples a step fits into `limit` bytes, and the bytes that it takes;
    the least that there is, and None, where nothing fits."""
    given, asked = train.micro_batch, train.gradient_checkpointing
    candidates = sizes(share) if given == "auto" else [1]
    modes = (False, True) if asked == "auto" else (bool(asked),)
    for recompute in modes:
        best = climb(lambda size, on=recompute: attempt(size, on), candidates, limit)
        if best is not None:
            size = best.samples if given == "auto" else int(given)
            needed = best.bytes * size // best.samples
            if needed <= limit:
                return Choice(size, recompute), needed
    return Choice(1 if given == "auto" else int(given), modes[-1]), None


def climb(
    attempt: Callable[[int], Tried | None], candidates: Sequence[int], limit: int
) -> Tried | None:
    """The fastest of growing micro-batches that fits into `limit` bytes; none is tried that might
    not, by what the one before took. On a CPU the kernel would end the process."""
    best = None
    for size in candidates:
        if best is not None and best.bytes * size > limit * best.samples:
            break
        tried = attempt(size)
        if tried is None or tried.bytes > limit:
            break
        if best is not None and tried.seconds / size > FASTER * best.seconds / best.samples:
            break
        best = tried
    return best


def sizes(share: int) -> list[int]:
    """Divisors of a rank's samples a step, each at least twice the one before."""
    found = [1]
    for size in range(2, share + 1):
        if share % size == 0 and size >= 2 * found[-1]:
            found.append(size)
    return found


@contextmanager
def probe(
    model: nn.Module,
    collator: Collator,
    training: Samples,
    lengths: Sequence[int],
    precision: str,
) -> Iterator[Try]:
    """Tries the longest samples on a model that has no gradients, and leaves it, and what is drawn
    after, as if it had not."""
    device = next(model.parameters()).device
    longest = sorted(range(len(lengths)), key=lambda k: -lengths[k])
    was_training = model.training

    def attempt(count: int, recompute: bool) -> Tried | None:
        switch(model, recompute)
        batch = collator([training[longest[k % len(longest)]] for k in range(count)])
        batch = {name: value.to(device) for name, value in batch.items()}
        labels = batch.pop("labels")

        def step() -> None:
            try:
                with torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16"):
                    loss = token_mean(model(**batch), labels)
                loss.backward()
            finally:
                model.zero_grad()

        return measured(step, count, device)

    with torch.random.fork_rng([device] if device.type == "cuda" else []):
        try:
            model.train()
            yield attempt
        finally:
            switch(model, False)
            model.train(was_training)
            if device.type == "cuda":
                torch.cuda.empty_cache()


def switch(model: nn.Module, recompute: bool) -> None:
    """Recompute activations in the backward pass, or keep them, by the name that this version of
    transformers has for it."""
    new = hasattr(model, "activation_checkpointing_enable")
    name = "activation_checkpointing" if new else "gradient_checkpointing"
    if recompute:
        getattr(model, f"{name}_enable")(**{f"{name}_kwargs": {"use_reentrant": False}})
    else:
        getattr(model, f"{name}_disable")()


def measured(step: Callable[[], None], samples: int, device: torch.device) -> Tried | None:
    """What a step takes; the better time of two, since the first warms up."""
    held = start_peak(device)
    seconds = []
    try:
        for _ in range(2):
            started = time.perf_counter()
            step()
            if device.type == "cuda":
                torch.cuda.synchronize(device)
            seconds.append(time.perf_counter() - started)
    except RuntimeError as error:
        if not is_out_of_memory(error):
            raise
        return None
    return Tried(samples, max(0, peak(device) - held), min(seconds))


def lower(train: SftTrainConfig) -> str:
    """By which key a run that was out of memory takes less of it."""
    if train.micro_batch != 1:
        return f"train.micro_batch, which is {train.micro_batch}"
    return "student.image_size or student.frames"


def gib(size: int) -> str:
    return f"{size / 2**30:.2f} GiB"


def optimizer_bytes(model: nn.Module) -> int:
    return MOMENTS * sum(p.numel() for p in model.parameters() if p.requires_grad)
