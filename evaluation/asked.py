"""How a model is asked about selection items: here or at servers, in which modes, and by what an
answer is known again."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from conf.errors import UserError
from conf.schema import SelectCommand, StudentConfig
from data.frames import Frames
from data.records import SelectionItem
from evaluation import here, served
from evaluation.answers import RECORDS, Say
from evaluation.protocol import instruction as record_instruction
from evaluation.protocol import schema
from train import backbone, compatible, room
from train.conversation import Sample, asked_sample, instruction
from train.generate import new_tokens
from train.trained import product_folder


@dataclass(frozen=True)
class Asked:
    """A model that can be asked: `say` by mode, and what its answers are known by."""

    revision: dict[str, Any]
    say: Callable[[str], Say]


def model_here(
    cfg: SelectCommand,
    folder: Path | None,
    student: StudentConfig,
    precision: str,
    regime: str,
    frames: Frames,
) -> Asked:
    """A model that is loaded on this machine: the student in a run's or an export's `folder`, or
    the base.

    Raises:
        UserError: it cannot be loaded, or its base is not the one that it was trained over.
    """
    room.keep_big_blocks()
    weights = None
    if folder is not None:
        compatible.check_base(folder, student.model)
        weights = product_folder(folder, "student")
        model, processor = backbone.load_trained(student, precision, weights)
    else:
        model, processor = backbone.load_base(student, precision, list)

    def say(mode: str) -> Say:
        sample_of = partial(shown, mode, regime, frames, student, cfg.control)
        return partial(
            here.say, model, processor, student, precision, cfg.batch, cfg.seed, mode, sample_of
        )

    revision = {
        "weights": compatible.weights_digest(student.model, weights),
        "revision": student.revision,
        "quantization": student.quantization,
        "precision": precision,
    }
    return Asked(revision, say)


def model_served(
    cfg: SelectCommand, folder: Path | None, student: StudentConfig, regime: str, frames: Frames
) -> Asked:
    """A model that servers have.

    Raises:
        UserError: none can be asked, or the model goes by another name there.
    """
    if folder is not None and cfg.server.model is None:
        raise UserError(
            f"model={folder} is asked at server.url: give server.model=NAME, by which the server "
            "has that student, so that its base is not taken for it"
        )
    server = replace(cfg.server, model=cfg.server.model or student.model)
    told = served.revision(server)
    weights = product_folder(folder, "student") if folder else None
    told["weights"] = compatible.weights_digest(told["root"], told["parent"], weights)

    def say(mode: str) -> Say:
        sample_of = partial(shown, mode, regime, frames, student, cfg.control)
        return partial(served.say, server, student, cfg.seed, mode, sample_of)

    return Asked({"served": server.model, **told}, say)


def told(mode: str, regime: str) -> str:
    """What a model is told to write in a mode; `regime` is how a student was trained."""
    return record_instruction() if mode in RECORDS else instruction(mode, regime)


def shown(
    mode: str,
    regime: str,
    frames: Frames,
    cfg: StudentConfig,
    control: str | None,
    item: SelectionItem,
) -> Sample:
    return asked_sample(item, mode, told(mode, regime), frames, cfg, control=control)


def known_by(
    mode: str,
    regime: str,
    student: StudentConfig,
    seed: int,
    revision: dict[str, Any],
    benchmark: str,
    control: str | None,
) -> dict[str, Any]:
    """All that an answer in a mode depends on besides its item."""
    sampling: dict[str, Any] = {"max_new_tokens": new_tokens(mode, student)}
    sampling |= {"thinking": student.thinking, "temperature": student.temperature}
    if student.temperature:
        sampling |= {"top_p": student.top_p, "top_k": student.top_k, "seed": seed}
    return {
        "model": revision,
        "benchmark": benchmark,
        "control": control,
        "prompt": told(mode, regime),
        "frames": student.frames,
        "image_size": student.image_size,
        "schema": schema() if mode == "constrained" else None,
        "sampling": sampling,
    }
