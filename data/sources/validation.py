"""What the readers of other simulators' releases share: checks, and the grouping of contacts."""

from __future__ import annotations

import codecs
import io
import re
import warnings
from collections import defaultdict
from collections.abc import Callable, Iterable, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
import yaml
from PIL import Image
from pydantic import BaseModel, ValidationError, conlist
from pydantic_core import from_json

from dynapix.conf.errors import UserError
from dynapix.data.oracle.events import group_contacts
from dynapix.data.records import ALTERNATIVE, COUNTERFACTUAL, Collision, Landing, Scene

FLOOR_TOLERANCE = 0.05
"""Maximum distance from the floor's plane of a contact with the floor, simulator units."""
MIN_VERTICAL = 0.7
"""Minimum vertical component of the unit normal of a contact with the floor."""
MIN_SPEED = 0.1
"""Speed (simulator units per second) from which velocities are compared with displacements."""
MIN_FRAMES = 10
"""Minimum number of frames in which an object's velocities are compared."""
CONTACT_MARGIN = 2
"""Number of frames around the start and the end of a contact in which they are not compared."""
MAX_TURN = 0.2
"""Highest speed of an object's surface by its rotation, as a share of the object's own speed, in
frames that are compared: what is recorded as position may be off the centre of mass."""
AGREEMENT, MAX_DEVIATION = 0.1, 0.25
"""Relative difference up to which velocities agree with displacements, and the median deviation of
an object's velocities up to which a factor explains the difference."""


class RecordError(UserError):
    """A scene's record in a release that does not have the published layout or cannot be read. The
    message states the file, what it contains and what was expected."""

    def __init__(self, message: str, code: str = "invalid-record") -> None:
        super().__init__(message, code)


class RescaledVelocities(UserWarning):
    """A scene's velocities were multiplied by `factor`, so that they agree with its positions."""

    def __init__(self, path: Path, factor: float, fps: float) -> None:
        super().__init__(
            f"{path}: velocities were multiplied by {factor:.3g}, so that they agree with the "
            f"positions at {fps:g} frames per second"
        )
        self.factor = factor


class Layout(BaseModel, strict=True, allow_inf_nan=False):
    """The keys of a JSON or YAML object that a reader uses; other keys are ignored."""


AnyLayout = TypeVar("AnyLayout", bound=Layout)
Vector = conlist(float, min_length=3, max_length=3)


def read_layout(path: Path, layout: type[AnyLayout]) -> AnyLayout:
    """Return the content of a JSON or YAML file. Raises RecordError if it is missing or damaged, or
    does not have the layout."""
    kind = "YAML" if path.suffix == ".yaml" else "JSON"
    try:
        content = (yaml.safe_load if kind == "YAML" else from_json)(
            path.read_bytes().removeprefix(codecs.BOM_UTF8)
        )
    except FileNotFoundError as error:
        raise RecordError(f"{path} is missing", "missing-file") from error
    except (ValueError, yaml.YAMLError) as error:
        reason = " ".join(str(error).split())
        raise RecordError(f"{path} is not {kind}: {reason}", "damaged-file") from error
    return check_layout(str(path), content, layout)


def check_layout(where: str, content: Any, layout: type[AnyLayout]) -> AnyLayout:
    """Return content as a layout. Raises RecordError if it does not have it."""
    try:
        return layout.model_validate(content)
    except ValidationError as error:
        first = error.errors(include_url=False)[0]
        place = ".".join(map(str, first["loc"])) or "the file"
        found = f" is {first['input']!r}" if isinstance(first["input"], str | int | float) else ""
        raise RecordError(
            f"{where} does not have the published layout: {place}{found}: {first['msg']}"
        ) from error


def scene_id(*parts: str) -> str:
    """Return a scene's id. Characters that are unsafe in file names are replaced, and those that
    would make it the id of another scene's counterfactual or alternative future."""
    name = "-".join(re.sub(r"[^A-Za-z0-9_.-]+", "_", part) for part in parts)
    for mark in (COUNTERFACTUAL, ALTERNATIVE):
        name = name.replace(mark, mark.replace("-", "_"))
    return name


