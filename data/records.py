"""The records that packages exchange: scenes, items, queries and rationales.

They are dataclasses that check their values; they do not render, simulate or run models. Field
names equal the column names of the exported tables, which `data/publish/columns.yaml` describes.
"""

from __future__ import annotations

from dataclasses import dataclass, field
from functools import cache
from typing import TYPE_CHECKING, Any, Self

import numpy as np

from dynapix.conf.schema.world import RADIUS

if TYPE_CHECKING:
    from pydantic import TypeAdapter

FRAMES = 128
"""Frames per scene (CLEVRER's clip length)."""
FPS = 25
"""Frame rate of scenes of the suite `dynapix`. A second in the questions of retrieval queries is
this number of frames."""
SELECTION_SECOND = 26
"""Frames that the time family of selection items counts as a second: 128 frames in 5 s, rounded up.
This is one more than FPS."""
SPEED_BOUNDS = (0.6, 1.5, 3.0)
"""Default upper bounds of the speeds that rationales call slow, steady and quick, simulator units
per second."""
LETTERS = "ABCD"

SHAPES = ("cube", "sphere", "cylinder")
MATERIALS = ("metal", "rubber")
COLORS = ("gray", "red", "blue", "green", "brown", "cyan", "purple", "yellow")
SPLITS = ("train", "test")
FAMILIES = ("event", "time", "window")
COUNTERFACTUAL, ALTERNATIVE = "-without-", "-alt-"
"""What follows the id of a scene in the ids of its counterfactuals and alternative futures."""
INTERVENTION = "intervention"
"""The source of the candidate that shows what would have come, in the item about what comes; the
framing of the other item of the pair."""
CONTACT, GHOST = "contact", "ghost"
"""The distractors of items that only contact physics solves, and the one of them in which the two
objects pass through each other."""


@dataclass(frozen=True)
class SceneObject:
    """The appearance of an object. Objects of a scene that Bullet simulated all look different.

    An attribute that a release of another simulator does not record is an empty string.
    """

    shape: str
    material: str = ""
    color: str = ""
    size: str = ""
    """small or large in MoVi-A, whose objects have two sizes."""

    @property
    def noun_phrase(self) -> str:
        """The noun phrase that names the object, such as "blue metal cube"."""
        return " ".join(filter(None, (self.size, self.color, self.material, self.shape)))


@dataclass(frozen=True)
class Collision:
    """A contact of two objects, from the first touch until they separate."""

    frame: int
    """The first frame at or after the first touch; 0 if the objects touch from the start."""
    objects: tuple[int, int]
    """Indices of the two objects, the lower one first."""
    end: int
    """The last frame in which the objects touch."""


@dataclass(frozen=True)
class Landing:
    """The first contact of an object that was in the air with the floor or a part of the world."""

    frame: int
    """The first frame at or after the contact."""
    object: int
    """Index of the object."""


