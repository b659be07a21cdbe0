"""Write a trained student for others to load: merged into its base, or its adapters alone.

    checkpoints/export_student/<run>/<format>/student/
        config.json, model.safetensors                 what the standard classes and vLLM load, or
        adapter_config.json, adapter_model.safetensors what peft lays over the base
        tokenizer and processor files
        README.md      the model card
        config.yaml, run.json, metrics.json    the training run's own, base.json with adapters too
        export.json    what was exported, and how far its logits are from the trained student's

The folder is written beside and renamed when it is whole.
"""

from __future__ import annotations

import logging
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import run_below, write_json, write_text
from conf.schema import ExportStudentCommand, SftCommand

if TYPE_CHECKING:
    import torch
    from transformers import PreTrainedModel, ProcessorMixin

    from train.samples import Samples

log = logging.getLogger(__name__)

CHECKED = 16
"""Held-out samples of each mode that the exported student is checked on: at 8B and a rationale's
length their logits take 3 GB."""
LARGEST_DIFFERENCE = 0.05
"""Of logits, as a share of their size. On the tiny student, rounding to bf16 moves them by 0.005,
adapters that are merged into the 4-bit weights by 0.2."""
KEPT = ("config.yaml", "run.json", "metrics.json")
"""The training run's files that go with an export."""

Measured = dict[str, float]


@dataclass(frozen=True)
class Trained:
    """A finished run of train.sft: its name, its folder and its settings."""

    name: str
    folder: Path
    settings: SftCommand

    @property
    def student(self) -> Path:
        return self.folder / "student"


@command("train.export", ExportStudentCommand)
def main(cfg: ExportStudentCommand, run: Run) -> Measured:
    trained = find(cfg)

    from data.store import digest
    from train.card import text
    from train.compatible import check_base
    from train.precision import settled
    from train.trained import EXPORT, export_record

    adapters = trained.student / "adapter_model.safetensors"
    if not adapters.exists():
        raise UserError(f"{trained.student} holds no adapters: delete the run and train again")
    check_base(trained.folder, trained.settings.student.model)
    trained.settings.train.precision = settled(trained.settings.train.precision)
    weights = digest(adapters)
    folder = run.folder / "student"
    if folder.exists():
        record = export_record(folder)
        if record["weights"] != weights:
            raise UserError(
                f"{folder} is an export of other adapters than {trained.student} holds now: "
                "delete it to export these"
            )
        log.info("%s is exported already; delete it to export anew", folder)
        return record["measured"]
    with renamed_when_whole(folder) as partial:
        if cfg.format == "adapter":
            measured = write_adapter(trained, partial)
        else:
            measured = write_merged(trained, cfg, partial)
        for name in KEPT:
            shutil.copy(trained.folder / name, partial)
        card = text(trained.name, trained.settings, trained.folder, cfg.format, measured)
        write_text(partial / "README.md", card)
        noted = {"run": trained.name, "format": cfg.format, "weights": weights}
        write_json(partial / EXPORT, {**noted, "measured": measured})
    for name, value in measured.items():
        log.info("%s: %.4g", name.replace("_", " "), value)
    log.info("the exported student is in %s", folder)
    return measured


def find(cfg: ExportStudentCommand) -> Trained:
    """The run that is to be exported.

    Raises:
        UserError: there is none of that name, it is not finished, or it trained the whole model.
    """
    from train.trained import settings_of

    runs = Path(cfg.checkpoints) / "sft"
    name = run_below(cfg.run, str(runs))
    folder = runs / name
    settings = settings_of(folder, SftCommand, "student", "run")
    if settings.student.lora.rank == 0:
        raise UserError(
            f"run={folder} trained the whole model (student.lora.rank=0), so there are no adapters "
            f"to merge: {folder / 'student'} is what the standard classes and vLLM load"
        )
    return Trained(name, folder, settings)


@contextmanager
def renamed_when_whole(folder: Path) -> Iterator[Path]:
    """A folder beside `folder` to write into. It takes that name in the end; what a kill or a full
    disk left of an earlier one is thrown away."""
    from data.growing import held

    partial = folder.with_name(f".{folder.name}.partial")
    partial.mkdir(exist_ok=True)
    with held(partial, folder):
        for leftover in partial.iterdir():
            shutil.rmtree(leftover) if leftover.is_dir() else leftover.unlink()
        try:
            yield partial
        except (UserError, KeyboardInterrupt):
            shutil.rmtree(partial)
            raise
        partial.rename(folder)


