"""Real videos with the tracks of their objects: a folder of videos, a text file beside each, and
one file of names.

    <folder>/street.mp4     a video; `VIDEO_SUFFIXES` lists the endings
             street.txt     its tracks, as `data.sources.motchallenge` reads them
             tracks.yaml    names and attributes of the objects

The frames of the text file are those that the video shows, in order and without regard to a
rotation that the container asks for. tracks.yaml names each object by its video and its id, or the
objects of a class together, in lower-case words without digits:

    classes: {1: pedestrian}
    videos:
      street:
        fps: 25                 # only if the rate of the container is wrong
        objects:
          3: {noun: ball, color: red, material: rubber, size: small}     # all but noun optional

A video is cut into clips of `CLIP` frames, and each clip is a scene, <video>-<first frame>. Its
coordinates are those of the image plane: `positions` are (x, y, 0) in heights of the image, with x
right and y up from the lower left corner, so that speeds are in image heights per second at any
resolution. In a gap of a track, the centre is interpolated and the object is out of view. Contacts
are not recorded.
"""

from __future__ import annotations

from collections.abc import Iterable
from contextlib import suppress
from pathlib import Path
from typing import Annotated

import numpy as np
from PIL import Image
from pydantic import Field

from dynapix.data.records import FRAMES, Scene, SceneObject
from dynapix.data.sources.motchallenge import Track, read_tracks
from dynapix.data.sources.validation import (
    Layout,
    RecordError,
    check_unique_scenes,
    read_layout,
    scene_id,
)
from dynapix.data.sources.videos import Video, describe_video, load_frames

FOLDER_CONTENTS = "a video street.mp4 beside its tracks street.txt, and tracks.yaml"
VIDEO_SUFFIXES = (".mp4", ".mov", ".m4v", ".avi", ".mkv", ".webm", ".mpg", ".mpeg", ".ts", ".ogv")
NAMES = "tracks.yaml"
CLIP = FRAMES
"""Number of frames of a clip: that of CLEVRER's scenes."""
SHORTEST_CLIP = 24
"""Minimum number of frames of a clip: the prefix and the shortest horizon of a window item. Fewer
frames at the end of a video are left out."""
MIN_FPS = 5
"""Minimum frame rate: the prefix of a time item is a second."""
SPEED_BOUNDS = (0.2, 0.5, 1.0)
"""Upper bounds of slow, steady and quick speeds, image heights per second: an object crosses the
height of the image in more than five seconds, more than two, and more than one."""
SPAN = 2
"""Number of frames before and after a frame from whose centres its velocity is computed. The noise
of boxes would exceed slow speeds between neighbouring frames."""
Word = Annotated[str, Field(pattern=r"^[a-z]+( [a-z]+)*$")]


# The layout of tracks.yaml.
class ObjectNames(Layout, extra="forbid"):
    noun: Word | None = None
    material: Word | None = None
    color: Word | None = None
    size: Word | None = None


class VideoNames(Layout, extra="forbid"):
    fps: Annotated[float, Field(gt=0)] | None = None
    objects: dict[int, ObjectNames] = Field(default_factory=dict)


class Names(Layout, extra="forbid"):
    classes: dict[int, Word] = Field(default_factory=dict)
    videos: dict[str, VideoNames] = Field(default_factory=dict)


def list_scenes(folder: Path) -> list[Path]:
    """Return a path per clip, in order: that of its video followed by the number of its first frame
    (`street.mp4/000128`)."""
    found = sorted(path for path in folder.glob("*") if path.suffix.lower() in VIDEO_SUFFIXES)
    paths = [video / f"{first:06d}" for video in found for first in _clip_starts(video)]
    check_unique_scenes(folder, paths, _scene_id, FOLDER_CONTENTS)
    names = read_layout(folder / NAMES, Names)
    if unknown := sorted(names.videos.keys() - {video.stem for video in found}):
        raise RecordError(f"{folder / NAMES}: videos.{unknown[0]}: {folder} has no such video")
    return paths


def _clip_starts(video: Path) -> list[int]:
    # `read_scene` raises the error of a damaged video, so that it does not stop the others.
    with suppress(RecordError):
        last = len(describe_video(video).times) - SHORTEST_CLIP
        return [*range(0, last + 1, CLIP)] or [0]
    return [0]


def _scene_id(path: Path) -> str:
    return scene_id(path.parent.stem, path.name)


