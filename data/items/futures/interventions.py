"""Makes pairs of selection items about interventions: what comes, and what would have come.

The two items of a pair share the prefix, the moment and the four candidates. One item asks for the
scene's own future. The other one asks for the future that follows if something changes when the
prefix ends, shortly before a collision (`CHANGES`). Both futures are candidates; the other two
are variations of them. A model that ignores the intervention answers both items alike, and so gets
no pair right.

An object that vanishes is missing in all four candidates, in the scene's own future too: otherwise,
the images that lack it would reveal the answer.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Any

import numpy as np

from dynapix.conf.schema import WorldConfig
from dynapix.conf.schema.benchmark import INTERVENTIONS
from dynapix.data.items.futures.contact import (
    DIRECTIONS,
    STRAY,
    collision_timings,
    sample_outcomes,
)
from dynapix.data.items.futures.options import FuturesPicker, Options, distinct_choices
from dynapix.data.items.futures.simulation import (
    MAX_LOG_FACTOR,
    MOVING,
    own_motion,
    scene_states,
    simulate_futures,
    turn_velocity,
)
from dynapix.data.items.pickers import Recipe, Timing
from dynapix.data.items.recipes import EVENT_QUESTION, pair_key
from dynapix.data.items.scores import Balance
from dynapix.data.oracle.events import group_contacts, next_collision
from dynapix.data.records import (
    ALTERNATIVE,
    GHOST,
    INTERVENTION,
    Candidate,
    Collision,
    Scene,
    SelectionItem,
)
from dynapix.data.sim.camera import Camera
from dynapix.data.sim.physics import Branch, Motion

CHANGES = {
    "absent": "the {} vanished",
    "heavier": "the {} became as heavy as if it were of metal",
    "lighter": "the {} became as light as if it were of rubber",
    "faster": "the {} became twice as fast",
    "other_side": "the {} were on the other side of the {}, and came towards it from there at the "
    "same speed",
}
"""What changes when the prefix ends, by subtype: about the changed object, and the other object of
the collision."""
QUESTION = (
    "Suppose that, when the observation ended, {}. Which image is closest to the future state of "
    "the whole scene that would follow?"
)
UNSEEN = "None of the four images shows the {}. "
"""Start of the questions about an object that vanishes."""
GAPS = (16, 26)
"""Frames from the collision to the target."""
VARIATIONS = 8
"""Number of variations of the changed future from which candidates are chosen."""
CLEAR = 1.1
"""Minimum distance of an object from the others when it is moved, as a share of the sum of their
radii."""
FAR = 100.0
"""Distance behind the camera to which an object that vanishes is moved, simulator units."""


def make_intervention_recipe(change: str) -> Recipe:
    """Return the recipe of the items about the scene's own future in the pairs of a subtype."""

    def timings(scene: Scene) -> list[Timing]:
        return [timing for gap in GAPS for timing in collision_timings(gap, scene)]

    def fields(timing: Timing) -> Mapping[str, Any]:
        return {
            "subtype": change, "question": EVENT_QUESTION, "framing": "future",
            "distractors": INTERVENTION, "gap": timing.target - timing.stop,
        }  # fmt: skip

    return Recipe("event", timings, fields, lambda *_: [], suite=INTERVENTIONS)


@dataclass(frozen=True)
class Intervention:
    """What changes at the end of a prefix.

    Attributes:
        branch: The changed continuation of the scene.
        changed: Index of the changed object.
        vanishes: Whether the object is missing in all candidates.
    """

    branch: Branch
    changed: int
    vanishes: bool = False


