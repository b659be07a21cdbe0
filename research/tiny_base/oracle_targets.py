"""What the oracle knows of the objects in a sample's pictures, as targets of dense training.

A picture is a pair of a clip's frames, which the vision tower encodes together, or an image. Its
visual tokens are the cells of a square grid. Every clearly visible object gives a target at the
token that contains its centre.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np
import torch
from torch import Tensor

from dynapix.data.records import COLORS, LETTERS, MATERIALS, SHAPES, Scene
from dynapix.teacher.predicates.facts import COMPASS
from dynapix.teacher.predicates.motion import motion_start
from dynapix.teacher.predicates.relations import EXTENTS
from dynapix.teacher.predicates.statement_choice import measure_separation

WORDS = {"color": COLORS, "material": MATERIALS, "shape": SHAPES}
"""The words of a noun phrase, in their order."""
SPATIAL_WORDS = {
    "heading": COMPASS,
    "region": ("top", "left", "right", "center", "bottom"),
    "speed": ("slowly", "steadily", "quickly", "rests", "stationary"),
    "gap": ("apart",),
    "height": ("above", "below", "level"),
    "extent": EXTENTS,
}
"""Words for places, motion and relations."""
CLEARLY_VISIBLE = 0.3
"""An object has a target if its visible fraction is above this."""
AHEAD = (10, 25, 50)
"""Frames ahead for which displacements are predicted."""
RATE = 10
"""A velocity is the displacement during this many frames."""
FARTHEST = 1.0
"""Displacements above this share of the image are left out: the object is far outside of it."""
PICTURES = 1 + len(LETTERS)
"""Pictures in which a named object is found: the last one of the clip, and the candidates."""
UNKNOWN = (float("nan"), float("nan"))


@dataclass(frozen=True)
class ObjectTarget:
    """A visible object in a picture. Places and displacements are shares of the picture's width and
    height; NaN where the picture does not determine them.

    Attributes:
        name: Noun phrase of the object.
        picture: Index of the picture; the pictures of the clip precede the images.
        place: Column and row of the object's centre, from 0 to 1; beyond for an object of which the
            border of the picture cuts off more than half.
        visible: Visible fraction.
        shift: Displacement between the two frames of the picture; NaN in images.
        velocity: Displacement during `RATE` frames; NaN in images.
        ahead: Displacement during each number of frames of `AHEAD`; NaN in images.
        since: Displacement from the object's place at the end of the clip; NaN in the clip and in
            images of other scenes.
        separation: Smallest distance between two of the object's places in this and the earlier
            candidates (see `measure_separation`); NaN in the clip and in the first candidate.
    """

    name: str
    picture: int
    place: tuple[float, float]
    visible: float = 1.0
    shift: tuple[float, float] = UNKNOWN
    velocity: tuple[float, float] = UNKNOWN
    ahead: tuple[tuple[float, float], ...] = (UNKNOWN,) * len(AHEAD)
    since: tuple[float, float] = UNKNOWN
    separation: float = float("nan")

    def cell(self, grid: int) -> int:
        """Return the index of the object's token in its picture, which has grid x grid tokens."""
        column, row = (min(max(int(share * grid), 0), grid - 1) for share in self.place)
        return row * grid + column

    def token(self, grid: int) -> int:
        """Return the index of the object's token among the visual tokens of all pictures."""
        return self.picture * grid**2 + self.cell(grid)