def read_scene(path: Path, folder: Path, split: str) -> Scene:
    """Return the scene of a clip, with the objects that have a box in it."""
    file, first = path.parent, int(path.name)
    video, names = describe_video(file), read_layout(folder / NAMES, Names)
    own = names.videos.get(file.stem, VideoNames())
    total, (_, height) = len(video.times), video.size
    if total < SHORTEST_CLIP:
        raise RecordError(f"{file} has {total} frames, expected at least {SHORTEST_CLIP}")
    fps = own.fps or video.fps
    if fps is None or fps < MIN_FPS:
        found = "no frame rate" if fps is None else f"{fps:g} frames per second"
        raise RecordError(
            f"{file} has {found}, expected at least {MIN_FPS} frames per second (the rate of the "
            f"container; videos.{file.stem}.fps in {NAMES} replaces it)"
        )
    tracks = read_tracks(text := file.with_suffix(".txt"))
    if unknown := sorted(own.objects.keys() - tracks.keys()):
        where = f"{folder / NAMES}: videos.{file.stem}.objects.{unknown[0]}"
        raise RecordError(f"{where}: {text} has no such id")
    times = np.arange(first, min(first + CLIP, total))
    for key, track in tracks.items():
        _check_track(text, key, track, times, video)
    shown = {k: track for k, track in tracks.items() if np.isin(times, track.frames).any()}
    image, velocities = np.zeros((2, len(times), len(shown), 2))
    in_view, fraction, radii = np.zeros(image.shape[:2], bool), np.zeros(image.shape[:2]), []
    for k, track in enumerate(shown.values()):
        image[:, k] = track.at(times)
        # The velocity is 0 before and after the boxes.
        early, late = np.clip([times - SPAN, times + SPAN], track.frames[0], track.frames[-1])
        elapsed = np.maximum(late - early, 1)[:, None] / fps
        velocities[:, k] = (track.at(late) - track.at(early)) / elapsed
        boxes = np.isin(track.frames, times)
        in_view[track.frames[boxes] - first, k] = True
        fraction[in_view[:, k], k] = track.visibility[boxes]
        radii.append(track.sizes[boxes].mean() / 2 / height)
    return Scene(
        scene_id=_scene_id(path),
        split=split,
        objects=tuple(_name_object(text, names, own, *pair) for pair in shown.items()),
        collisions=(),
        positions=_to_plane(image - [0, height], height),
        quaternions=np.full((*in_view.shape, 4), np.float32([0, 0, 0, 1])),
        velocities=_to_plane(velocities, height),
        angular_velocities=np.zeros((*in_view.shape, 3), np.float32),
        image_positions=image.astype(np.float32),
        in_view=in_view,
        visible_fraction=fraction.astype(np.float32),
        image_size=video.size,
        fps=fps,
        footage=file.relative_to(folder).as_posix(),
        radii=tuple(map(float, radii)),
        speed_bounds=SPEED_BOUNDS,
        records_contacts=False,
    )


def load_images(scene: Scene, folder: Path, frames: Iterable[int]) -> dict[int, Image.Image]:
    """Return frames of a scene's clip as RGB images, by frame index."""
    first = int(scene.scene_id.rpartition("-")[2])
    images = load_frames(folder / str(scene.footage), [first + frame for frame in frames])
    return {index - first: image for index, image in images.items()}


def _to_plane(vectors: np.ndarray, height: int) -> np.ndarray:
    """Convert (F, N, 2) vectors in px, y down, to (F, N, 3) in image heights, y up and z 0."""
    return np.pad(vectors * [1, -1] / height, ((0, 0), (0, 0), (0, 1))).astype(np.float32)


def _name_object(text: Path, names: Names, own: VideoNames, key: int, track: Track) -> SceneObject:
    words = own.objects.get(key, ObjectNames())
    if (noun := words.noun or names.classes.get(track.category)) is None:
        raise RecordError(
            f"{text}: line {track.lines[0]}: id {key} has no noun: {NAMES} names it neither below "
            f"videos.{text.stem}.objects nor by its class"
        )
    return SceneObject(noun, words.material or "", words.color or "", words.size or "")


def _check_track(text: Path, key: int, track: Track, times: np.ndarray, video: Video) -> None:
    """Refuse a box beyond the video, and a jump to a frame of `times` from the one before."""
    if track.frames[-1] >= (total := len(video.times)):
        raise RecordError(
            f"{text}: line {track.lines[-1]}: frame {track.frames[-1] + 1} is beyond the {total} "
            "frames of the video"
        )
    steps = np.linalg.norm(np.diff(track.centres, axis=0), axis=-1)
    bound = np.hypot(*video.size) / 2
    is_next = (np.diff(track.frames) == 1) & np.isin(track.frames[1:], times)
    for k in np.flatnonzero(is_next & (steps > bound))[:1]:
        raise RecordError(
            f"{text}: line {track.lines[k + 1]}: id {key} jumps by {steps[k]:.0f} px to frame "
            f"{track.frames[k + 1] + 1}, more than half of the image's diagonal ({bound:.0f} px): "
            "its track belongs to two objects"
        )