def find_interventions(
    change: str, scene: Scene, stop: int, world: WorldConfig
) -> Iterator[Intervention]:
    """Yield the possible interventions of a kind on the two objects of the next collision."""
    states = scene_states(scene)[stop].astype(float)
    pair = next_collision(scene, stop).objects
    faster, slower = sorted(pair, key=lambda k: -np.linalg.norm(states[k, 7:9]))
    if change == "absent":
        for k in pair:
            yield Intervention(Branch(move_away(states[None], k, world)[0]), k, vanishes=True)
    elif change == "faster":
        changed = states.copy()
        changed[faster, 7:] *= 2
        yield Intervention(Branch(changed), faster)
    elif change == "other_side":
        changed = states.copy()
        changed[faster, :2] = 2 * states[slower, :2] - states[faster, :2]
        changed[faster, 7:9] *= -1
        others = [k for k in range(len(states)) if k != faster]
        gaps = np.linalg.norm(states[others, :3] - changed[faster, :3], axis=-1)
        reach = CLEAR * (np.array(scene.object_radii)[others] + scene.object_radii[faster])
        if np.linalg.norm(states[slower, 7:9]) < MOVING and (gaps > reach).all():
            yield Intervention(Branch(changed), faster)
    else:
        material = {"heavier": "metal", "lighter": "rubber"}[change]
        masses = vars(world.objects.mass)
        for k in pair:
            factor = masses[material] / masses[scene.objects[k].material]
            if factor != 1:
                factors = [factor if j == k else 1.0 for j in range(len(states))]
                yield Intervention(Branch(states, masses=factors), k)


def move_away(states: np.ndarray, index: int, world: WorldConfig) -> np.ndarray:
    """Return states (F, N, 13) in which an object lies at rest behind the camera."""
    camera, moved = Camera.from_settings(world.camera), states.copy()
    ahead = camera.axes[2, :2] / np.linalg.norm(camera.axes[2, :2])
    moved[:, index, :2] = np.array(camera.eye[:2]) - FAR * ahead
    moved[:, index, 7:] = 0
    return moved


@dataclass(kw_only=True)
class InterventionPicker(FuturesPicker):
    """Makes the items about the scene's own future in the pairs of one subtype and one split."""

    def __post_init__(self) -> None:
        self.balance = Balance(self.rng)

    def _make_from_futures(
        self, recipe: Recipe, scene: Scene, timing: Timing, subjects: tuple[int, ...]
    ) -> SelectionItem | str:
        stop, target, least = timing.stop, timing.target, self.inputs.min_displacement
        subtype = recipe.fields(timing)["subtype"]
        possible = [*find_interventions(subtype, scene, stop, self.world)]
        if not possible:
            return "no such intervention"
        chosen = possible[self.rng.integers(len(possible))]
        branches = [chosen.branch, *sample_variations(scene, stop, chosen, self.rng)]
        simulated = simulate_futures(scene, stop, target, branches, self.world)
        name = f"{scene.scene_id}{ALTERNATIVE}{subtype}-{chosen.changed}-{stop}-{target}"
        own = f"{name}-1" if chosen.vanishes else scene.scene_id
        # The scene's own future, the changed one, the own one simulated again, and variations.
        motions = {own: own_motion(scene, stop, target)}
        motions |= {f"{name}-{k}": motion for k, motion in enumerate(simulated, 2)}
        question = EVENT_QUESTION
        if chosen.vanishes:
            motions = {
                key: without_object(motion, chosen.changed, self.world)
                for key, motion in motions.items()
            }
            subjects = tuple(k for k in subjects if k != chosen.changed)
            question = UNSEEN.format(scene.objects[chosen.changed].noun_phrase) + question
        sources = ["target", INTERVENTION, *["alternative"] * (len(motions) - 2)]
        named = zip(motions, sources, strict=True)
        candidates = [Candidate(key, target, source) for key, source in named]
        options = Options(scene, timing, candidates, motions, self.world)
        displacement = options.displacement(subjects)
        if displacement[0, 2] > STRAY * least:
            return "target cannot be simulated again"
        pairs = combinations(range(3, len(candidates)), 2)
        choices = np.array([(0, 1, *pair) for pair in pairs])
        choices = distinct_choices(choices, displacement, least)
        if not len(choices):
            return "too few suitable futures"
        # The changed future is often beyond the scene's own one, such as that of a faster object,
        # so that only the ranks of both together can be even.
        best = self.balance.choose(options.scores(choices), targets=(0, 1))
        if best is None:
            return "refused by the balance"
        collisions = {key: join_collisions(scene, stop, each) for key, each in motions.items()}
        collisions[own] = scene.collisions
        return self._make_from_options(
            recipe, options, choices[best], subjects, collisions, question=question
        )