def check_unique_scenes(
    folder: Path, paths: list[Path], id_of: Callable[[Path], str], contents: str
) -> list[Path]:
    """Return `paths`, one per scene, of a release. Raises UserError if there are none, or if
    `id_of`, which returns the scene id of a path, is equal for two. `contents` describes what the
    folder should contain."""
    if not folder.is_dir():
        raise UserError(
            f"folder {folder} does not exist: choose the folder that contains {contents}",
            code="missing-folder",
        )
    if not paths:
        raise UserError(f"{folder} contains no scene: expected {contents}", code="empty-release")
    first: dict[str, Path] = {}
    for path in paths:
        if (other := first.setdefault(id_of(path), path)) != path:
            raise UserError(
                f"{folder} contains scene {id_of(path)} twice, as {other} and as {path}: "
                "choose a folder that contains each scene once",
                code="duplicate-scene",
            )
    return paths


def check_unique_objects(where: str, ids: Sequence[int]) -> None:
    """Raises RecordError if two objects of a scene have the same id."""
    if repeated := [name for name in ids if ids.count(name) > 1]:
        raise RecordError(f"{where}: two objects have the id {repeated[0]}")


def finite_array(values: Any, shape: tuple[int, ...], optional: bool = False) -> np.ndarray:
    """Return numbers as an array of `shape`, in which -1 stands for any length. Raises ValueError
    if they do not fit it, or if some are non-finite, unless `optional` permits these."""
    try:
        array = np.asarray(values, np.float64).reshape(shape)
    except (TypeError, ValueError) as error:
        raise ValueError(f"expected numbers of shape {shape}: {error}") from error
    if not optional and (wrong := np.argwhere(~np.isfinite(array))).size:
        first = tuple(wrong[0].tolist())
        raise ValueError(f"non-finite values (NaN or Inf), the first at index {first}")
    return array


def find_contacts(
    touches: Iterable[tuple[int, Sequence[int]]], count: int, fps: float
) -> tuple[Collision, ...]:
    """Return the contacts of `count` objects, from the frames in which pairs of indices touch.
    Another index stands for what is no object, such as the floor."""
    touching: dict[tuple[int, int], list[int]] = defaultdict(list)
    for frame, pair in touches:
        one, other = sorted(pair)
        if 0 <= one < other < count:
            touching[one, other].append(frame)
    return group_contacts(touching, fps)


def first_landings(touches: Iterable[tuple[int, int]]) -> tuple[Landing, ...]:
    """Return each object's first landing, from the frames in which objects (by index) land. An
    object that touches the floor in the first frame has none."""
    first: dict[int, int] = {}
    for frame, k in sorted(touches):
        first.setdefault(int(k), int(frame))
    return tuple(Landing(frame, k) for k, frame in first.items() if frame > 0)


def decode_image(image: bytes | Path, where: str) -> Image.Image:
    """Decode an image (bytes or a file) to RGB. An alpha channel is ignored, not blended."""
    try:
        return Image.open(io.BytesIO(image) if isinstance(image, bytes) else image).convert("RGB")
    except (OSError, SyntaxError, ValueError) as error:
        raise RecordError(
            f"{where} cannot be decoded as an image: {error}", "damaged-file"
        ) from error


def reconcile_velocities(scene: Scene, path: Path) -> Scene:
    """Return a scene whose velocities agree with its positions and its frame rate.

    Velocities of another unit of time are multiplied by the factor that explains the difference,
    with the warning `RescaledVelocities`; without such a factor, RecordError is raised. An object
    lacks velocities if some are non-finite, or if all are zero although it moves, as a simulator
    records them for what is no rigid body. They are then derived from positions or orientations.
    """
    norms = np.linalg.norm(scene.quaternions, axis=-1)
    if (wrong := np.argwhere(np.abs(norms - 1) > 0.01)).size:
        frame, k = wrong[0].tolist()
        raise RecordError(
            f"{path}: frame {frame}: the quaternion of object {k} has norm {norms[frame, k]:.3g}, "
            "expected 1"
        )
    rates = _find_rates(scene)
    linear, angular = map(_mask_missing, (scene.velocities, scene.angular_velocities), rates)
    factor, deviations = compare_velocities(replace(scene, velocities=linear))
    if deviations.max(initial=0.0) > MAX_DEVIATION:
        worst = int(deviations.argmax())
        raise RecordError(
            f"{path}: velocities of object {worst} ({scene.objects[worst].noun_phrase}) do not "
            f"agree with its positions at {scene.fps:g} frames per second: they differ by "
            f"{100 * deviations[worst]:.0f}% (median), also if all velocities of the scene are "
            f"multiplied by {factor:.3g}; check the file, and benchmark.fps for Physion",
            "inconsistent-velocities",
        )
    if abs(factor - 1) <= AGREEMENT:
        factor = 1.0
    else:
        warnings.warn(RescaledVelocities(path, factor, scene.fps), stacklevel=2)
    linear, angular = (
        np.where(np.isnan(own), derived, own * factor).astype(np.float32)
        for own, derived in zip((linear, angular), rates, strict=True)
    )
    return replace(scene, velocities=linear, angular_velocities=angular)