@dataclass(frozen=True)
class OracleTargets:
    """Targets of a batch of B samples with T visual tokens each, N objects at visual tokens, K
    pairs of tokens to track, M names in texts, and S tokens of texts that describe named objects.
    Visual tokens are indices into `visual`, positions are indices into the sequence.

    Attributes:
        visual: (B, T) positions of the visual tokens in the sequence.
        start: (B,) positions of the first tokens, before which a sequence is padded.
        has_picture: (B, PICTURES) whether the prompt has the picture.
        presence: (B, T) 1 where the centre of an object is in the token, otherwise 0.
        objects: (N, 2) row of the batch and token.
        truth: Properties of the N objects, see `stack_targets`; places are relative
            to the centre of the picture.
        inside: (N, 2) place in the token, from -0.5 to 0.5, or beyond at the border of the picture.
        tracked_to_clip: (K, 3) row, token of a candidate, and token of the same object in the clip.
        tracked_to_candidates: (_, 4) row, token of an object in a candidate, index of an earlier
            candidate, and token of the same object there, or -1 where it is not visible.
        names: (M, 2) row and position of a name's last token.
        name_words: (M,) the named object's colour, material and shape, by kind.
        name_tokens: (M, PICTURES) token of the named object in each picture, or -1 where it is not
            visible.
        described_tokens: (_, 3) row, position of a name, and token of the object in the picture
            that the text describes, or -1 where it is not visible.
        name_places: (M, 2 * PICTURES) its places relative to the centre of each picture, NaN where
            it is not visible.
        name_displacements: (M, 2) its displacement up to the moment of the target, or NaN.
        description_tokens: (S, 2) row and position of the tokens that describe a named object, from
            the end of its name on.
        description_states: (S, 8) place and velocity of the object there, its displacement from its
            reference, and that from the place where it is expected, or NaN.
        description_letters: (S,) index of the letter of the candidate in which the text, before its
            outcome, describes the object there; -1 for the clip.
        subjects: (_, 3) row, position after a name, and position of the name.
        references: (_, 3) row, position of a token that describes the sphere in "the cube has the
            sphere left of it", and position of the cube's name.
        text_letters: (_, 3) row, position of a name where the text describes a candidate, and
            position of the candidate's letter in the text.
        prompt_letters: (_, 3) row, position of a visual token of a candidate, and position of its
            letter in the prompt.
        repeats: (_, 3) row, position before a name that the text has mentioned before, and position
            of the first token of its last mention.
        text_tokens: (_, 2) row and position of the tokens of texts.
        object_words: (_, 2) row and position of the tokens of colours, materials and shapes in
            texts.
        spatial_words: (_, 2) row and position of the tokens of words for places, motion and
            relations in texts.
        verdicts: (_, 3) row, position before the letter of a candidate in an outcome, and position
            of the word that says that the candidate agrees, or of its letter after "closest".
        choices: (_, 3) row, position before the letter of the candidate that is said to show an
            object closest to its place, and position of the last token that describes the object in
            this candidate.
        matches: (_, 3) row, position of the letter in a line that says whether a candidate matches,
            and position of the last letter in the outcome.
        next_in_clip: (_, 3) row, position before the first mention of an object in a scene parse,
            and token of the object at the end of the clip.
        next_in_candidates: (_, 3) row, position before the first mention of an object in a text and
            in its predictions, and token of the object in the last candidate that shows it.
    """

    visual: Tensor
    start: Tensor
    has_picture: Tensor
    presence: Tensor
    objects: Tensor
    truth: dict[str, Tensor]
    inside: Tensor
    tracked_to_clip: Tensor
    tracked_to_candidates: Tensor
    names: Tensor
    name_words: dict[str, Tensor]
    name_tokens: Tensor
    described_tokens: Tensor
    name_places: Tensor
    name_displacements: Tensor
    description_tokens: Tensor
    description_states: Tensor
    description_letters: Tensor
    subjects: Tensor
    references: Tensor
    text_letters: Tensor
    prompt_letters: Tensor
    repeats: Tensor
    text_tokens: Tensor
    object_words: Tensor
    spatial_words: Tensor
    verdicts: Tensor
    choices: Tensor
    matches: Tensor
    next_in_clip: Tensor
    next_in_candidates: Tensor


def clip_targets(scene: Scene, frames: Sequence[int]) -> Iterator[ObjectTarget]:
    """Yield the targets of a clip. Their places are those in the later frame of each pair."""
    pairs = zip(frames[::2], [*frames[1::2], frames[-1]], strict=False)
    for picture, (earlier, later) in enumerate(pairs):
        for k in visible_objects(scene, later):
            yield ObjectTarget(
                scene.objects[k].noun_phrase,
                picture,
                _place(scene, later, k),
                _fraction(scene, later, k),
                _displacement(scene, k, earlier, later),
                _velocity(scene, k, earlier, later),
                tuple(_displacement(scene, k, later, later + h) for h in AHEAD),
            )


def image_targets(
    scene: Scene, frame: int, picture: int, clip: tuple[Scene, int] | None
) -> Iterator[ObjectTarget]:
    """Yield the targets of an image.

    Args:
        clip: The scene and the last frame of the clip before the image, if the image shows what
            becomes of this scene.
    """
    for k in visible_objects(scene, frame):
        since = UNKNOWN
        if clip is not None and k in visible_objects(*clip):
            moved = np.subtract(_place(scene, frame, k), _place(*clip, k))
            since = tuple(moved.tolist())
        place, visible = _place(scene, frame, k), _fraction(scene, frame, k)
        name = scene.objects[k].noun_phrase
        yield ObjectTarget(name, picture, place, visible, since=since)