def sample_variations(
    scene: Scene, stop: int, intervention: Intervention, rng: np.random.Generator
) -> Iterator[Branch]:
    """Yield the unchanged continuation of a scene, then variations of its own future, which are
    other outcomes of its next collision, and of the changed future, in which the objects that move
    have other velocities."""
    pair = next_collision(scene, stop).objects
    outcomes = sample_outcomes(scene, stop, pair, rng)
    yield from (branch for source, branch in outcomes if source != GHOST)
    states = intervention.branch.states
    speeds = np.linalg.norm(states[:, 7:9], axis=-1)
    varied = np.repeat(states[None], VARIATIONS, axis=0)
    for k in np.flatnonzero(speeds > MOVING):
        factors = np.exp(MAX_LOG_FACTOR * (rng.uniform(size=VARIATIONS) - rng.uniform()))
        angles = DIRECTIONS * (rng.uniform(size=VARIATIONS) - rng.uniform())
        for own, factor, angle in zip(varied, factors, angles, strict=True):
            own[k, 7:] = factor * turn_velocity(own[k, 7:], angle)
    yield from (replace(intervention.branch, states=own) for own in varied)


def without_object(motion: Motion, index: int, world: WorldConfig) -> Motion:
    """Return a motion in which an object vanishes after the first frame."""
    states = np.concatenate([motion.states[:1], move_away(motion.states[1:], index, world)])
    return replace(motion, states=states)


def join_collisions(scene: Scene, stop: int, motion: Motion) -> tuple[Collision, ...]:
    """Return the contacts of a scene up to frame `stop`, and those of its continuation from there.
    A contact that goes on at `stop` is one contact."""
    touching = {pair: [stop + f for f in frames] for pair, frames in motion.touching.items()}
    for contact in scene.collisions:
        if contact.frame <= stop:
            frames = range(contact.frame, min(contact.end, stop) + 1)
            touching[contact.objects] = [*frames, *touching.get(contact.objects, ())]
    return group_contacts(touching, scene.fps)


def make_intervention_pair(
    item: SelectionItem, scene: Scene
) -> tuple[SelectionItem, SelectionItem]:
    """Return the items of a pair, given the one about the scene's own future: this one, and the one
    about the changed future."""
    key = pair_key(item)
    own = replace(item, item_id=f"{INTERVENTIONS}-actual-{item.subtype}-{key}")
    answer = [c.source for c in item.candidates].index(INTERVENTION)
    changed_scene = item.candidates[answer].scene_id
    changed = int(changed_scene.partition(f"{ALTERNATIVE}{item.subtype}-")[2].split("-")[0])
    pair = next_collision(scene, item.prefix_stop).objects
    other = next(k for k in pair if k != changed)
    names = [scene.objects[k].noun_phrase for k in (changed, other)]
    question = QUESTION.format(CHANGES[item.subtype].format(*names))
    if item.question != EVENT_QUESTION:
        question = UNSEEN.format(names[0]) + question
    exchanged = {"target": "actual", INTERVENTION: "target"}
    candidates = [replace(c, source=exchanged.get(c.source, c.source)) for c in item.candidates]
    return own, replace(
        own,
        item_id=f"{INTERVENTIONS}-changed-{item.subtype}-{key}",
        question=question,
        framing=INTERVENTION,
        answer=answer,
        candidates=tuple(candidates),
    )