@dataclass(frozen=True, eq=False)
class Scene:
    """The oracle of one simulated video with F frames and N objects.

    Attributes:
        positions: (F, N, 3) centres, simulator units, z up.
        quaternions: (F, N, 4) orientations in x y z w order.
        velocities: (F, N, 3) linear velocities, simulator units per second.
        angular_velocities: (F, N, 3) radians per second.
        image_positions: (F, N, 2) projected centres in px of an image of `image_size`, x right
            and y down; defined for every object in front of the camera, on screen or not.
        in_view: (F, N) whether a part of the object lies inside the image, even if other objects
            hide it; in MoVi-A and Physion, whether a part of the object is visible.
        visible_fraction: (F, N) visible pixels divided by the pixels that the object would cover
            alone, 0 if it would cover none; NaN where a simulator's record lacks it.
        collisions: every contact of every pair, in order of frame (`data.oracle.events` has what
            follows from them, such as the next collision); empty in alternative futures.
        image_size: (width, height) of the image plane that `image_positions` refers to.
        fps: frames per second.
        landings: landings in order of frame, for simulators that record contacts with the ground.
        scenario: the kind of scene, for a simulator with several kinds.
        footage: path of the recorded frames of another simulator's scene, relative to the folder
            of its release; None for a scene that is rendered from its oracle.
        scales: sizes of the objects as multiples of their shapes' standard size; empty if all are
            1, or if they are not known.
        radii: half of each object's horizontal extent, simulator units; empty for the standard
            radius times the scale.
        speed_bounds: upper bounds of the speeds that rationales call slow, steady and quick,
            simulator units per second; empty for the default bounds.
        records_contacts: whether `collisions` has the contacts of the objects. Otherwise, nothing
            is known of contacts, collision courses and gaps.
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
    scales: tuple[float, ...] = ()
    radii: tuple[float, ...] = ()
    speed_bounds: tuple[float, ...] = ()
    records_contacts: bool = True

    ARRAYS = (
        "positions", "quaternions", "velocities", "angular_velocities", "image_positions",
        "in_view", "visible_fraction",
    )  # fmt: skip

    @property
    def frames(self) -> int:
        return self.positions.shape[0]

    @property
    def object_scales(self) -> tuple[float, ...]:
        """The size of each object, as a multiple of the standard size of its shape."""
        return self.scales or (1.0,) * len(self.objects)

    @property
    def object_radii(self) -> tuple[float, ...]:
        """Half of the horizontal extent of each object, simulator units. Two objects on the floor
        touch where their distance is about the sum of their radii."""
        return self.radii or tuple(RADIUS * scale for scale in self.object_scales)

    @property
    def object_keys(self) -> list[tuple[SceneObject, int]]:
        """The appearance of each object, with its number among the objects that look alike."""
        return [(each, self.objects[:k].count(each)) for k, each in enumerate(self.objects)]


@dataclass(frozen=True)
class FrameRef:
    """A reference to a frame by its scene and index."""

    scene_id: str
    frame: int

    @property
    def name(self) -> str:
        """The frame's key in logs and caches."""
        return f"{self.scene_id}/{self.frame}"


@dataclass(frozen=True)
class Candidate(FrameRef):
    """One of an item's four frames. `source` is `target` or the kind of distractor: same_offset,
    same_obj_match, same_time, same_near, same_far, cross_scene or alternative; of a contact item,
    mass, bounce, aim or ghost; of a pair about an intervention, actual or intervention."""

    source: str = "target"


def original_scene_id(scene_id: str) -> str:
    """Return the id of the scene of which a scene is a counterfactual or an alternative future, or
    of the scene itself."""
    return scene_id.partition(COUNTERFACTUAL)[0].partition(ALTERNATIVE)[0]


@dataclass(frozen=True)
class SelectionItem:
    """A question with four candidate frames, one of which is the target.

    `prefix_start` and `prefix_stop` are inclusive. `answer` is the index of the target among the
    candidates. `min_displacement` is the smallest displacement between two candidates, px at
    336 x 336. Fields that do not apply to the item's family are None.
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
        frames = [(c.scene_id, c.frame) for c in self.candidates]
        shown = frames[self.answer : self.answer + 1]
        if len(frames) != 4 or [frames.count(frame) for frame in shown] != [1]:
            raise ValueError(
                f"item {self.item_id}: expected four candidates, the target only at index "
                f"{self.answer}"
            )
        target = original_scene_id(self.target.scene_id), self.target.frame
        if target != (original_scene_id(self.scene_id), self.target_frame):
            raise ValueError(
                f"item {self.item_id}: its target {self.target.name} is not frame "
                f"{self.target_frame} of scene {self.scene_id} or of one of its futures"
            )

    @classmethod
    def from_row(cls, row: dict[str, Any]) -> Self:
        return cls(**row | {"candidates": tuple(Candidate(**c) for c in row["candidates"])})

    @property
    def letter(self) -> str:
        return LETTERS[self.answer]

    @property
    def target(self) -> Candidate:
        """The right candidate, from the item's scene or, about an intervention, from a future of
        it."""
        return self.candidates[self.answer]

    @property
    def name(self) -> str:
        """The item's key in logs and caches."""
        return self.item_id


