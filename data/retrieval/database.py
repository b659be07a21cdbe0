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
) -> tuple[dict[int, int], int]:
    """A scene's frames of the database.

    Targets come first, then frames in a seeded order until there are `wanted`; a frame that is
    pixel-identical to one chosen before is a twin and left out.

    Returns:
        For every frame looked at, the chosen frame that shows the same pixels (itself if chosen),
        and the number of twins.
    """
    chosen: dict[bytes, int] = {}
    stands_for: dict[int, int] = {}
    others = cell_rng(seed, "database", scene_id).permutation(frames).tolist()
    targets = sorted(set(targets))
    for frame in dict.fromkeys([*targets, *others]):
        if len(chosen) >= max(wanted, len(targets)) and frame not in targets:
            break
        pixels = hashlib.sha256(image_of(frame).tobytes()).digest()
        stands_for[frame] = chosen.setdefault(pixels, frame)
    return stands_for, len(stands_for) - len(chosen)


def drop_twin_targets(
    queries: list[RetrievalQuery], stands_for: dict[FrameRef, FrameRef]
) -> list[RetrievalQuery]:
    """Queries whose target is in the database under its own name. A target that looks like another
    one has no answer of its own."""
    return [q for q in queries if stands_for.get(q.target, q.target) == q.target]
