"""Makes selection items that only a prediction solves: distractors are alternative futures.

The candidates are the target and frames of other futures of the scene
(`data.items.futures.simulation`), chosen so that no score without prediction reveals the target
(`data.items.scores`). In the time family, two candidates show the right moment
and two a wrong one, and two show the scene's own future and two another one.

A subtype keeps the question, prefix and target of its cell. As in the paper's recipe, some subtypes
are hard and some easy (`IS_HARD`): the distractors of hard items are futures near the target, those
of easy items futures far from it.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations

import numpy as np

from dynapix.data.items.futures.options import TRIES, FuturesPicker, Options, distinct_choices
from dynapix.data.items.futures.simulation import (
    Group,
    branches_of_velocities,
    joint_groups,
    moving_objects,
    own_motion,
    sample_velocities,
    simulate_futures,
)
from dynapix.data.items.pickers import Recipe, Timing
from dynapix.data.items.scores import Balance
from dynapix.data.oracle.displacement import frame_displacements
from dynapix.data.records import ALTERNATIVE, Candidate, Scene, SelectionItem

FUTURES = {"event": 10, "time": 12, "window": 12}
"""Number of alternative futures from which the distractors of an item are chosen, by family."""
IS_HARD = {"same_obj_match": True, "same_near": True, "cross_scene": False, "same_far": False}
"""Whether the items of a subtype are hard, by the distractors that it has in the paper's recipe.
Items of other subtypes are neither hard nor easy."""
LARGEST_SHARE = 0.9
"""Maximum time to the earlier of two moments, as a share of the time to the later one."""


@dataclass(kw_only=True)
class BalancedPicker(FuturesPicker):
    """Makes the balanced items of one cell and one split."""

    def __post_init__(self) -> None:
        self.balance = Balance(self.rng)

    def make_item(
        self, recipe: Recipe, scene: Scene, timing: Timing, subjects: tuple[int, ...]
    ) -> SelectionItem | None:
        """As in `FuturesPicker`. Timings at which nothing moves visibly do not count as tries."""
        shift = frame_displacements(scene, subjects)[timing.stop, timing.target]
        if shift < self.inputs.min_displacement or not moving_objects(scene, timing.stop, subjects):
            return None
        return super().make_item(recipe, scene, timing, subjects)

    def _make_from_futures(
        self, recipe: Recipe, scene: Scene, timing: Timing, subjects: tuple[int, ...]
    ) -> SelectionItem | str:
        # A time item has a single timing, but each try has another wrong moment.
        count = TRIES if recipe.family == "time" else 1
        tries = (self._try_futures(recipe, scene, timing, subjects) for _ in range(count))
        return next(filter(None, tries), "no suitable distractors")

    def _try_futures(
        self, recipe: Recipe, scene: Scene, timing: Timing, subjects: tuple[int, ...]
    ) -> SelectionItem | None:
        stop, moments = timing.stop, [timing.target]
        if recipe.family == "time":
            moments += self._wrong_moment(scene, timing, subjects)
            if len(moments) == 1:
                return None
        groups = changed_groups(recipe.family, scene, timing, subjects)
        count, quarter = FUTURES[recipe.family], int(self.balance.excess_of("nearness").argmin())
        velocities = sample_velocities(scene, stop, groups, count, quarter, self.rng)
        branches = branches_of_velocities(scene, stop, velocities)
        motions = simulate_futures(scene, stop, max(moments), branches, self.world)
        fields = recipe.fields(timing)
        name = f"{scene.scene_id}{ALTERNATIVE}{fields['subtype']}-{stop}"
        futures = {f"{name}-{k}": motion for k, motion in enumerate(motions)}
        candidates = [Candidate(scene.scene_id, timing.target)]
        candidates += [Candidate(scene.scene_id, m, "same_time") for m in moments[1:]]
        candidates += [Candidate(own, m, "alternative") for m in moments for own in futures]
        futures[scene.scene_id] = own_motion(scene, stop, max(moments))
        options = Options(scene, timing, candidates, futures, self.world)
        displacement = options.displacement(subjects)
        choices = list_choices(len(moments), count)
        choices = distinct_choices(choices, displacement, self.inputs.min_displacement)
        choices = choices_of_difficulty(choices, displacement, IS_HARD.get(fields["distractors"]))
        if not len(choices):
            return None
        best = self.balance.choose(options.scores(choices))
        if best is None:
            return None
        return self._make_from_options(recipe, options, choices[best], distractors="alternative")

    def _wrong_moment(self, scene: Scene, timing: Timing, subjects: tuple[int, ...]) -> list[int]:
        """Sample a moment after the prefix that differs visibly from the target, on the side of the
        target that balances its rank in time; return an empty list if there is none.

        The time from the prefix to the earlier of the two moments is a random share of the time to
        the later one, from the same range on both sides: otherwise the share would tell which
        moment is right.
        """
        horizon = timing.target - timing.stop
        # The later moment is then in the scene, and the earlier one after the prefix.
        least = max(horizon / (scene.frames - 1 - timing.stop), 1 / horizon)
        share = self.rng.uniform(least, LARGEST_SHARE)
        excess = self.balance.excess_of("moment")
        lead = horizon * share if excess[0] >= excess[3] else horizon / share
        moment = timing.stop + int(lead)
        shift = frame_displacements(scene, subjects)[timing.target, moment]
        return [moment] if shift >= self.inputs.min_displacement else []


def changed_groups(
    family: str, scene: Scene, timing: Timing, subjects: tuple[int, ...]
) -> list[Group]:
    """Return the groups of objects whose velocities are changed to make distractors. Their objects
    move at the end of the prefix.

    In event and window items, objects that collide change by one velocity: otherwise the target
    would often be the only candidate in which objects touch.
    """
    moving = moving_objects(scene, timing.stop, subjects)
    if family == "time":
        return [(k,) for k in moving]
    return joint_groups(scene, timing.stop, timing.target, moving)


def list_choices(moments: int, futures: int) -> np.ndarray:
    """Return all choices (T, 4), the target first, of these options: the scene's own frame at each
    moment, then all futures at the first moment, and at the second. With two moments, a choice has
    the scene's own and one other future, each at both moments."""
    own, others = np.arange(moments), moments + np.arange(moments * futures).reshape(moments, -1)
    if moments == 1:
        return np.array([[*own, *triple] for triple in combinations(others[0], 3)])
    return np.array([[*own, *pair] for pair in others.T])


def choices_of_difficulty(
    choices: np.ndarray, displacement: np.ndarray, is_hard: bool | None
) -> np.ndarray:
    """Return the half of the choices whose distractors are nearer to the target if they should be
    hard, the other half if they should be easy, and all choices if `is_hard` is None."""
    if is_hard is None or len(choices) < 2:
        return choices
    order = np.argsort(displacement[0, choices[:, 1:]].max(axis=-1), kind="stable")
    half = (len(choices) + 1) // 2
    return choices[np.sort(order[:half] if is_hard else order[-half:])]
