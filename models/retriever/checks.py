"""Checks of a retriever's base, and of the modules that follow it in a saved one."""

from __future__ import annotations

import json
from pathlib import Path
from typing import TYPE_CHECKING, Any

from conf.errors import UserError
from conf.schema import RetrieverConfig

if TYPE_CHECKING:
    from transformers import PreTrainedConfig

MODULES = "modules.json"
"""File in which sentence-transformers lists a model's modules."""
KNOWN_MODULES = ("Transformer", "Pooling", "Normalize")
"""Modules of a retriever with one vector, of which only the first is trained."""
DAMAGED = (OSError, ValueError, KeyError, TypeError, AttributeError)
"""Errors of reading a damaged list of modules."""
POOLING = "lasttoken"
"""The library's name for the pooling of a retriever with one vector."""


def check_family(model: str, config: PreTrainedConfig) -> None:
    """Raise UserError if a retriever's base is not a Qwen3-VL, whose masks, positions and features
    the trainer relies on."""
    if config.model_type != "qwen3_vl":
        raise UserError(
            f"retriever.model={model} is a {config.model_type}; retriever.encoder=qwen3_vl loads "
            "and trains Qwen3-VL models only, such as Qwen3-VL-Embedding",
            code="unsupported-model",
        )


def model_file(model: str | Path, name: str, revision: str | None = None) -> Path:
    """Return the path of a model's file, in its folder or in the hub's cache after a download.

    Raises:
        FileNotFoundError: the model is known to have no such file.
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
    """Whether a folder or a hub model lists modules of sentence-transformers."""
    try:
        return model_file(model, MODULES, revision).exists()
    except FileNotFoundError:
        return False


def check_modules(saved: str | Path, revision: str | None = None) -> None:
    """Raise UserError if a retriever that is to be a base has trained modules after its backbone: a
    new retriever would start without them."""
    try:
        kinds = [m["type"].rpartition(".")[2] for m in _modules(saved, revision)]
    except DAMAGED as error:
        raise _damaged(saved, error) from error
    if lost := [kind for kind in kinds if kind not in KNOWN_MODULES]:
        raise UserError(
            f"{saved} has modules after its backbone that a retriever trained over it would lose "
            f"({', '.join(lost)}): give a base, or measure it as the run that trained it "
            "(model=RUN)",
            code="unsupported-model",
        )


def check_pooling(saved: str | Path, revision: str | None = None) -> None:
    """Raise UserError if a saved retriever does not pool the last token."""
    try:
        parts = [m["path"] for m in _modules(saved, revision) if m["type"].endswith(".Pooling")]
        files = [model_file(saved, f"{part}/config.json", revision) for part in parts]
        modes = [mode for file in files for mode in _pooling_modes(json.loads(file.read_text()))]
    except DAMAGED as error:
        raise _damaged(saved, error) from error
    if modes != [POOLING]:
        actual = f"with {' and '.join(map(str, modes))} pooling" if modes else "without pooling"
        raise UserError(
            f"{saved} was saved {actual}, but embeddings are taken from the last token "
            f"({POOLING}): give a run of train.contrastive or a Qwen3-VL-Embedding",
            code="unsupported-model",
        )


def _modules(saved: str | Path, revision: str | None) -> list[dict[str, Any]]:
    return json.loads(model_file(saved, MODULES, revision).read_text())


def _damaged(saved: str | Path, error: Exception) -> UserError:
    return UserError(
        f"{saved} is damaged: its list of modules cannot be read ({error}); train or download it "
        "again",
        code="damaged-file",
    )


def _pooling_modes(config: dict[str, Any]) -> list[str]:
    if (mode := config.get("pooling_mode")) is not None:
        return [mode] if isinstance(mode, str) else list(mode)
    # Models that were released with sentence-transformers 5 have one flag per mode.
    flags = {key.removeprefix("pooling_mode_"): on for key, on in config.items() if "_mode_" in key}
    return [mode for mode, on in flags.items() if on]


def check_widths(cfg: RetrieverConfig, entries: int) -> None:
    """Raise UserError if a retriever's widest width exceeds the entries of its embeddings."""
    if cfg.widths[0] > entries:
        fitting = ",".join(str(w) for w in cfg.widths if w <= entries) or entries
        raise UserError(
            f"retriever.widths has {cfg.widths[0]}, but the embeddings of {cfg.name} have "
            f"{entries} entries: set retriever.widths=[{fitting}]",
            code="too-wide",
        )
