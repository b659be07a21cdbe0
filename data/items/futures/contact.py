"""Makes selection items that only contact physics solves: distractors are other outcomes of one
collision.

The prefix ends shortly before a collision, and the candidates show the same moment after it. In the
distractors, one thing about the collision differs. `ghost`: the two objects pass through each
other, as constant velocity predicts. `mass`: one of the two has another mass. `bounce`: all objects
have another restitution. `aim`: the faster object comes from a slightly different direction.

The true outcome is one more sample of the distribution of the others, and the scores that involve
no contact physics do not reveal it (`data.items.scores`). The ghost cannot be the target. It stands
in a share of the items (`GHOST_SHARE`), whose targets are balanced among the other three
candidates. In most items, it would make exclusion pay; if the items without it compensated for
that, its absence would be a clue.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from itertools import combinations

import numpy as np

from dynapix.data.items.futures.options import FuturesPicker, Options, distinct_choices
from dynapix.data.items.futures.simulation import (
    own_motion,
    scene_states,
    simulate_futures,
    turn_velocity,
)
from dynapix.data.items.pickers import Recipe, Timing
from dynapix.data.items.recipes import EVENT_QUESTION
from dynapix.data.items.scores import COLLISION_SCORES, SCORES, Balance, collision_scores
from dynapix.data.oracle.displacement import visible_positions
from dynapix.data.oracle.events import collisions_in, next_collision, touching_pairs
from dynapix.data.records import ALTERNATIVE, CONTACT, GHOST, Candidate, Scene, SelectionItem
from dynapix.data.sim.camera import Camera
from dynapix.data.sim.physics import Branch, Motion

CELLS = {"collision_gap10": 10, "collision_gap16": 16, "collision_gap26": 26}
"""Frames from the collision to the target, by subtype."""
OBSERVED = 21
"""Number of frames of a prefix, as in the other event items."""
LEAD = 3
"""Number of frames from the end of the prefix to the collision."""
MASSES, BOUNCES, AIMS = 8, 2, 6
"""Numbers of outcomes with another mass, restitution and direction from which the distractors of an
item are chosen."""
LOG_MASSES = np.log(16.0)
"""Logarithm of the ratio between the largest and the smallest mass."""
MAX_BOUNCE = 1.4
"""Maximum factor of the restitution."""
DIRECTIONS = np.radians(50)
"""Range of the directions of the faster object."""
GHOST_SHARE = 0.25
"""Share of the items in which the ghost is a distractor."""
STRAY = 1 / 3
"""Maximum displacement between the recorded target and its simulation from the end of the prefix,
as a share of the minimum displacement between candidates."""
NO_COLLISION = "no collision after a prefix"
"""Why there is no item in a scene without timings."""
APART = 0.95
"""Minimum distance of the objects of a ghost, as a share of the sum of their radii."""


def make_contact_recipe(subtype: str) -> Recipe:
    """Return the recipe of a cell of contact items."""
    gap = CELLS[subtype]
    fields = {
        "subtype": subtype, "question": EVENT_QUESTION, "framing": "future", "distractors": CONTACT,
        "gap": LEAD + gap,
    }  # fmt: skip
    timings = partial(collision_timings, gap)
    return Recipe("event", timings, lambda timing: fields, lambda *_: [], lacks=NO_COLLISION)


def collision_timings(gap: int, scene: Scene) -> list[Timing]:
    """Return the timings whose prefix ends `LEAD` frames before the next collision, of two objects
    that are then visible and apart, with no other contact that begins up to the same frame."""
    visible, found = visible_positions(scene)[1], []
    for collision in scene.collisions:
        stop, target = collision.frame - LEAD, collision.frame + gap
        if stop - OBSERVED + 1 < 0 or target >= scene.frames:
            continue
        is_alone = collisions_in(scene, stop + 1, collision.frame) == [collision]
        is_apart = collision.objects not in touching_pairs(scene, stop, stop)
        if is_alone and is_apart and visible[stop, list(collision.objects)].all():
            found.append(Timing(stop - OBSERVED + 1, stop, target, collision.frame))
    return found


@dataclass(kw_only=True)
class ContactPicker(FuturesPicker):
    """Makes the contact items of one cell and one split."""

    def __post_init__(self) -> None:
        names = (*SCORES, *COLLISION_SCORES)
        self.balances = {with_ghost: Balance(self.rng, names) for with_ghost in (False, True)}

    def _make_from_futures(
        self, recipe: Recipe, scene: Scene, timing: Timing, subjects: tuple[int, ...]
    ) -> SelectionItem | str:
        stop, target, least = timing.stop, timing.target, self.inputs.min_displacement
        pair = next_collision(scene, stop).objects
        sources, branches = zip(*sample_outcomes(scene, stop, pair, self.rng), strict=True)
        outcomes = simulate_futures(scene, stop, target, branches, self.world)
        name = f"{scene.scene_id}{ALTERNATIVE}{recipe.fields(timing)['subtype']}-{stop}"
        motions = {scene.scene_id: own_motion(scene, stop, target)}
        motions |= {f"{name}-{k}": outcome for k, outcome in enumerate(outcomes)}
        # The scene's own outcome, then the same one simulated again, and the others.
        named = zip(motions, ["target", *sources], strict=True)
        candidates = [Candidate(own, target, source) for own, source in named]
        options = Options(scene, timing, candidates, motions, self.world)
        displacement = options.displacement(subjects)
        if displacement[0, 1] > STRAY * least:
            return "target cannot be simulated again"
        suitable = [
            k
            for k, each in enumerate(candidates)
            if k > 1 and is_suitable(each.source, pair, motions[each.scene_id], scene.object_radii)
        ]
        with_ghost = self._wants_ghost()
        choices = [
            (0, *chosen)
            for chosen in combinations(suitable, 3)
            # The ghost is the last outcome.
            if (candidates[chosen[-1]].source == GHOST) == with_ghost
        ]
        choices = distinct_choices(np.array(choices, int).reshape(-1, 4), displacement, least)
        if not len(choices):
            return "too few suitable outcomes"
        shown = [(options.frames, k) for k in range(options.frames.frames)]
        camera = Camera.from_settings(self.world.camera)
        scores = options.scores(choices, [*collision_scores(scene, stop, target, shown, camera)])
        best = self.balances[with_ghost].choose(scores, eligible_candidates(with_ghost))
        if best is None:
            return "refused by the balance"
        return self._make_from_options(recipe, options, choices[best])

    def _wants_ghost(self) -> bool:
        """Return whether the next item should have the ghost, to keep its share."""
        ghosts, others = self.balances[True].items, self.balances[False].items
        return ghosts < GHOST_SHARE * (ghosts + others + 1)


def sample_outcomes(
    scene: Scene, stop: int, pair: tuple[int, int], rng: np.random.Generator
) -> Iterator[tuple[str, Branch]]:
    """Sample outcomes of the collision of a pair after frame `stop`, each with what differs in it:
    the true outcome first, and the ghost last.

    As in `sample_velocities`, masses and directions are drawn around a random centre, so that the
    true ones are no more central than the others.
    """
    states = scene_states(scene)[stop].astype(float)
    yield "target", Branch(states)
    changed = int(rng.choice(pair))
    for change in LOG_MASSES * (rng.uniform(size=MASSES) - rng.uniform()):
        masses = np.where(np.arange(len(states)) == changed, np.exp(change), 1.0)
        yield "mass", Branch(states, masses=masses.tolist())
    for factor in rng.uniform(0, MAX_BOUNCE, BOUNCES):
        yield "bounce", Branch(states, restitution=float(factor))
    striker = max(pair, key=lambda k: np.linalg.norm(states[k, 7:9]))
    for angle in DIRECTIONS * (rng.uniform(size=AIMS) - rng.uniform()):
        aimed = states.copy()
        aimed[striker, 7:] = turn_velocity(states[striker, 7:], angle)
        yield "aim", Branch(aimed)
    yield GHOST, Branch(states, passing=pair)


def is_suitable(source: str, pair: tuple[int, int], motion: Motion, radii: Sequence[float]) -> bool:
    """Return whether an outcome is plausible: the two objects of the collision touch, or have
    passed through each other."""
    if source != GHOST:
        return pair in motion.touching
    one, other = motion.positions[-1, list(pair)]
    return bool(np.linalg.norm(one - other) > APART * sum(radii[k] for k in pair))


def eligible_candidates(with_ghost: bool) -> tuple[int, ...]:
    """Return which of four candidates, the target first and the ghost last, could be the target as
    far as their kind tells."""
    return (0, 1, 2) if with_ghost else (0, 1, 2, 3)


def order_candidates(item: SelectionItem) -> list[int]:
    """Return the indices of an item's candidates, the target first and the ghost last."""
    return sorted(range(4), key=lambda k: (k != item.answer, item.candidates[k].source == GHOST))


def has_ghost(item: SelectionItem) -> bool:
    """Return whether the ghost is a distractor of an item."""
    return any(candidate.source == GHOST for candidate in item.candidates)


def share_of_quota(quota: int, with_ghost: bool) -> int:
    """Return how many items of a quota have the ghost, or do not have it."""
    with_it = round(GHOST_SHARE * quota)
    return with_it if with_ghost else quota - with_it
