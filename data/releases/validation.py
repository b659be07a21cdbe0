"""What the readers of other simulators' releases share: naming scenes, and refusing a record that
is not as published in one sentence."""

from __future__ import annotations

import io
import re
from collections.abc import Callable, Sequence
from pathlib import Path
from typing import Any

import numpy as np
from PIL import Image

from conf.errors import UserError


class RecordError(UserError):
    """A record of a release that is not as published. Its sentence names the file, what was found
    and what was expected; a caller leaves the record out and counts it, or stops."""


def scene_id(suite: str, *parts: str) -> str:
    """A scene's id, safe as a file name."""
    return "-".join([suite, *(re.sub(r"[^A-Za-z0-9_.-]+", "_", part) for part in parts)])


def check_unique_scenes(
    folder: Path, found: Sequence[Path], id_of: Callable[[Path], str], layout: str
) -> list[Path]:
    """`found` as it is, where it names scenes and none of them twice.

    Raises:
        UserError: there is no such folder, it holds no scene, or one scene twice.
    """
    if not folder.is_dir():
        raise UserError(f"there is no folder {folder}: name the folder that holds {layout}")
    if not found:
        raise UserError(f"{folder} holds no scene: expected {layout} in it")
    first: dict[str, Path] = {}
    for path in found:
        other = first.setdefault(id_of(path), path)
        if other is not path:
            raise UserError(
                f"{folder} holds scene {id_of(path)} twice, as {other} and as {path}: name a "
                "folder that holds each scene once"
            )
    return list(found)


def get_field(record: Any, key: str, kind: type, where: str) -> Any:
    """`record[key]`, which must be of `kind`; `where` says whose key it is.

    Raises:
        RecordError: it is not there, or something else.
    """
    if not isinstance(record, dict) or key not in record:
        raise RecordError(f"{where} lacks the key {key!r} that the release has")
    if not isinstance(record[key], kind):
        raise RecordError(
            f"{where} has a {type(record[key]).__name__} under {key!r}, expected a {kind.__name__}"
        )
    return record[key]


def finite_array(values: Any, shape: tuple[int | None, ...], where: str) -> np.ndarray:
    """`values` as float32 of `shape`, where None stands for any length.

    Raises:
        RecordError: they are of another shape, or not all finite numbers.
    """
    try:
        array = np.asarray(values, np.float64)
    except (TypeError, ValueError) as error:
        raise RecordError(f"{where} are not numbers of shape {_spelled(shape)}") from error
    if array.shape == (0,) and shape[0] in (None, 0):
        array = array.reshape(0, *(n or 0 for n in shape[1:]))
    agrees = len(array.shape) == len(shape) and all(
        wanted in (None, found) for wanted, found in zip(shape, array.shape, strict=True)
    )
    if not agrees:
        raise RecordError(f"{where} have shape {_spelled(array.shape)}, expected {_spelled(shape)}")
    if not np.isfinite(array).all():
        raise RecordError(f"{where} are not all finite numbers")
    return array.astype(np.float32)


def _spelled(shape: Sequence[int | None]) -> str:
    return f"({', '.join('any' if n is None else str(n) for n in shape)})"


def decode_image(data: bytes, where: str) -> Image.Image:
    """An encoded image as RGB; transparency is dropped, not blended in.

    Raises:
        RecordError: it cannot be decoded.
    """
    try:
        return Image.open(io.BytesIO(data)).convert("RGB")
    except (OSError, SyntaxError, ValueError) as error:
        raise RecordError(f"{where} cannot be decoded as an image: {error}") from error
