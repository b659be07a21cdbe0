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

from collections import Counter
from collections.abc import Sequence
from dataclasses import asdict, dataclass, field, replace
from itertools import combinations
from pathlib import Path

import numpy as np

from dynapix.conf.schema import WorldConfig
from dynapix.data.items.futures.simulation import (
    Group,
    alternative_scene,
    branches_of_velocities,
    joint_groups,
    moving_objects,
    sample_velocities,
    scene_states,
    scene_with_states,
    simulate_futures,
)
from dynapix.data.items.pickers import DistractorPicker, Recipe, Timing, new_item
from dynapix.data.items.scores import Balance, CandidateFrames, render_small
from dynapix.data.oracle.displacement import frame_displacements
from dynapix.data.records import ALTERNATIVE, Candidate, Collision, Scene, SelectionItem
from dynapix.data.store import save_scene, scene_path

FUTURES = {"event": 10, "time": 12, "window": 12}
"""Number of alternative futures from which the distractors of an item are chosen, by family."""
IS_HARD = {"same_obj_match": True, "same_near": True, "cross_scene": False, "same_far": False}
"""Whether the items of a subtype are hard, by the distractors that it has in the paper's recipe.
Items of other subtypes are neither hard nor easy."""
TRIES = 3
"""Number of times that futures of a scene are simulated in one cell: for different timings or, in
the time family, for different wrong moments of its only timing."""
TARGET = 1
"""Index of the target among the frames from which candidates are chosen."""
LARGEST_SHARE = 0.9
"""Maximum time to the earlier of two moments, as a share of the time to the later one."""


@dataclass(frozen=True)
class FramePool:
    """The frames from which the candidates of an item are chosen.

    Attributes:
        frames: A scene with these frames: the last observed one, the scene's own at each moment
            (first the target), and all futures at the first moment, then at the second.
        moments: The target's moment and, in the time family, a wrong one.
        stop: The moment of the last observed frame.
        futures: Number of futures.
    """

    frames: Scene
    moments: Sequence[int]
    stop: int
    futures: int

    @classmethod
    def collect(
        cls,
        scene: Scene,
        name: str,
        stop: int,
        moments: Sequence[int],
        futures: np.ndarray,
        world: WorldConfig,
    ) -> FramePool:
        """Collect the frames of a scene and of its futures from frame `stop` on (K, F, N, 13)."""
        own = scene_states(scene)[[stop, *moments]]
        others = [futures[:, moment - stop] for moment in moments]
        frames = scene_with_states(scene, name, np.concatenate([own, *others]), world)
        return cls(frames, moments, stop, len(futures))

    @property
    def moments_of_frames(self) -> list[int]:
        return [self.stop, *self.moments, *np.repeat(self.moments, self.futures).tolist()]

    def choices(self) -> np.ndarray:
        """Return all choices of candidates (T, 4) as indices of frames, the target first. With two
        moments, a choice has the scene's own and one other future, each at both moments."""
        first = TARGET + len(self.moments)
        at_target = range(first, first + self.futures)
        if len(self.moments) == 1:
            return np.array([[TARGET, *triple] for triple in combinations(at_target, 3)])
        return np.array([[TARGET, TARGET + 1, k, k + self.futures] for k in at_target])

    def future_of(self, frame: int) -> int | None:
        """Return which future a frame shows; None for the scene's own."""
        first = TARGET + len(self.moments)
        return (frame - first) % self.futures if frame >= first else None