def write_adapter(trained: Trained, folder: Path) -> Measured:
    """Copy the adapters and the processor, and the hash of the base that they were trained over."""
    from train.compatible import BASE

    shutil.copytree(trained.student, folder, dirs_exist_ok=True)
    if (trained.folder / BASE).exists():
        shutil.copy(trained.folder / BASE, folder)
    return {}


def write_merged(trained: Trained, cfg: ExportStudentCommand, folder: Path) -> Measured:
    """Write the merged weights and the processor, read them back, and measure how far the logits on
    held-out samples are from those of the trained student, adapters over the 4-bit base.

    Raises:
        UserError: they are too far.
    """
    from train import backbone

    student, train = trained.settings.student, trained.settings.train
    held_out = validation(trained.settings, Path(cfg.store), cfg.workers)
    log.info("asking the trained student")
    model, processor = backbone.load_trained(student, train.precision, trained.student)
    # As it was trained: packed for inference, some CPUs round 4-bit products another way.
    backbone.keep_differentiable(model)
    before = outputs(model, processor, trained.settings, held_out, train.precision)
    # Of two models of this size a GPU holds one.
    del model
    log.info("merging")
    model, processor = merge(trained, cfg.format)
    backbone.write(model, processor, folder)
    del model
    log.info("asking the exported student")
    model, processor = backbone.load_merged(folder)
    after = outputs(model, processor, trained.settings, held_out, "as written")
    measured = compare(before, after)
    for mode in held_out:
        # A NaN is no small difference.
        if not (found := measured[f"{mode}_logit_difference"]) <= LARGEST_DIFFERENCE:
            raise UserError(
                f"the logits of the exported student differ by {found:.3g} of their size from "
                f"those of {trained.student} in {mode} mode, more than {LARGEST_DIFFERENCE}; "
                "nothing was exported. Try format=fp32 or format=adapter"
            )
    return measured


def validation(settings: SftCommand, store_folder: Path, workers: int) -> dict[str, Samples]:
    """The samples that measured the run while it was trained, by mode."""
    from data.build import ensure_benchmark
    from data.frames import Frames
    from teacher.narrate import ensure_rationales
    from train import samples

    store = ensure_benchmark(settings.benchmark, store_folder, workers)
    reasons = settings.train.regime not in ("answer_only", "describe")
    rationales = ensure_rationales(store, settings.teacher) if reasons else []
    frames = Frames(store, settings.student.image_size)
    return samples.splits(store, rationales, settings, frames)[1]


def merge(trained: Trained, precision: str) -> tuple[PreTrainedModel, ProcessorMixin]:
    """The base as its 4-bit weights say it, with the adapters added in `precision`.

    Merged into the 4-bit weights themselves, most of what was trained would be rounded away; over
    the base as it was before it was quantised, the adapters would miss what they were trained to
    make up for.
    """
    import peft

    from train import backbone

    student = trained.settings.student
    dtype = backbone.DTYPES[precision]
    base, processor = backbone.load_base(student, trained.settings.train.precision, list)
    if student.quantization == "nf4":
        base = base.dequantize(dtype)
    adapted = peft.PeftModel.from_pretrained(base.to(dtype), trained.student)
    return adapted.merge_and_unload(), processor


@dataclass(frozen=True)
class Outputs:
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
) -> dict[str, list[Outputs]]:
    """The outputs for the first held-out samples of each mode. A student that is trained computes
    in bf16 where that is its `precision`, one that was written as its weights are."""
    import torch

    from train.collate import Collator, letter_ids
    from train.sft_trainer import LetterChoice

    describes = settings.train.regime == "describe"
    letters = None if describes else LetterChoice(letter_ids(processor))
    collator = Collator(processor, settings.student.max_length)
    device = next(model.parameters()).device
    found: dict[str, list[Outputs]] = {}
    for mode, samples in held_out.items():
        found[mode] = []
        for k in range(min(CHECKED, len(samples))):
            batch = {name: value.to(device) for name, value in collator([samples[k]]).items()}
            labels = batch.pop("labels")
            computing = torch.autocast(device.type, torch.bfloat16, enabled=precision == "bf16")
            with torch.inference_mode(), computing:
                logits = model(**batch).logits.float()
            letter = int(letters.shrink(logits, labels)[0, 0]) if letters else None
            found[mode].append(Outputs(logits[0, :-1].cpu(), letter))
    return found


def compare(before: dict[str, list[Outputs]], after: dict[str, list[Outputs]]) -> Measured:
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


if __name__ == "__main__":
    main()
