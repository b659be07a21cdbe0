"""The records that travel between packages: scenes, items, queries and rationales.

Everything here is plain data with checks: no rendering, no simulation, no models. Field names are
those of the released files, so a reader of `selection.parquet` finds the same words in the code.
"""

from __future__ import annotations

from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

FRAMES = 128
"""Frames a scene (CLEVRER's clip length)."""
FPS = 25
"""Frames a second of a scene; also the clock of the retrieval builders."""
SELECTION_SECOND = 26
"""Frames that the selection track's time builder counts as one second (128 frames in about 5 s)."""
LETTERS = "ABCD"

SHAPES = ("cube", "sphere", "cylinder")
MATERIALS = ("metal", "rubber")
COLORS = ("gray", "red", "blue", "green", "brown", "cyan", "purple", "yellow")
POOLS = ("future", "counterfactual")
SPLITS = ("train", "test")
FAMILIES = ("event", "time", "window")


@dataclass(frozen=True)
class SceneObject:
    """What an object looks like. No two objects of a simulated scene are equal; a transfer suite's
    may be. An attribute that a simulator's record does not give is empty."""

    shape: str
    material: str = ""
    color: str = ""
    size: str = ""
    """small or large where a simulator has objects of several sizes."""

    @property
    def phrase(self) -> str:
        """The noun phrase that names it, such as "blue metal cube"."""
        return " ".join(filter(None, (self.size, self.color, self.material, self.shape)))


@dataclass(frozen=True)
class Collision:
    """The first contact of two objects: the first frame at or after it, and their indices."""

    frame: int
    objects: tuple[int, int]


@dataclass(frozen=True)
class Landing:
    """The first contact with the ground of an object that was in the air: the first frame at or
    after it, and the object's index."""

    frame: int
    object: int


@dataclass(frozen=True, eq=False)
class Scene:
    """One simulated video's oracle, F frames of N objects.

    Attributes:
        positions: (F, N, 3) centres, simulator units, z up.
        quaternions: (F, N, 4) orientations in x y z w order.
        velocities: (F, N, 3) linear velocities, simulator units a second.
        angular_velocities: (F, N, 3) radians a second.
        image_positions: (F, N, 2) projected centres in px of an image of `image_size`, x right
            and y down; defined for every object in front of the camera, on screen or not.
        in_view: (F, N) whether any part of the object falls inside the image.
        visible_fraction: (F, N) visible pixels over the pixels the object would cover alone, 0
            where it covers none; NaN where a simulator's record does not tell.
        collisions: first contacts in order of frame.
        image_size: (width, height) of the image plane that `image_positions` refers to.
        fps: frames a second.
        landings: in order of frame, where a simulator's record tells of the ground.
        scenario: the kind of scene, where a simulator has several.
        footage: where the recorded frames of another simulator's scene are, relative to the
            folder of its release; None for a scene that is rendered from its oracle.
    """

    scene_id: str
    split: str
    objects: tuple[SceneObject, ...]
    collisions: tuple[Collision, ...]
    positions: np.ndarray
    quaternions: np.ndarray
    velocities: np.ndarray
    angular_velocities: np.ndarray
    image_positions: np.ndarray
    in_view: np.ndarray
    visible_fraction: np.ndarray
    image_size: tuple[int, int] = (480, 320)
    fps: float = FPS
    landings: tuple[Landing, ...] = ()
    scenario: str = ""
    footage: str | None = None

    ARRAYS = (
        "positions",
        "quaternions",
        "velocities",
        "angular_velocities",
        "image_positions",
        "in_view",
        "visible_fraction",
    )

    def __post_init__(self) -> None:
        frames, count = self.positions.shape[:2]
        for name in self.ARRAYS:
            shape = getattr(self, name).shape
            if shape[:2] != (frames, count):
                raise ValueError(
                    f"scene {self.scene_id}: {name} has shape {shape}, "
                    f"expected ({frames}, {count}, ...)"
                )
        if len(self.objects) != count:
            raise ValueError(
                f"scene {self.scene_id}: {len(self.objects)} objects named, {count} recorded"
            )
        if self.footage is None and len(set(self.objects)) != count:
            raise ValueError(f"scene {self.scene_id}: two objects share shape, material and color")

    @property
    def frames(self) -> int:
        return self.positions.shape[0]

    def speeds(self) -> np.ndarray:
        """(F, N) lengths of the linear velocities, simulator units a second."""
        return np.linalg.norm(self.velocities, axis=-1)


@dataclass(frozen=True)
class FrameRef:
    """A frame, named by its scene and index. An image file is only a cache of it."""

    scene_id: str
    frame: int

    @property
    def name(self) -> str:
        """What logs and caches know it by."""
        return f"{self.scene_id}/{self.frame}"


