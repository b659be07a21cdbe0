"""The interface of generators, and the settings that identify their responses."""

from __future__ import annotations

from pathlib import Path
from typing import Any, Protocol

from dynapix.conf.errors import UserError
from dynapix.conf.runs import world_size
from dynapix.conf.schema import SelectCommand, SftCommand, StudentConfig, TwoStageCommand
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import SelectionItem
from dynapix.evaluation.generators.response_log import (
    RECORD_MODES,
    SampleOf,
    SaveResponses,
    Subject,
)
from dynapix.evaluation.generators.response_schema import (
    build_record_schema,
    write_record_instruction,
)
from dynapix.models.resolved_settings import resolve_precision
from dynapix.models.student.prompts import Sample, choose_instruction, selection_sample
from dynapix.models.student.responses import response_token_limit

PROMPT_VERSION = 2
"""Version of the prompt layout. Increment it when the layout changes, so that earlier responses are
not reused."""


class Generator(Protocol):
    """A model that responds to prompts about selection items, queries or frames.

    Attributes:
        name: Name of the model in tables.
        identity: Values that identify the weights and the processor. A stored response is reused
            only for a model with an equal identity.
    """

    name: str
    identity: dict[str, Any]

    def respond(
        self, mode: str, sample_of: SampleOf, subjects: list[Subject], save: SaveResponses
    ) -> None:
        """Generate a response to the prompt `sample_of(subject)` of each subject, and pass finished
        responses to `save`.

        Raises:
            UserError: Memory runs out, a prompt is too long, or the servers do not respond to it.
        """


def open_generator(
    cfg: SelectCommand | TwoStageCommand,
    folder: Path | None,
    trained: SftCommand | SelectCommand | TwoStageCommand,
) -> Generator:
    """Return the model that `cfg` selects, on servers if `server.url` is set and local otherwise.

    Args:
        folder: The run or export of a trained student; None for a base.
        trained: The settings of the student's run; for a base, `cfg`.

    Raises:
        UserError: The weights of the student's local base have changed since the training; several
            ranks of a launcher would use a server; no server responds; `server.model` is missing,
            unknown to the servers or an adapter without its run; or the servers serve different
            models under this name.
    """
    if cfg.server.url is not None:
        if world_size() > 1:
            raise UserError(
                "server.url with several ranks: one process sends all requests, so run the command "
                "with python, not with torchrun or another launcher",
                code="unsupported-ranks",
            )
        from dynapix.evaluation.generators.openai_server import ServedModel

        return ServedModel(cfg, folder, trained.student)
    from dynapix.evaluation.generators.local import LocalModel

    return LocalModel(cfg, folder, trained.student, resolve_precision(trained.train.precision))


def item_instruction(mode: str, regime: str) -> str:
    """Return the instruction that ends a prompt in `mode`. The training regime determines which
    sections of a rationale the instruction requests."""
    return write_record_instruction() if mode in RECORD_MODES else choose_instruction(mode, regime)


def item_sample(
    regime: str,
    frames: FrameReader,
    student: StudentConfig,
    control: str | None,
    mode: str,
    item: SelectionItem,
) -> Sample:
    """Return the prompt for `item` in `mode`, with the instruction of the training regime."""
    text = item_instruction(mode, regime)
    return selection_sample(item, mode, regime, frames, student.frames, control=control, text=text)


def response_settings(
    mode: str,
    regime: str,
    student: StudentConfig,
    seed: int,
    model: dict[str, Any],
    benchmark: str,
    control: str | None,
) -> dict[str, Any]:
    """Return all settings that determine a response in `mode`, apart from the subject itself.
    `model` and `benchmark` are the identities of the generator and of the store."""
    sampling: dict[str, Any] = {
        "max_new_tokens": response_token_limit(mode, student.max_new_tokens, student.thinking),
        "thinking": student.thinking,
        "temperature": student.temperature,
    }
    if student.temperature:
        sampling |= {"top_p": student.top_p, "top_k": student.top_k, "seed": seed}
    return {
        "model": model,
        "benchmark": benchmark,
        "control": control,
        "prompt": item_instruction(mode, regime),
        "inputs": PROMPT_VERSION,
        "frames": student.frames,
        "image_size": student.image_size,
        "schema": build_record_schema() if mode == "constrained" else None,
        "sampling": sampling,
    }