def compare_images(images: Sequence[Sequence[ObjectTarget]]) -> Iterator[ObjectTarget]:
    """Yield the targets of candidates, each with its separation."""
    places = [{t.name: t.place for t in targets} for targets in images]
    for k, image in enumerate(images):
        for target in image:
            so_far = [shown.get(target.name) for shown in places[: k + 1]]
            yield replace(target, separation=measure_separation(so_far)) if k else target


def future_displacements(scene: Scene, frame: int, later: int) -> dict[str, tuple[float, float]]:
    """Return the displacements, by name, of a frame's clearly visible objects up to a later one."""
    return {
        scene.objects[k].noun_phrase: _displacement(scene, k, frame, later)
        for k in visible_objects(scene, frame)
    }


def observed_states(scene: Scene, frame: int) -> dict[str, tuple[float, ...]]:
    """Return the places and velocities (4 numbers), by name, of a frame's clearly visible objects.
    The velocity is that of the frames from which the predicates derive headings."""
    return {
        scene.objects[k].noun_phrase: (
            *_place(scene, frame, k),
            *_velocity(scene, k, max(motion_start(scene, k, frame), 0), frame),
        )
        for k in visible_objects(scene, frame)
    }


def visible_objects(scene: Scene, frame: int) -> list[int]:
    """Return the indices of the clearly visible objects of a frame."""
    # A fraction that the simulator does not record is NaN.
    shown = scene.in_view[frame] & ~(scene.visible_fraction[frame] <= CLEARLY_VISIBLE)
    return np.flatnonzero(shown).tolist()


def _place(scene: Scene, frame: int, k: int) -> tuple[float, float]:
    return tuple((scene.image_positions[frame, k] / scene.image_size).tolist())


def _fraction(scene: Scene, frame: int, k: int) -> float:
    fraction = float(scene.visible_fraction[frame, k])
    return 1.0 if np.isnan(fraction) else fraction


def _displacement(
    scene: Scene, k: int, frame: int, later: int, factor: float = 1.0
) -> tuple[float, float]:
    if later >= scene.frames:
        return UNKNOWN
    moved = np.subtract(_place(scene, later, k), _place(scene, frame, k)) * factor
    return tuple(moved.tolist()) if np.abs(moved).max() <= FARTHEST else UNKNOWN


def _velocity(scene: Scene, k: int, frame: int, later: int) -> tuple[float, float]:
    if later == frame:
        return UNKNOWN
    return _displacement(scene, k, frame, later, RATE / (later - frame))


def most_visible_per_token(targets: Sequence[ObjectTarget], grid: int) -> list[ObjectTarget]:
    """Keep one target per token: that of the object of which most is visible."""
    best: dict[tuple[int, int], ObjectTarget] = {}
    for target in targets:
        key = target.picture, target.cell(grid)
        if key not in best or best[key].visible < target.visible:
            best[key] = target
    return list(best.values())


def name_words(names: Sequence[str]) -> dict[str, Tensor]:
    """Return the indices (N,) of the colours, materials and shapes in the noun phrases of N
    objects."""
    words = np.array([name.split() for name in names]).reshape(-1, 3)
    return {
        kind: torch.tensor([options.index(word) for word in column], dtype=torch.long)
        for (kind, options), column in zip(WORDS.items(), words.T.tolist(), strict=True)
    }


def stack_targets(targets: Sequence[ObjectTarget]) -> dict[str, Tensor]:
    """Return the properties of N targets as tensors.

    Returns:
        `color`, `material` and `shape` (N,) indices; `place`, `shift`, `velocity`, `since` and
        `ahead_<h>` (N, 2) for each h of `AHEAD`; `separation` (N, 1).
    """
    stacked = name_words([t.name for t in targets])

    def pairs(values: list[tuple[float, float]]) -> Tensor:
        return torch.tensor(values, dtype=torch.float32).reshape(-1, 2)

    for name in ("place", "shift", "velocity", "since"):
        stacked[name] = pairs([getattr(t, name) for t in targets])
    for k, h in enumerate(AHEAD):
        stacked[f"ahead_{h}"] = pairs([t.ahead[k] for t in targets])
    stacked["separation"] = torch.tensor([t.separation for t in targets]).reshape(-1, 1)
    return stacked
