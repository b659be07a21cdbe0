"""Checks that a base, its processor, its adapters, its pooling and its widths fit together."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from safetensors import safe_open

from conf.errors import UserError
from conf.schema import RetrieverConfig, StudentConfig

if TYPE_CHECKING:
    from torch import nn
    from transformers import PreTrainedConfig, PreTrainedTokenizerBase, ProcessorMixin

MODULES = "modules.json"
"""In which sentence-transformers lists a model's parts."""
PEFT = "base_model.model."
"""What peft puts before the names of the modules that it adapts."""
UNTRAINED_MODULES = ("Transformer", "Pooling", "Normalize")
"""Kinds of modules that a retriever of one vector here has, of which the first alone is trained."""
DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError)
"""What reading a file of modules raises that is not whole."""
POOLING = "lasttoken"
"""How the library calls what makes a retriever's one vector."""


def check_tower(group: str, model: str, config: PreTrainedConfig) -> None:
    """Raises UserError where a base has no vision tower."""
    if getattr(config, "vision_config", None) is None:
        raise UserError(
            f"{group}.model={model} ({config.model_type}) has no vision tower: give a "
            "vision-language model, such as Qwen3-VL"
        )


def check_family(model: str, config: PreTrainedConfig) -> None:
    """Raises UserError where a base of a retriever is no Qwen3-VL, whose masks, positions and
    features the sharing of prefixes goes by."""
    if config.model_type != "qwen3_vl":
        raise UserError(
            f"retriever.model={model} is a {config.model_type}; retriever.encoder=qwen3_vl reads "
            "and trains Qwen3-VL models alone, such as Qwen3-VL-Embedding: give one of these"
        )


def check_processor(
    group: str,
    model: str,
    config: PreTrainedConfig,
    processor: ProcessorMixin | PreTrainedTokenizerBase,
) -> None:
    """Raises UserError where a base's processor does not go with its weights."""
    if problem := _mismatch(config, processor):
        raise UserError(
            f"{group}.model={model} holds a processor of another model, {type(processor).__name__} "
            f"({problem}): put the processor and tokenizer files there that came with the weights"
        )


def _mismatch(config: PreTrainedConfig, processor: Any) -> str | None:
    """How a processor does not go with a model; None where it does."""
    for name in ("tokenizer", "image_processor", "video_processor"):
        if not hasattr(processor, name):
            return f"it has no {name.replace('_', ' ')}"
    tokens, known = len(processor.tokenizer), config.get_text_config().vocab_size
    if tokens > known:
        return f"its tokenizer has {tokens} tokens, the model {known}"
    for part in (processor.image_processor, processor.video_processor):
        for name, own in (("patch_size", "patch_size"), ("merge_size", "spatial_merge_size")):
            there, here = getattr(part, name, None), getattr(config.vision_config, own, None)
            if there != here:
                what = name.replace("_", " ")
                return f"its {what} is {there}, that of the vision tower {here}"
    for name in ("image_token_id", "video_token_id"):
        there, here = getattr(processor, name, None), getattr(config, name, None)
        if there != here:
            return f"its {name} is {there}, the model's {here}"
    return None


def check_adapters(folder: Path, base: nn.Module, cfg: StudentConfig) -> None:
    """Hold the adapters in a folder to the base, with adapters of its own or without, that they are
    laid over, and to the preset's rank. A whole model has none, nor have FSDP's checkpoints.

    Raises:
        UserError: they are of another base or rank.
        SafetensorError: they cannot be read.
    """
    if not (path := folder / "adapter_model.safetensors").exists():
        return
    modules = {name.removeprefix(PEFT): module for name, module in base.named_modules()}
    with safe_open(path, "pt") as file:
        shapes = {name: file.get_slice(name).get_shape() for name in file.keys()}  # noqa: SIM118
    for name, shape in shapes.items():
        adapted, _, side = name.removeprefix(PEFT).partition(".lora_")
        # A is (rank, inputs), B is (outputs, rank).
        rank, there = shape if side.startswith("A") else reversed(shape)
        if rank != cfg.lora.rank:
            raise UserError(
                f"{folder} holds adapters of rank {rank}, and student.lora.rank is "
                f"{cfg.lora.rank}: give student.lora.rank={rank}, or train in a run of its own "
                "(run=NAME)"
            )
        module = modules.get(adapted)
        here = module and getattr(module, "in_features" if side[0] == "A" else "out_features")
        if here != there:
            found = f"{there} wide there and {here} here" if module else "not in this one"
            raise UserError(
                f"{folder} holds adapters of another base than {cfg.model} ({adapted} is {found}): "
                "give the base that they were trained over with student.model=FOLDER, or train "
                "again"
            )


