"""Checks that a base, its processor and its adapters fit together."""

from __future__ import annotations

from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import safe_open

from conf.errors import UserError

if TYPE_CHECKING:
    from torch import nn
    from transformers import PreTrainedConfig, PreTrainedTokenizerBase, ProcessorMixin

PEFT = "base_model.model."
"""Prefix that peft adds to the names of the modules that it adapts."""
PROCESSOR_FIELDS = {
    "image_processor.patch_size": "vision_config.patch_size",
    "image_processor.merge_size": "vision_config.spatial_merge_size",
    "video_processor.patch_size": "vision_config.patch_size",
    "video_processor.merge_size": "vision_config.spatial_merge_size",
    "image_token_id": "image_token_id",
    "video_token_id": "video_token_id",
}
"""Fields of a processor, and what they equal in the configuration of its model."""


def check_tower(model: str, config: PreTrainedConfig) -> None:
    """Raise UserError if a student's base has no vision tower."""
    if getattr(config, "vision_config", None) is None:
        raise UserError(
            f"student.model={model} ({config.model_type}) has no vision tower: give a "
            "vision-language model, such as Qwen3-VL",
            code="unsupported-model",
        )


def check_processor(
    group: str,
    model: str,
    config: PreTrainedConfig,
    processor: ProcessorMixin | PreTrainedTokenizerBase,
) -> None:
    """Raise UserError if a processor does not belong to its model."""
    if problem := _mismatch(config, processor):
        raise UserError(
            f"{group}.model={model} has the processor of another model, "
            f"{type(processor).__name__} ({problem}): restore the processor and tokenizer files "
            "that belong to the weights",
            code="other-processor",
        )


def _mismatch(config: PreTrainedConfig, processor: Any) -> str | None:
    """Return how a processor differs from what a model needs, or None."""
    try:
        tokens, known = len(processor.tokenizer), config.get_text_config().vocab_size
        if tokens > known:
            return f"its tokenizer has {tokens} tokens, the model {known}"
        for field, own in PROCESSOR_FIELDS.items():
            actual, expected = attrgetter(field)(processor), attrgetter(own)(config)
            if actual != expected:
                return f"its {field} is {actual}, the model's {expected}"
    except AttributeError as error:
        return f"it has no {error.name}"
    return None


def check_adapters(folder: Path, base: nn.Module, rank: int, model: str | None) -> None:
    """Check that the adapters in a folder fit a base, with or without adapters, and a rank. A whole
    model and FSDP's checkpoints have no such file and pass.

    Args:
        rank: student.lora.rank.
        model: student.model.

    Raises:
        UserError: the adapters belong to another base or rank.
        SafetensorError: the file is damaged.
    """
    if not (path := folder / "adapter_model.safetensors").exists():
        return
    modules = {name.removeprefix(PEFT): module for name, module in base.named_modules()}
    with safe_open(path, "pt") as file:
        shapes = {name: file.get_slice(name).get_shape() for name in file.keys()}  # noqa: SIM118
    for name, shape in shapes.items():
        adapted, _, side = name.removeprefix(PEFT).partition(".lora_")
        # A is (rank, inputs), B is (outputs, rank).
        own_rank, width = shape if side.startswith("A") else reversed(shape)
        if own_rank != rank:
            raise UserError(
                f"{folder} has adapters of rank {own_rank}, and student.lora.rank is {rank}: set "
                f"student.lora.rank={own_rank}, or train another run (run=NAME)",
                code="other-rank",
            )
        module = modules.get(adapted)
        actual = module and getattr(module, "in_features" if side[0] == "A" else "out_features")
        if actual != width:
            difference = f"is {width} wide there and {actual} here" if module else "does not exist"
            raise UserError(
                f"{folder} has adapters of another base than {model} ({adapted} {difference}): "
                "give the base that they were trained over with student.model=FOLDER, or train "
                "again",
                code="other-base",
            )
