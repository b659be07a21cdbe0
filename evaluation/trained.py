"""Find what a training run wrote, and the settings it was trained with."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException

from conf.errors import UserError
from data.store import digest

Command = TypeVar("Command")


def settings_of(folder: Path, schema: type[Command], product: str) -> Command:
    """The settings of a finished training run, as its command's dataclass.

    Raises:
        UserError: `folder` is no run folder, holds no finished `product` (student, retriever), or
            settings that this version does not know.
    """
    config = folder / "config.yaml"
    if not config.exists():
        raise UserError(
            f"model={folder} is no run folder of a trained {product}: {config} is missing; give "
            "the folder that the training command named, below checkpoints/"
        )
    if not (folder / product).is_dir():
        raise UserError(
            f"model={folder} is not finished: {folder / product} is missing; run its command again "
            "to go on with it"
        )
    try:
        settings = OmegaConf.merge(OmegaConf.structured(schema), OmegaConf.load(config))
    except OmegaConfBaseException as error:
        raise UserError(
            f"{config} is of another version of DynaPix: {error.full_key} is not known; train again"
        ) from error
    return OmegaConf.to_object(settings)


def weights_digest(model: str | None, trained: Path | None) -> str:
    """A short hash of every safetensors file of a model: of its base, where that is a folder, and
    of what training wrote."""
    whole = hashlib.sha256(str(model).encode())
    for folder in (model, trained):
        for path in sorted(Path(folder).rglob("*.safetensors")) if folder else []:
            whole.update(digest(path).encode())
    return whole.hexdigest()[:16]
