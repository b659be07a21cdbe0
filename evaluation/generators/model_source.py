"""How a model is asked: here or at servers, in which modes, and what tells its answers apart."""

from __future__ import annotations

import asyncio
import logging
from collections.abc import Callable
from dataclasses import asdict, dataclass, replace
from functools import cache, partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from conf.errors import UserError
from conf.schema import SelectCommand, SftCommand, StudentConfig, TwoStageCommand
from data.records import SelectionItem
from data.render.frame_cache import FrameReader
from evaluation.generators import local, openai_server
from evaluation.generators.response_log import RECORD_MODES, Respond, SaveResponses, Subject
from evaluation.generators.response_schema import instruction as record_instruction
from evaluation.generators.response_schema import schema
from models import compat, fingerprints, loading
from models.precision import resolve_precision
from models.resolved import check_base
from models.student.generation import response_token_limit
from models.student.prompts import Sample, instructed_sample, instruction
from models.trained_runs import product_folder, run_title

if TYPE_CHECKING:
    from torch import nn
    from transformers import ProcessorMixin

log = logging.getLogger(__name__)

INPUTS = 1
"""Rises with how an item is put to a model, so that no earlier answer is taken for one."""

SampleOf = Callable[[str, Subject], Sample]
"""Shows and asks a thing in a mode."""


@dataclass(frozen=True)
class Generator:
    """A model that can be asked: its name for a table, what its answers are known by, and
    `say(mode, sample_of)`, by which it answers things as `sample_of` shows and asks them."""

    name: str
    revision: dict[str, Any]
    say: Callable[[str, SampleOf], Respond]


def open_generator(
    cfg: SelectCommand | TwoStageCommand,
    folder: Path | None,
    trained: SftCommand | SelectCommand | TwoStageCommand,
) -> Generator:
    """The model that `cfg` names: at servers where it names some, else on this machine. `trained`
    are the settings of the run in `folder`, or the command's own.

    Raises:
        UserError: what `model_served` and `model_here` raise.
    """
    if cfg.server.url is not None:
        return model_served(cfg, folder, trained.student)
    return model_here(cfg, folder, trained.student, resolve_precision(trained.train.precision))


def model_here(
    cfg: SelectCommand | TwoStageCommand,
    folder: Path | None,
    student: StudentConfig,
    precision: str,
) -> Generator:
    """A model that is loaded on this machine, when it is first asked: the student in a run's or an
    export's `folder`, or the base.

    Raises:
        UserError: it cannot be loaded, or its base is not the one that it was trained over.
    """
    weights = None
    if folder is None:
        student = fingerprints.pin_revisions(student)
    else:
        check_base(folder, student)
        weights = product_folder(folder, "student")

    @cache
    def loaded() -> tuple[nn.Module, ProcessorMixin]:
        compat.keep_freed_memory()
        if weights is None:
            model, processor = loading.load_base(student, precision, list)
            return loading.for_inference(model), processor
        return loading.load_trained(student, precision, weights)

    def say(mode: str, sample_of: SampleOf) -> Respond:
        def answer(things: list[Subject], keep: SaveResponses) -> None:
            shown = partial(sample_of, mode)
            local.say(*loaded(), student, precision, cfg.batch, cfg.seed, mode, shown, things, keep)

        return answer

    revision = {
        "weights": fingerprints.weights_digest(fingerprints.model_id(student), weights),
        "processor": fingerprints.processor_digest(weights or fingerprints.model_id(student)),
        "revision": student.revision,
        "quantization": student.quantization,
        "precision": precision,
    }
    if student.architecture is not None and folder is None:
        revision["architecture"] = asdict(student.architecture)
    return Generator(_title(folder, student), revision, say)


def model_served(
    cfg: SelectCommand | TwoStageCommand, folder: Path | None, student: StudentConfig
) -> Generator:
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
    told = openai_server.revision(server)
    if folder is None and told["parent"]:
        raise UserError(
            f"server.model={server.model} is an adapter over {told['parent']} there: give "
            "model=RUN, the run that trained it, so that it is asked what it was trained to answer"
        )
    if folder is not None and told["parent"] and student.quantization == "nf4":
        log.warning(
            "%s has the adapters of %s over a base that is not rounded to NF4, over which they "
            "were trained: it answers somewhat otherwise than the student, or than its merged "
            "export (python -m train.export)",
            server.model,
            folder,
        )
    weights = product_folder(folder, "student") if folder else None
    seen = told["parent"] or told["root"]
    if seen is None or not Path(seen).is_dir():
        log.info(
            "of %s the server tells its name alone (%s): once that stands for other weights, give "
            "their commit as student.revision=COMMIT, or the answers so far are taken for theirs",
            server.model,
            seen,
        )
    told["revision"] = student.revision
    told["weights"] = fingerprints.weights_digest(told["root"], told["parent"], weights)
    told["processor"] = fingerprints.processor_digest(seen)

    def say(mode: str, sample_of: SampleOf) -> Respond:
        def answer(things: list[Subject], keep: SaveResponses) -> None:
            shown = partial(sample_of, mode)
            asyncio.run(openai_server.say(server, student, cfg.seed, mode, shown, things, keep))

        return answer

    return Generator(_title(folder, student), {"served": server.model, **told}, say)


def _title(folder: Path | None, student: StudentConfig) -> str:
    return run_title(folder) if folder else f"{student.name} base"


def told(mode: str, regime: str) -> str:
    """What a model is told to write in a mode; `regime` is how a student was trained."""
    return record_instruction() if mode in RECORD_MODES else instruction(mode, regime)


def shown(
    regime: str,
    frames: FrameReader,
    cfg: StudentConfig,
    control: str | None,
    mode: str,
    item: SelectionItem,
) -> Sample:
    """A selection item as a student of a regime is asked about it in a mode."""
    return instructed_sample(item, mode, told(mode, regime), frames, cfg.frames, control=control)


def response_settings(
    mode: str,
    regime: str,
    student: StudentConfig,
    seed: int,
    revision: dict[str, Any],
    benchmark: str,
    control: str | None,
) -> dict[str, Any]:
    """All that an answer in a mode depends on besides its item."""
    sampling: dict[str, Any] = {
        "max_new_tokens": response_token_limit(mode, student.max_new_tokens, student.thinking)
    }
    sampling |= {"thinking": student.thinking, "temperature": student.temperature}
    if student.temperature:
        sampling |= {"top_p": student.top_p, "top_k": student.top_k, "seed": seed}
    return {
        "model": revision,
        "benchmark": benchmark,
        "control": control,
        "prompt": told(mode, regime),
        "inputs": INPUTS,
        "frames": student.frames,
        "image_size": student.image_size,
        "schema": schema() if mode == "constrained" else None,
        "sampling": sampling,
    }
