"""Find what a training run wrote, and the settings it was trained with."""

from __future__ import annotations

from pathlib import Path
from typing import TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from conf.errors import UserError

Command = TypeVar("Command")


def run_title(folder: Path) -> str:
    """A run's name for a table; a sweep's job goes by the sweep and its number."""
    return f"{folder.parent.name}/{folder.name}" if folder.name.isdigit() else folder.name


def settings_of(folder: Path, schema: type[Command], product: str) -> Command:
    """The settings of a finished training run, as its command's dataclass.

    Raises:
        UserError: `folder` is no run folder, holds no finished `product` (student, retriever), or
            settings that cannot be read.
    """
    config = folder / "config.yaml"
    try:
        there = OmegaConf.load(config)
        if not OmegaConf.is_dict(there) or product not in there:
            raise UserError(f"model={folder} trained no {product}: it is another command's")
        if not (folder / "metrics.json").exists() or not (folder / product).is_dir():
            raise UserError(
                f"model={folder} is not finished: run its command again to go on with it"
            )
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), there))
    except FileNotFoundError as error:
        raise UserError(
            f"model={folder} is no run folder of a trained {product}: {config} is missing; give "
            "the folder that the training command named, below checkpoints/"
        ) from error
    except (YAMLError, OmegaConfBaseException) as error:
        first = str(error).partition("\n")[0]
        raise UserError(
            f"{config} is damaged or of another version of DynaPix ({first}); train again"
        ) from error
