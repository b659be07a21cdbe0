"""A student merged into its base: written, read back, and held against the trained one."""

from __future__ import annotations

import logging
from dataclasses import dataclass
from pathlib import Path

import torch
from transformers import PreTrainedModel, ProcessorMixin

from conf.errors import UserError
from conf.schema import ExportModelCommand, SftCommand
from data.build import ensure_benchmark
from data.render.frame_cache import FrameReader
from models import loading
from models.student.collator import Collator, letter_ids
from teacher.narrate import ensure_rationales
from train.student.dataset import Samples, splits
from train.student.trainer import LetterChoice

log = logging.getLogger(__name__)

CHECKED = 16
"""Held-out samples of each mode that the exported student is checked on: at 8B and a rationale's
length their logits take 3 GB."""
LARGEST_DIFFERENCE = 0.05
"""Of logits, as a share of their size. On the tiny student, rounding to bf16 moves them by 0.005,
adapters that are merged into the 4-bit weights by 0.2."""

Measured = dict[str, float]


def write_merged(
    settings: SftCommand, saved: Path, cfg: ExportModelCommand, folder: Path
) -> Measured:
    """Write the merged weights and the processor, read them back, and measure how far the logits on
    held-out samples are from those of the student in `saved`, adapters over the 4-bit base.

    Raises:
        UserError: they are too far.
    """
    student, train = settings.student, settings.train
    held_out = validation(settings, Path(cfg.store), cfg.workers)
    log.info("asking the trained student")
    model, processor = loading.load_trained(student, train.precision, saved)
    # As it was trained: packed for inference, some CPUs round 4-bit products another way.
    loading.keep_differentiable(model)
    before = outputs(model, processor, settings, held_out, train.precision)
    # Of two models of this size a GPU holds one.
    del model
    log.info("merging")
    model, processor = merge(settings, saved, cfg.format)
    loading.write_model(model, processor, folder)
    del model
    log.info("asking the exported student")
    model, processor = loading.load_merged(folder)
    after = outputs(model, processor, settings, held_out, "as written")
    measured = compare(before, after)
    for mode in held_out:
        # A NaN is no small difference.
        if not (found := measured[f"{mode}_logit_difference"]) <= LARGEST_DIFFERENCE:
            raise UserError(
                f"the logits of the exported student differ by {found:.3g} of their size from "
                f"those of {saved} in {mode} mode, more than {LARGEST_DIFFERENCE}; "
                "nothing was exported. Try format=fp32 or format=adapter"
            )
    return measured


def validation(settings: SftCommand, store_folder: Path, workers: int) -> dict[str, Samples]:
    """The samples that measured the run while it was trained, by mode."""
    store = ensure_benchmark(settings.benchmark, store_folder, workers)
    reasons = settings.train.regime not in ("answer_only", "describe")
    rationales = ensure_rationales(store, settings.teacher) if reasons else []
    frames = FrameReader(store, settings.student.image_size)
    return splits(store, rationales, settings, frames)[1]


def merge(
    settings: SftCommand, saved: Path, precision: str
) -> tuple[PreTrainedModel, ProcessorMixin]:
    """The base with the adapters added in `precision`, and its processor."""
    base, processor = loading.load_base(settings.student, settings.train.precision, list)
    return loading.merge_adapters(base, saved, settings.student.quantization, precision), processor


@dataclass(frozen=True)
class StudentOutputs:
    """What a student gives for one sample.

    Attributes:
        logits: (K - 1, V) where a supervised token is predicted, fp32.
        letter: index of the letter that it would answer; None where the sample asks for none.
    """

    logits: torch.Tensor
    letter: int | None


def outputs(
    model: torch.nn.Module,
    processor: ProcessorMixin,
    settings: SftCommand,
    held_out: dict[str, Samples],
    precision: str,
) -> dict[str, list[StudentOutputs]]:
    """The outputs for the first held-out samples of each mode. A student that is trained computes
    in bf16 where that is its `precision`, one that was written as its weights are."""
    describes = settings.train.regime == "describe"
    letters = None if describes else LetterChoice(letter_ids(processor))
    collator = Collator(processor, settings.student.max_length)
    device = next(model.parameters()).device
    found: dict[str, list[StudentOutputs]] = {}
    for mode, samples in held_out.items():
        found[mode] = []
        for k in range(min(CHECKED, len(samples))):
            batch = {name: value.to(device) for name, value in collator([samples[k]]).items()}
            labels = batch.pop("labels")
            computing = torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16")
            with torch.inference_mode(), computing:
                logits = model(**batch).logits.float()
            letter = int(letters.shrink(logits, labels)[0, 0]) if letters else None
            found[mode].append(StudentOutputs(logits[0, :-1].cpu(), letter))
    return found


def compare(
    before: dict[str, list[StudentOutputs]], after: dict[str, list[StudentOutputs]]
) -> Measured:
    """By mode, the size of the logits' difference as a share of the logits' own, and the share of
    samples for which the chosen letter is the same."""
    measured: Measured = {}
    for mode, first in before.items():
        pairs = list(zip(first, after[mode], strict=True))
        change = sum(float((b.logits - a.logits).square().sum()) for b, a in pairs)
        size = sum(float(b.logits.square().sum()) for b in first)
        measured[f"{mode}_logit_difference"] = (change / size) ** 0.5
        if first[0].letter is not None:
            same = sum(b.letter == a.letter for b, a in pairs)
            measured[f"{mode}_letter_agreement"] = same / len(pairs)
    return measured
