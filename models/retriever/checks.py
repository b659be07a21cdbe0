"""Checks of a retriever's base, and of the modules that follow it in a saved one."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any

from conf.errors import UserError
from conf.schema import RetrieverConfig

if TYPE_CHECKING:
    from transformers import PreTrainedConfig

SINGLE_VECTOR_MODULES = ("Transformer", "Pooling", "Normalize")
"""Modules of a retriever with one vector, of which only the first is trained."""
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


def check_modules(saved: str, revision: str | None) -> None:
    """Raise UserError if a retriever that is to be a base has trained modules after its backbone: a
    new retriever would start without them."""
    kinds = [module["type"].rpartition(".")[2] for module in _list_modules(saved, revision)]
    if lost := [kind for kind in kinds if kind not in SINGLE_VECTOR_MODULES]:
        raise UserError(
            f"{saved} has modules after its backbone that a retriever trained over it would lose "
            f"({', '.join(lost)}): give a base, or measure it as the run that trained it "
            "(model=RUN)",
            code="unsupported-model",
        )


def check_pooling(saved: str | Path, revision: str | None = None) -> None:
    """Raise UserError if a saved retriever does not pool the last token."""
    from sentence_transformers.sentence_transformer.modules import Pooling

    modules = [m["path"] for m in _list_modules(saved, revision) if m["type"].endswith(".Pooling")]
    with _explain_damage(saved):
        configs = [Pooling.load_config(str(saved), path, revision=revision) for path in modules]
    modes = [str(config.get("pooling_mode")) for config in configs]
    if modes != [POOLING]:
        actual = f"with {' and '.join(modes)} pooling" if modes else "without pooling"
        raise UserError(
            f"{saved} was saved {actual}, but embeddings are taken from the last token "
            f"({POOLING}): give a run of train.contrastive or a Qwen3-VL-Embedding",
            code="unsupported-model",
        )


def _list_modules(saved: str | Path, revision: str | None) -> list[dict[str, Any]]:
    """Return what sentence-transformers recorded of a saved model's modules."""
    from sentence_transformers.util import load_file_path

    with _explain_damage(saved):
        path = load_file_path(str(saved), "modules.json", revision=revision)
        modules = json.loads(Path(path).read_text())
        return [{name: module[name] for name in ("type", "path")} for module in modules]


@contextmanager
def _explain_damage(saved: str | Path) -> Iterator[None]:
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{saved} is damaged: its list of modules cannot be read ({error}); train or download "
            "it again",
            code="damaged-file",
        ) from error


def check_widths(cfg: RetrieverConfig, entries: int) -> None:
    """Raise UserError if a retriever's widest width exceeds the entries of its embeddings."""
    if cfg.widths[0] > entries:
        fitting = ",".join(str(w) for w in cfg.widths if w <= entries) or entries
        raise UserError(
            f"retriever.widths has {cfg.widths[0]}, but the embeddings of {cfg.name} have "
            f"{entries} entries: set retriever.widths=[{fitting}]",
            code="too-wide",
        )