def _mask_missing(recorded: np.ndarray, derived: np.ndarray) -> np.ndarray:
    """Return velocities (F, N, 3) with NaN for objects that lack them (see above)."""
    moves = (np.linalg.norm(derived, axis=-1) > MIN_SPEED).sum(axis=0) >= MIN_FRAMES
    lacks = ~np.isfinite(recorded).all(axis=(0, 2)) | (~recorded.any(axis=(0, 2)) & moves)
    return np.where(lacks[:, None], np.nan, recorded)


def compare_velocities(scene: Scene) -> tuple[float, np.ndarray]:
    """Return the factor by which velocities are to be multiplied to agree with the displacements
    between frames, and how much those of each object still deviate (N,), as a share.

    Frames are compared in which an object moves, hardly turns, has finite velocities, and does not
    begin or end a contact. If there are few, the factor is 1; an object with few deviates by 0.
    """
    moved, turned = (rates[1:-1] for rates in _find_rates(scene))
    velocities = scene.velocities[1:-1].astype(float)
    speed, own = (np.linalg.norm(each, axis=-1) for each in (moved, velocities))
    turning = np.linalg.norm(turned, axis=-1) * scene.object_radii
    fast = np.maximum(speed, own)
    compared = (fast > MIN_SPEED) & (turning < MAX_TURN * fast) & np.isfinite(own)
    events = [(frame, c.objects) for c in scene.collisions for frame in (c.frame, c.end)]
    for frame, objects in [*events, *((event.frame, event.object) for event in scene.landings)]:
        # Index i of these arrays is frame i + 1.
        compared[max(frame - CONTACT_MARGIN - 1, 0) : frame + CONTACT_MARGIN, objects] = False
    deviations = np.zeros(len(scene.objects))
    if compared.sum() < MIN_FRAMES:
        return 1.0, deviations
    along = (moved * velocities).sum(axis=-1) / np.maximum(own, 1e-9) ** 2
    factor = float(np.median(along[compared]))
    # Velocities of objects that do not move, or the reverse, have no factor.
    factor = factor if factor > 1e-3 else 1.0
    rest = np.linalg.norm(moved - factor * velocities, axis=-1)
    shares = rest / np.maximum(np.maximum(speed, factor * own), 1e-9)
    for k, is_compared in enumerate(compared.T):
        if is_compared.sum() >= MIN_FRAMES:
            deviations[k] = np.median(shares[is_compared, k])
    return factor, deviations


def _find_rates(scene: Scene) -> tuple[np.ndarray, np.ndarray]:
    """Return linear and angular velocities (F, N, 3) by central differences of positions and of
    orientations; in the first and the last frame, by one-sided ones."""
    from scipy.spatial.transform import Rotation

    frames = np.arange(scene.frames)
    before, after = np.maximum(frames - 1, 0), np.minimum(frames + 1, scene.frames - 1)
    seconds = np.maximum(after - before, 1)[:, None, None] / scene.fps
    first, last = (
        Rotation.from_quat(scene.quaternions[k].reshape(-1, 4).astype(float))
        for k in (before, after)
    )
    moved = scene.positions[after].astype(float) - scene.positions[before]
    turned = (last * first.inv()).as_rotvec().reshape(moved.shape)
    return moved / seconds, turned / seconds
