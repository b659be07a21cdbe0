"""The frames that retrieval ranks: every test target, filled up with other frames of test scenes,
no two of them alike to the pixel."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Iterable

from PIL import Image

from data.records import FrameRef, RetrievalQuery
from data.selection.drafts import cell_rng


def share_of_scene(total: int, scenes: int, index: int) -> int:
    """How many of a database's frames scene `index` of `scenes` gives."""
    return total * (index + 1) // scenes - total * index // scenes


def choose_frames(
    targets: Iterable[int],
    image_of: Callable[[int], Image.Image],
    frames: int,
    wanted: int,
    seed: int,
    scene_id: str,
) -> dict[int, str]:
    """A scene's frames for the database: its targets, then frames in a seeded order until `wanted`
    of them differ in their pixels.

    Returns:
        A hash of the pixels of every frame looked at, in that order.
    """
    pixels: dict[int, str] = {}
    others = cell_rng(seed, "database", scene_id).permutation(frames).tolist()
    targets = sorted(set(targets))
    for frame in dict.fromkeys([*targets, *others]):
        if frame not in targets and len(set(pixels.values())) >= max(wanted, len(targets)):
            break
        pixels[frame] = hashlib.sha256(image_of(frame).tobytes()).hexdigest()
    return pixels


def distinct(pixels: dict[FrameRef, str], first: Iterable[FrameRef]) -> dict[FrameRef, FrameRef]:
    """For every frame the one that stands for its pixels in the database: of frames alike to the
    pixel, in one scene or in several, one of `first` or else the first of them."""
    shown: dict[str, FrameRef] = {}
    for frame in [*first, *pixels]:
        shown.setdefault(pixels[frame], frame)
    return {frame: shown[digest] for frame, digest in pixels.items()}


def drop_twin_targets(
    queries: list[RetrievalQuery], stands_for: dict[FrameRef, FrameRef]
) -> list[RetrievalQuery]:
    """Queries whose target is in the database under its own name. A target that looks like another
    one has no answer of its own."""
    return [q for q in queries if stands_for.get(q.target, q.target) == q.target]
