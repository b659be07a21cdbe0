"""Groundings: the facts from which a rationale is written are the simulator's, or a guess.

The narrator, its words and the answer are the same for every grounding. Ungrounded rationales
measure what the facts of a rationale contribute, apart from its form.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from itertools import combinations
from typing import TYPE_CHECKING

import numpy as np

from dynapix.conf.errors import UserError
from dynapix.data.oracle.events import group_contacts
from dynapix.data.oracle.extrapolation import extrapolate, project
from dynapix.data.records import ALTERNATIVE, Collision, Scene, SelectionItem, original_scene_id
from dynapix.data.seeded_order import named_rng
from dynapix.teacher.predicates.extraction import name_moment
from dynapix.teacher.predicates.facts import RelationalPredicates
from dynapix.teacher.predicates.motion import STATIONARY
from dynapix.teacher.predicates.places import contact_distance
from dynapix.teacher.predicates.vocabulary import describe_item

if TYPE_CHECKING:
    from dynapix.conf.schema import TeacherConfig
    from dynapix.data.store import Store

EXTRAPOLATED = f"{ALTERNATIVE}extrapolated"
"""Suffix of the id of a scene that a guess continues. It marks an alternative future."""


class Grounding:
    """The facts of the rationales of a benchmark's training items.

    With `cfg.grounding`:

    - oracle: those of the item.
    - extrapolated: the same with another target, in which the objects have kept the velocities of
      the prefix's last frame, or of the frame after an intervention that the question states.
      Objects on straight paths that meet are said to collide, and move on. The distractors are
      described as they are.
    - shuffled: those of a training item of another scene, drawn with `cfg.seed`, that has the same
      family and answer and, if there is one, the same words for the moment.
    """

    def __init__(self, store: Store, cfg: TeacherConfig) -> None:
        self._store, self._cfg = store, cfg
        self._donors = store.training_items() if cfg.grounding == "shuffled" else []

    def describe(
        self, item: SelectionItem, predicates: RelationalPredicates | None = None
    ) -> RelationalPredicates | None:
        """Return the predicates from which the rationale of an item is written; None if a prefix is
        too short, or if no other item can be drawn.

        Args:
            predicates: Those of the item, if they are known.

        Raises:
            UserError: The scenes record no camera, so that no frame can be extrapolated.
        """
        store, cfg = self._store, self._cfg
        if cfg.grounding == "extrapolated":
            item, scene_of = extrapolate_target(item, store)
            return describe_item(item, store, cfg, scene_of)
        if cfg.grounding == "shuffled":
            drawn = find_donors(item, self._donors, cfg.seed)
            return next(filter(None, (describe_item(donor, store, cfg) for donor in drawn)), None)
        return predicates or describe_item(item, store, cfg)


def extrapolate_target(
    item: SelectionItem, store: Store
) -> tuple[SelectionItem, Callable[[str], Scene]]:
    """Return an item whose target is a frame of an extrapolated scene, and the function that
    returns a scene by its id, including this one."""
    # An intervention changes the state of the frame after the prefix.
    stop = item.prefix_stop + (item.target.scene_id != item.scene_id)
    guess = extrapolate_scene(store.scene(item.target.scene_id), stop, store)
    candidates = list(item.candidates)
    candidates[item.answer] = replace(item.target, scene_id=guess.scene_id)

    def scene_of(scene_id: str) -> Scene:
        return guess if scene_id == guess.scene_id else store.scene(scene_id)

    return replace(item, candidates=tuple(candidates)), scene_of


def extrapolate_scene(scene: Scene, stop: int, store: Store) -> Scene:
    """Return a scene whose objects keep their velocities and orientations after frame `stop`, and
    pass through each other. After it, an object is in view if its centre is, or if it has been in
    view at `stop` and rests."""
    seconds = np.arange(1, scene.frames - stop)[:, None, None] / scene.fps
    positions = _continued(scene.positions, stop, extrapolate(scene, stop, seconds))
    image = project(positions, scene, store.manifest["config"])
    if image is None:
        raise UserError(
            f"teacher.grounding=extrapolated: {store.name} records no camera, so the places of "
            "extrapolated objects in the image are unknown. Use oracle or shuffled",
            code="no-camera",
        )
    inside = ((image >= 0) & (image < scene.image_size)).all(axis=-1)
    rests = np.linalg.norm(scene.velocities[stop], axis=-1) < STATIONARY
    inside |= scene.in_view[stop] & rests
    contacts = [c for c in scene.collisions if c.frame <= stop]
    return replace(
        scene,
        scene_id=scene.scene_id + EXTRAPOLATED,
        collisions=(*contacts, *_meetings(scene, positions, stop)),
        positions=positions,
        quaternions=_continued(scene.quaternions, stop),
        velocities=_continued(scene.velocities, stop),
        angular_velocities=_continued(scene.angular_velocities, stop),
        image_positions=_continued(scene.image_positions, stop, image[stop + 1 :]),
        in_view=_continued(scene.in_view, stop, inside[stop + 1 :]),
        visible_fraction=_continued(scene.visible_fraction, stop, inside[stop + 1 :]),
    )


def find_donors(
    item: SelectionItem, items: Sequence[SelectionItem], seed: int
) -> Iterator[SelectionItem]:
    """Yield the items of other scenes with the same family and answer, in random order: first those
    whose moment has the same words."""
    order = named_rng(seed, "donor", item.item_id).permutation(len(items))
    others = [
        other
        for other in (items[k] for k in order)
        if (other.family, other.answer) == (item.family, item.answer)
        and original_scene_id(other.scene_id) != original_scene_id(item.scene_id)
    ]
    yield from sorted(others, key=lambda other: name_moment(other) != name_moment(item))


def _continued(values: np.ndarray, stop: int, later: np.ndarray | None = None) -> np.ndarray:
    """Return the values of all frames, with others after frame `stop`, or with those of `stop`."""
    result = values.copy()
    result[stop + 1 :] = values[stop] if later is None else later
    return result


def _meetings(scene: Scene, positions: np.ndarray, stop: int) -> tuple[Collision, ...]:
    """Return the contacts that begin after frame `stop`, for given positions; none in a scene that
    does not record contacts."""
    if not scene.records_contacts:
        return ()
    touching = {}
    for i, j in combinations(range(len(scene.objects)), 2):
        apart = np.linalg.norm(positions[stop:, i, :2] - positions[stop:, j, :2], axis=-1)
        touching[i, j] = stop + np.flatnonzero(apart < contact_distance(scene, i, j))
    return tuple(c for c in group_contacts(touching, scene.fps) if c.frame > stop)