@dataclass(frozen=True)
class Candidate(FrameRef):
    """One of an item's four frames. `source` says where it came from: target, same_offset,
    same_obj_match, same_time, same_near, same_far or cross_scene."""

    source: str = "target"


@dataclass(frozen=True)
class SelectionItem:
    """A question with four candidate frames, one of which is the target.

    `prefix_start` and `prefix_stop` are inclusive. An axis that does not apply is None.
    `min_displacement` is the least displacement between two candidates in px at 336 x 336.
    """

    item_id: str
    split: str
    suite: str
    family: str
    subtype: str
    question: str
    scene_id: str
    prefix_start: int
    prefix_stop: int
    target_frame: int
    candidates: tuple[Candidate, ...]
    answer: int
    min_displacement: float
    event_frame: int | None = None
    framing: str | None = None
    distractors: str | None = None
    gap: int | None = None
    horizon: int | None = None
    group: str | None = None
    window_family: str | None = None
    difficulty: str | None = None

    def __post_init__(self) -> None:
        if not self.prefix_start <= self.prefix_stop < self.target_frame:
            raise ValueError(
                f"item {self.item_id}: prefix {self.prefix_start} to {self.prefix_stop} "
                f"does not end before target {self.target_frame}"
            )
        target = [
            i
            for i, c in enumerate(self.candidates)
            if (c.scene_id, c.frame) == (self.scene_id, self.target_frame)
        ]
        if len(self.candidates) != 4 or target != [self.answer]:
            raise ValueError(
                f"item {self.item_id}: expected four candidates with the target at "
                f"{self.answer}, found it at {target} of {len(self.candidates)}"
            )

    @property
    def letter(self) -> str:
        return LETTERS[self.answer]

    @property
    def name(self) -> str:
        """What logs and caches know it by."""
        return self.item_id

    def to_row(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_row(cls, row: dict[str, Any]) -> SelectionItem:
        candidates = tuple(Candidate(**c) for c in row["candidates"])
        return cls(**{**row, "candidates": candidates})


@dataclass(frozen=True)
class RetrievalQuery:
    """A prefix and a question whose answer is one frame of a database."""

    query_id: str
    split: str
    pool: str
    builder: int | None
    anchor: str
    question: str
    scene_id: str
    prefix_start: int
    prefix_stop: int
    target: FrameRef
    hard_negatives: tuple[FrameRef, ...]
    removed_object: str | None = None
    standard: bool = False
    """Whether it belongs to the standard test."""

    @property
    def name(self) -> str:
        """What logs and caches know it by."""
        return self.query_id

    def to_row(self) -> dict[str, Any]:
        return asdict(self)

    @classmethod
    def from_row(cls, row: dict[str, Any]) -> RetrievalQuery:
        negatives = tuple(FrameRef(**f) for f in row["hard_negatives"])
        return cls(**{**row, "target": FrameRef(**row["target"]), "hard_negatives": negatives})


@dataclass(frozen=True)
class Rationale:
    """One answer of a teacher for one item, accepted or not, with the reasons for a rejection."""

    item_id: str
    attempt: int
    accepted: bool
    text: str
    answer: str | None
    teacher: str
    prompt_version: str
    validator_version: str
    settings: str
    """A short hash of the teacher's settings that shape an answer or its verdict."""
    seed: int
    reasons: tuple[str, ...] = ()
    sections: dict[str, str] = field(default_factory=dict)
    prompt_tokens: int | None = None
    """What a server read for this answer; null without a server. Of several answers to one
    request the first has the whole prompt and the others have none."""
    completion_tokens: int | None = None
    """What a server wrote; the answers to one request share its sum evenly."""
    grammar: str | None = None
    """Version of the grammar that the server was held to; null where it was free."""
    finished: float | None = None
    """When a server gave it, seconds since 1970; null without a server."""
    fallback: bool = False
    """Whether the built-in narrator told it in place of a teacher, for an item that was set
    aside."""
    claims: dict[str, list[int]] = field(default_factory=dict)
    """How many of its claims the predicates support, contradict and leave unknown, by kind."""

    def to_row(self) -> dict[str, Any]:
        return {**asdict(self), "reasons": list(self.reasons)}

    @classmethod
    def from_row(cls, row: dict[str, Any]) -> Rationale:
        return cls(**{**row, "reasons": tuple(row["reasons"])})


def sample_prefix_frames(start: int, stop: int, count: int) -> list[int]:
    """The frames of the inclusive range [start, stop] that a model is shown: `count` of them,
    evenly spread with both ends in; every frame where there are no more than `count`."""
    available = stop - start + 1
    if available <= count:
        return list(range(start, stop + 1))
    return [int(f) for f in np.linspace(start, stop, count).round()]