def model_file(model: str | Path, name: str, revision: str | None = None) -> Path:
    """Where a file of a model is: in its folder, or in the hub's cache, which it is fetched into.

    Raises:
        FileNotFoundError: the model has no such file, as far as can be known here.
    """
    from huggingface_hub import hf_hub_download
    from huggingface_hub.errors import EntryNotFoundError

    if Path(model).is_dir():
        return Path(model) / name
    try:
        return Path(hf_hub_download(str(model), name, revision=revision))
    except EntryNotFoundError as error:
        raise FileNotFoundError(f"{model} has no {name}") from error


def is_retriever(model: str | Path, revision: str | None = None) -> bool:
    """Whether a model, in a folder or of the hub, says what comes after its backbone."""
    try:
        return model_file(model, MODULES, revision).exists()
    except FileNotFoundError:
        return False


def check_modules(saved: str | Path, revision: str | None = None) -> None:
    """Raises UserError where a saved retriever, which is to be a base, has trained modules after
    its backbone: a new retriever would begin without them."""
    try:
        kinds = [m["type"].rpartition(".")[2] for m in _modules(saved, revision)]
    except DAMAGED as error:
        raise _damaged(saved, error) from error
    if lost := [kind for kind in kinds if kind not in UNTRAINED_MODULES]:
        raise UserError(
            f"{saved} has modules after its backbone that a retriever trained over it would lose "
            f"({', '.join(lost)}): give a base, or measure it as the run that trained it "
            "(model=RUN)"
        )


def check_pooling(saved: str | Path, revision: str | None = None) -> None:
    """Raises UserError where a saved retriever, in a folder or of the hub, does not pool the last
    token."""
    try:
        parts = [m["path"] for m in _modules(saved, revision) if m["type"].endswith(".Pooling")]
        files = [model_file(saved, f"{part}/config.json", revision) for part in parts]
        modes = [mode for file in files for mode in _pooling_modes(json.loads(file.read_text()))]
    except DAMAGED as error:
        raise _damaged(saved, error) from error
    if modes != [POOLING]:
        told = f"with {' and '.join(map(str, modes))} pooling" if modes else "without pooling"
        raise UserError(
            f"{saved} was saved {told}, and a retriever here is read at its last token "
            f"({POOLING}): give one that is, such as a run of train.contrastive or a "
            "Qwen3-VL-Embedding"
        )


def _modules(saved: str | Path, revision: str | None) -> list[dict[str, Any]]:
    return json.loads(model_file(saved, MODULES, revision).read_text())


def _damaged(saved: str | Path, error: Exception) -> UserError:
    return UserError(
        f"{saved} is damaged: what it says of its modules cannot be read ({error}); delete what "
        "wrote it and train or fetch it again"
    )


def _pooling_modes(config: dict[str, Any]) -> list[str]:
    if (mode := config.get("pooling_mode")) is not None:
        return [mode] if isinstance(mode, str) else list(mode)
    # As sentence-transformers wrote them before its sixth version.
    flags = {key.removeprefix("pooling_mode_"): on for key, on in config.items() if "_mode_" in key}
    return [mode for mode, on in flags.items() if on]


def check_widths(cfg: RetrieverConfig, entries: int) -> None:
    """Raises UserError where a retriever has a width that embeddings of so many entries lack."""
    if cfg.widths[0] > entries:
        fitting = ",".join(str(w) for w in cfg.widths if w <= entries) or entries
        raise UserError(
            f"retriever.widths asks for {cfg.widths[0]}, and the embeddings of {cfg.name} "
            f"have {entries} entries: give retriever.widths=[{fitting}]"
        )
