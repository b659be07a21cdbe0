"""Checks that a base can be loaded, and that its processor belongs to it."""

from __future__ import annotations

import json
from collections.abc import Collection
from operator import attrgetter
from pathlib import Path
from typing import TYPE_CHECKING, Any

from huggingface_hub import constants

from dynapix.conf.errors import UserError
from dynapix.conf.proxies import proxy_hint
from dynapix.conf.schema import RetrieverConfig
from dynapix.models.fingerprints import find_commit

if TYPE_CHECKING:
    from transformers import PreTrainedConfig, PreTrainedTokenizerBase, ProcessorMixin

ADAPTER_WEIGHTS = "adapter_model.safetensors"
"""File of saved adapters."""
ADAPTER_CONFIG = "adapter_config.json"
"""File of their settings."""
PEFT_PREFIX = "base_model.model."
"""Prefix that peft adds to the names of the modules that it adapts."""
QWEN_FIELDS = {
    "image_processor.patch_size": "vision_config.patch_size",
    "image_processor.merge_size": "vision_config.spatial_merge_size",
    "video_processor.patch_size": "vision_config.patch_size",
    "video_processor.merge_size": "vision_config.spatial_merge_size",
    "image_token_id": "image_token_id",
    "video_token_id": "video_token_id",
}
"""Fields of a processor of Qwen, and those of the model's configuration that they must equal."""
SINGLE_VECTOR_MODULES = ("Transformer", "Pooling", "Normalize")
"""Types of the modules of a single-vector retriever, of which only the first has weights."""


def check_family(model: str, config: PreTrainedConfig) -> None:
    """Raise UserError if a student's base is not a vision-language model of transformers."""
    from transformers import MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING

    # A model with code of its own registers it in its configuration.
    own = "AutoModelForImageTextToText" in getattr(config, "auto_map", {})
    if not own and type(config) not in MODEL_FOR_IMAGE_TEXT_TO_TEXT_MAPPING:
        raise UserError(
            f"student.model={model} ({config.model_type}) is no vision-language model that "
            "transformers loads with AutoModelForImageTextToText: give another model, or measure "
            "it with dynapix.evaluate (docs/evaluation.md)",
            code="unsupported-model",
        )


def check_complete(model: str, missing: Collection[str]) -> None:
    """Raise UserError if weights of a student's base are missing from its files. transformers would
    give them random values."""
    if missing:
        raise UserError(
            f"student.model={model} lacks the weights of {len(missing)} parameters, such as "
            f"{min(missing)}: restore config.json and the *.safetensors files that belong together",
            code="missing-weights",
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
    if group == "student" and not processor.chat_template:
        raise UserError(
            f"student.model={model} has no chat template: restore chat_template.jinja, or give a "
            "model that is trained to follow instructions",
            code="no-chat-template",
        )


def _mismatch(config: PreTrainedConfig, processor: Any) -> str | None:
    """Return how a processor differs from what the model needs, or None if it fits."""
    try:
        tokens, embedded = len(processor.tokenizer), config.get_text_config().vocab_size
        if tokens > embedded:
            return f"its tokenizer has {tokens} tokens, the model {embedded}"
        fields = QWEN_FIELDS if config.model_type.startswith("qwen") else {}
        for field, config_field in fields.items():
            actual, expected = attrgetter(field)(processor), attrgetter(config_field)(config)
            if actual != expected:
                return f"its {field} is {actual}, the model's {expected}"
        _ = processor.image_processor, processor.image_token
    except AttributeError as error:
        return f"it has no {error.name}"
    return None


def check_text_tower(model: str, config: PreTrainedConfig, tokenizer: Any) -> None:
    """Raise UserError if a tokenizer does not fit the vocabulary of a retriever's text tower.

    The library builds an almost empty tokenizer if the files are missing. A vocabulary that is
    larger than the tokenizer is accepted up to a factor of 2, since models pad it.
    """
    tokens, vocabulary = len(tokenizer), config.text_config.vocab_size
    if not vocabulary / 2 < tokens <= vocabulary:
        raise UserError(
            f"retriever.model={model} has a tokenizer of {tokens} tokens for a vocabulary of "
            f"{vocabulary}: add the tokenizer's files that were released with the weights",
            code="incomplete-model",
        )


def check_late_base(source: str, config: PreTrainedConfig, revision: str | None) -> None:
    """Raise UserError if a model cannot be the base of a multi-vector retriever: it is no Qwen3-VL,
    by whose tokens the scored tokens are found, or it is a saved retriever with modules after its
    backbone whose weights would be lost."""
    from sentence_transformers.util import load_file_path

    if config.model_type != "qwen3_vl":
        raise UserError(
            f"retriever.model={source} is a {config.model_type}, but late interaction finds the "
            "tokens to score in Qwen3-VL only: set retriever.late=null, or give a Qwen3-VL",
            code="unsupported-model",
        )
    path = load_file_path(source, "modules.json", revision=revision)
    modules = json.loads(Path(path).read_text()) if path else []
    kinds = [module["type"].rpartition(".")[2] for module in modules]
    if lost := [kind for kind in kinds if kind not in SINGLE_VECTOR_MODULES]:
        raise UserError(
            f"{source} has modules after its backbone that would be lost if it were used as a base "
            f"({', '.join(lost)}): give another base, or evaluate the run that trained it "
            "(model=RUN)",
            code="unsupported-model",
        )


def check_widths(cfg: RetrieverConfig, entries: int) -> None:
    """Raise UserError if a retriever's widest width exceeds its embeddings' number of entries."""
    if cfg.widths[0] > entries:
        fitting = ",".join(str(w) for w in cfg.widths if w <= entries) or entries
        raise UserError(
            f"retriever.widths has the width {cfg.widths[0]}, but the embeddings of {cfg.name} "
            f"have {entries} entries: set retriever.widths=[{fitting}]",
            code="too-wide",
        )


def check_available(group: str, model: str, key: str = "model") -> None:
    """Raise UserError if a base is neither a local folder nor in the hub's cache and cannot be
    downloaded. The message names the setting GROUP.KEY."""
    try:
        if not Path(model).is_dir():
            find_commit(model)
    except Exception as error:
        # The hub's client raises the errors of whichever HTTP library is installed.
        name = f"{group}.{key}"
        if Path(model).is_absolute() or model.startswith("."):
            message = f"{name}={model}: this folder does not exist"
        else:
            hint = "" if constants.HF_HUB_OFFLINE else proxy_hint(constants.ENDPOINT)
            message = (
                f"{name}={model} is neither a local folder nor in the hub's cache, and cannot be "
                f"downloaded ({first_line(error)}{hint}). Give a local copy with {name}=FOLDER "
                "(config.json, *.safetensors, tokenizer and processor files), or download it on a "
                f"machine with network access: hf download {model}"
            )
        raise UserError(message, code="missing-model") from error


def first_line(error: Exception) -> str:
    """Return the first line of an error's message, or the name of its class."""
    return next(iter(str(error).strip().splitlines()), type(error).__name__)
