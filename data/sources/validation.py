"""Checks that the readers of other simulators' releases share."""

from __future__ import annotations

import io
import re
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from PIL import Image
from pydantic import BaseModel, ConfigDict, ValidationError

from conf.errors import UserError

FLOOR_TOLERANCE = 0.05
"""Maximum distance from the floor's plane of a contact with the floor, simulator units."""
MIN_VERTICAL = 0.7
"""Minimum vertical component of the unit normal of a contact with the floor."""


class RecordError(UserError):
    """A scene's record in a release that does not have the published layout or cannot be read.

    The message states the file, what it contains and what was expected. A caller either skips and
    counts the record, or stops.
    """

    def __init__(self, message: str, code: str = "invalid-record") -> None:
        super().__init__(message, code)


class Layout(BaseModel):
    """The keys of a JSON or YAML object that a reader uses; other keys are ignored."""

    model_config = ConfigDict(strict=True, allow_inf_nan=False)


AnyLayout = TypeVar("AnyLayout", bound=Layout)


def read_json(path: Path, layout: type[AnyLayout]) -> AnyLayout:
    """Return the content of a JSON file.

    Raises:
        RecordError: The file is missing or damaged, or does not have the layout.
    """
    try:
        return layout.model_validate_json(path.read_bytes())
    except FileNotFoundError as error:
        raise RecordError(f"{path} is missing", "missing-file") from error
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        if first["type"] == "json_invalid":
            raise RecordError(f"{path} is not JSON: {first['msg']}", "damaged-file") from error
        raise _other_layout(path, error) from error


def read_yaml(path: Path, layout: type[AnyLayout]) -> AnyLayout:
    """Return the content of a YAML file. Raises RecordError as `read_json` does."""
    try:
        return layout.model_validate(yaml.safe_load(path.read_bytes()))
    except FileNotFoundError as error:
        raise RecordError(f"{path} is missing", "missing-file") from error
    except yaml.YAMLError as error:
        reason = " ".join(str(error).split())
        raise RecordError(f"{path} is not YAML: {reason}", "damaged-file") from error
    except ValidationError as error:
        raise _other_layout(path, error) from error


def _other_layout(path: Path, error: ValidationError) -> RecordError:
    first = error.errors(include_url=False)[0]
    where = ".".join(map(str, first["loc"])) or "the file"
    return RecordError(f"{path} does not have the published layout: {where}: {first['msg']}")


def scene_id(*parts: str) -> str:
    """Return a scene's id, in which characters that are unsafe in file names are replaced."""
    return "-".join(re.sub(r"[^A-Za-z0-9_.-]+", "_", part) for part in parts)


def check_unique_scenes(
    folder: Path, paths: list[Path], id_of: Callable[[Path], str], contents: str
) -> list[Path]:
    """Check that a release has scenes and none of them twice, and return `paths`, one per scene.

    Args:
        id_of: Function that returns the scene id of a path.
        contents: A description of the expected contents of the folder, for error messages.

    Raises:
        UserError: The folder does not exist, contains no scene, or contains a scene twice.
    """
    if not folder.is_dir():
        raise UserError(
            f"folder {folder} does not exist: choose the folder that contains {contents}",
            code="missing-folder",
        )
    if not paths:
        raise UserError(f"{folder} contains no scene: expected {contents}", code="empty-release")
    first: dict[str, Path] = {}
    for path in paths:
        other = first.setdefault(id_of(path), path)
        if other is not path:
            raise UserError(
                f"{folder} contains scene {id_of(path)} twice, as {other} and as {path}: "
                "choose a folder that contains each scene once",
                code="duplicate-scene",
            )
    return paths


def finite_array(
    values: Any, shape: tuple[int, ...], where: str, dtype: type = np.float32
) -> np.ndarray:
    """Return numbers as an array of `shape`, in which -1 stands for any length.

    Raises:
        RecordError: The values do not fit the shape, or not all of them are finite numbers.
    """
    try:
        array = np.asarray(values, np.float64).reshape(shape)
    except (TypeError, ValueError) as error:
        raise RecordError(f"{where}: expected numbers of shape {shape}: {error}") from error
    if not np.isfinite(array).all():
        raise RecordError(f"{where}: non-finite values (NaN or Inf)")
    return array.astype(dtype)


def decode_image(image: bytes | Path, where: str) -> Image.Image:
    """Decode an image (encoded bytes or a file) to RGB. An alpha channel is ignored, not blended.

    Raises:
        RecordError: The image cannot be decoded.
    """
    try:
        return Image.open(io.BytesIO(image) if isinstance(image, bytes) else image).convert("RGB")
    except (OSError, SyntaxError, ValueError) as error:
        raise RecordError(
            f"{where} cannot be decoded as an image: {error}", "damaged-file"
        ) from error
