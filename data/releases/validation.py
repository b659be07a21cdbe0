"""Checks that the readers of other simulators' releases share.

A record that does not have the published layout raises `RecordError`.
"""

from __future__ import annotations

import io
import json
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from conf.errors import UserError


class RecordError(UserError):
    """A record that does not have the published layout, or cannot be read.

    The message states the file, what it contains and what was expected. A caller either skips and
    counts the record, or stops.
    """

    def __init__(self, message: str, code: str = "invalid-record") -> None:
        super().__init__(message, code)


def scene_id(suite: str, *parts: str) -> str:
    """Return a scene's id, in which characters that are unsafe in file names are replaced."""
    return "-".join([suite, *(re.sub(r"[^A-Za-z0-9_.-]+", "_", part) for part in parts)])


def check_unique_scenes(
    folder: Path, paths: Sequence[Path], id_of: Callable[[Path], str], layout: str
) -> list[Path]:
    """Return `paths`, one path per scene, after checking that there is one and no scene repeats.

    Args:
        folder: The folder of the release.
        paths: The paths of its scenes.
        id_of: Returns the scene id of a path.
        layout: The expected content of the folder, in words for error messages.

    Raises:
        UserError: The folder does not exist, contains no scene, or contains a scene twice.
    """
    if not folder.is_dir():
        raise UserError(
            f"folder {folder} does not exist: give the folder that contains {layout}",
            code="missing-folder",
        )
    if not paths:
        raise UserError(f"{folder} contains no scene: expected {layout}", code="empty-release")
    first: dict[str, Path] = {}
    for path in paths:
        other = first.setdefault(id_of(path), path)
        if other is not path:
            raise UserError(
                f"{folder} contains scene {id_of(path)} twice, as {other} and as {path}: give a "
                "folder that contains each scene once",
                code="duplicate-scene",
            )
    return list(paths)


def load_json(path: str | Path) -> dict[str, Any]:
    """Return the JSON object that a file contains.

    Raises:
        RecordError: The file is missing or damaged, or contains another JSON value.
    """
    try:
        record = json.loads(Path(path).read_bytes())
    except FileNotFoundError as error:
        raise RecordError(f"{path} is missing", "missing-file") from error
    except ValueError as error:
        raise RecordError(f"{path} is cut off or not JSON: {error}", "damaged-file") from error
    if not isinstance(record, dict):
        raise RecordError(f"{path} contains a {type(record).__name__}, expected an object")
    return record


def get_field(record: Any, key: str, kind: type, where: str) -> Any:
    """Return `record[key]`, which must be of type `kind`; `where` names the record in errors.

    Raises:
        RecordError: The key is missing or its value has another type.
    """
    if not isinstance(record, dict) or key not in record:
        raise RecordError(f"{where} has no key {key!r}, which the published layout requires")
    if not isinstance(record[key], kind):
        raise RecordError(
            f"{where} has a {type(record[key]).__name__} at {key!r}, expected a {kind.__name__}"
        )
    return record[key]


def check_choice(value: str, choices: Sequence[str], where: str) -> str:
    """Return `value`, which must be one of `choices`.

    Raises:
        RecordError: `value` is not in `choices`.
    """
    if value not in choices:
        raise RecordError(f"{where} is {value!r}, expected {', '.join(choices)}")
    return value


def finite_array(values: Any, shape: tuple[int | None, ...], where: str) -> np.ndarray:
    """Return `values` as a float32 array of `shape`, where None stands for any length.

    Raises:
        RecordError: The values have another shape or are not all finite numbers.
    """
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise RecordError(f"{where}: expected numbers of shape {_format(shape)}") from error
    if array.shape == (0,) and shape[0] in (None, 0):
        array = array.reshape(0, *(n or 0 for n in shape[1:]))
    if array.ndim != len(shape) or any(
        n not in (None, size) for n, size in zip(shape, array.shape, strict=True)
    ):
        raise RecordError(f"{where}: shape {_format(array.shape)}, expected {_format(shape)}")
    if not np.isfinite(array).all():
        raise RecordError(f"{where}: non-finite values (NaN or Inf)")
    return array.astype(np.float32)


def _format(shape: Sequence[int | None]) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"


def decode_image(data: bytes, where: str) -> Image.Image:
    """Decode an image to RGB. An alpha channel is discarded, not blended.

    Raises:
        RecordError: The image cannot be decoded.
    """
    try:
        return Image.open(io.BytesIO(data)).convert("RGB")
    except (OSError, SyntaxError, ValueError) as error:
        raise RecordError(
            f"{where} cannot be decoded as an image: {error}", "damaged-file"
        ) from error