@dataclass(frozen=True)
class RetrievalQuery:
    """A prefix and a question whose answer is one frame of a database.

    `pool` is `future`, or `counterfactual` for queries about the scene without one of its objects.
    `builder` is the number (1 to 6) of the function that makes future-state queries of this kind;
    it is None in the counterfactual pool. `anchor` is what the question refers to: time, event or
    intervention.
    """

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
    hard_negatives: tuple[FrameRef, ...] = ()
    removed_object: str | None = None
    asked_object: str | None = None
    """The object whose place a counterfactual query asks for."""

    @classmethod
    def from_row(cls, row: dict[str, Any]) -> Self:
        negatives = tuple(FrameRef(**ref) for ref in row["hard_negatives"])
        return cls(**row | {"target": FrameRef(**row["target"]), "hard_negatives": negatives})

    @property
    def name(self) -> str:
        """The query's key in logs and caches."""
        return self.query_id

    @property
    def factual_twin(self) -> FrameRef | None:
        """The frame of the factual scene at the target's moment, which is the first hard negative
        of a counterfactual query; None in the future pool."""
        is_counterfactual = self.pool == "counterfactual"
        return FrameRef(self.scene_id, self.target.frame) if is_counterfactual else None


@dataclass(frozen=True)
class Rationale:
    """One response of a teacher for one item, accepted or rejected with reasons."""

    item_id: str
    attempt: int
    accepted: bool
    text: str
    answer: str | None
    teacher: str
    prompt_version: str
    validator_version: str
    settings: str
    """A short hash of the settings that affect a response or its validation."""
    seed: int
    reasons: tuple[str, ...] = ()
    sections: dict[str, str] = field(default_factory=dict)
    prompt_tokens: int | None = None
    """Number of prompt tokens; None without a server. If a request has several responses, only the
    first counts them and the others have 0."""
    completion_tokens: int | None = None
    """Number of generated tokens, as an equal share of the request's total."""
    grammar: str | None = None
    """Version of the grammar, or of the schema of cited rationales, that constrained the server;
    None if nothing did, whatever was asked for."""
    finished: float | None = None
    """Time of the server's response, seconds since 1970; None without a server."""
    fallback: bool = False
    """Whether the built-in narrator wrote the text because no response of the teacher passed."""
    claims: dict[str, list[int]] = field(default_factory=dict)
    """Counts of supported, contradicted and unknown claims about the scene, by kind of claim."""
    predicates: str = "paper 1"
    """Vocabulary of the predicates from which the text is written, and its version."""
    sufficiency: float | None = None
    """Probability that a reader who knows only the prediction picks the target; None if it was not
    measured (see `teacher.validation.sufficiency`)."""
    undecided: bool = False
    """Whether there is a distractor of which all statements about the target's frame are true
    (`teacher.predicates.statement_choice`)."""
    sample: str | None = None
    """The random sample of items that was narrated when the text was written; None for all."""

    @classmethod
    def from_row(cls, row: dict[str, Any]) -> Self:
        """Return a row's record. Raises ValueError if a value is missing or has a wrong type."""
        return _rationale_adapter().validate_python(row)


@cache
def _rationale_adapter() -> TypeAdapter[Rationale]:
    # Reading a benchmark does not need pydantic.
    from pydantic import TypeAdapter

    return TypeAdapter(Rationale)


def sample_prefix_frames(start: int, stop: int, count: int) -> list[int]:
    """Sample `count` evenly spaced frames of the inclusive range [start, stop], with both ends; all
    frames if the range has fewer."""
    return [int(f) for f in np.linspace(start, stop, min(count, stop - start + 1)).round()]