@dataclass(kw_only=True)
class BalancedPicker(DistractorPicker):
    """Makes the balanced items of one cell and one split. It uses the timings and the subjects of
    the paper's recipe, but not its distractors.

    Attributes:
        folder: The store or partial build in which alternative futures are saved.
    """

    world: WorldConfig
    folder: Path
    balance: Balance = field(init=False)
    _tries: Counter[str] = field(default_factory=Counter)

    def __post_init__(self) -> None:
        self.balance = Balance(self.rng)

    def make_item(
        self, recipe: Recipe, scene: Scene, timing: Timing, about: tuple[int, ...]
    ) -> SelectionItem | None:
        groups = self._groups(scene, timing, about, recipe.family)
        if not groups:
            return None
        for _ in range(TRIES if recipe.family == "time" else 1):
            if item := self._try_item(recipe, scene, timing, groups):
                return item
        self.dropped["no suitable distractors"] += 1
        return None

    def _try_item(
        self, recipe: Recipe, scene: Scene, timing: Timing, groups: Sequence[Group]
    ) -> SelectionItem | None:
        """Make an item from new futures, or return None if no choice of them is suitable."""
        family, fields, about = recipe.family, recipe.fields(timing), recipe.subjects(scene, timing)
        moments = [timing.target]
        if family == "time":
            moments += self._wrong_moment(scene, timing, about)
            if len(moments) == 1:
                return None
        count, quarter = FUTURES[family], int(self.balance.excess_of("nearness").argmin())
        velocities = sample_velocities(scene, timing.stop, groups, count, quarter, self.rng)
        branches = branches_of_velocities(scene, timing.stop, velocities)
        motions = simulate_futures(scene, timing.stop, max(moments), branches, self.world)
        futures = np.stack([motion.states for motion in motions])
        name = f"{scene.scene_id}{ALTERNATIVE}{fields['subtype']}-{timing.stop}"
        pool = FramePool.collect(scene, name, timing.stop, moments, futures, self.world)
        displacement = frame_displacements(pool.frames, about)
        choices = distinct_choices(pool.choices(), displacement, self.cell.min_displacement)
        choices = _of_difficulty(choices, displacement, IS_HARD.get(fields["distractors"]))
        if not len(choices):
            return None
        scores = self._compare(pool.frames, pool.moments_of_frames).scores(choices)
        best = self.balance.choose(scores)
        if best is None:
            return None
        chosen = choices[best].tolist()
        candidates = []
        for frame in chosen:
            moment, future = pool.moments_of_frames[frame], pool.future_of(frame)
            if future is None:
                source = "target" if frame == TARGET else "same_time"
                candidates.append(Candidate(scene.scene_id, moment, source))
            else:
                other = f"{name}-{future}"
                self._save(scene, other, timing.stop, futures[future])
                candidates.append(Candidate(other, moment, "alternative"))
        least = least_displacement(pool.frames, chosen)
        return new_item(recipe, scene, timing, candidates, least, distractors="alternative")

    def _compare(
        self, frames: Scene, moments: Sequence[int], further: Sequence[np.ndarray] = ()
    ) -> CandidateFrames:
        """Compare the frames from which candidates are chosen, the last observed one first, given
        their frame indices in time and further scores."""
        states = [(frames, k) for k in range(frames.frames)]
        images = render_small(frames, range(frames.frames), {"world": asdict(self.world)})
        return CandidateFrames.compare(states, moments, images, further)

    def _save(
        self,
        scene: Scene,
        name: str,
        stop: int,
        states: np.ndarray,
        collisions: tuple[Collision, ...] = (),
    ) -> None:
        """Save an alternative future: a scene with the states (F, N, 13) from frame `stop` on."""
        future = alternative_scene(scene, name, stop, states, self.world)
        future = replace(future, collisions=collisions)
        save_scene(future, scene_path(self.folder, name))

    def _groups(
        self, scene: Scene, timing: Timing, about: tuple[int, ...], family: str
    ) -> list[Group]:
        """Return the groups of objects whose velocities may be changed to make distractors.

        Their objects move at the end of the prefix, and visibly until the target. In event and
        window items, objects that collide change by one velocity: otherwise the target would often
        be the only candidate in which objects touch. Return none after `TRIES` timings of a scene.
        """
        shift = frame_displacements(scene, about)[timing.stop, timing.target]
        moving = moving_objects(scene, timing.stop, about)
        if not moving or shift < self.cell.min_displacement:
            return []
        self._tries[scene.scene_id] += 1
        if self._tries[scene.scene_id] > TRIES:
            return []
        if family != "time":
            return joint_groups(scene, timing.stop, timing.target, moving)
        return [(k,) for k in moving]

    def _wrong_moment(self, scene: Scene, timing: Timing, about: tuple[int, ...]) -> list[int]:
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
        shift = frame_displacements(scene, about)[timing.target, moment]
        return [moment] if shift >= self.cell.min_displacement else []


def distinct_choices(choices: np.ndarray, displacement: np.ndarray, least: float) -> np.ndarray:
    """Return the choices (T, 4) of frames that all differ by at least `least` px."""
    pairs = displacement[choices[:, :, None], choices[:, None, :]]
    pairs[:, np.arange(4), np.arange(4)] = np.inf
    return choices[pairs.min(axis=(1, 2)) >= least]


def least_displacement(
    frames: Scene, chosen: Sequence[int], about: tuple[int, ...] | None = None
) -> float:
    """Return the smallest displacement of an object of `about` (all by default) between two of the
    chosen frames, px."""
    pairs = frame_displacements(frames, about)[np.ix_(chosen, chosen)]
    return float(pairs[np.triu_indices(len(chosen), 1)].min())


def _of_difficulty(
    choices: np.ndarray, displacement: np.ndarray, nearest: bool | None
) -> np.ndarray:
    """Return the half of the choices whose distractors are nearer to the target, or the other half;
    all choices if `nearest` is None."""
    if nearest is None or len(choices) < 2:
        return choices
    order = np.argsort(displacement[TARGET, choices[:, 1:]].max(axis=-1), kind="stable")
    half = (len(choices) + 1) // 2
    return choices[np.sort(order[:half] if nearest else order[-half:])]
