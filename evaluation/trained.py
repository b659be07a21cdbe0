"""Find what a training run wrote, and the settings it was trained with."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from omegaconf import OmegaConf

from conf.errors import UserError

Command = TypeVar("Command")


def settings_of(folder: Path, schema: type[Command], product: str) -> Command:
    """The settings of a finished training run, as its command's dataclass.

    Raises:
        UserError: `folder` is no run folder, or holds no finished `product` (student, retriever).
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
    settings = OmegaConf.merge(OmegaConf.structured(schema), OmegaConf.load(config))
    return OmegaConf.to_object(settings)
