"""What the pickers of simulated distractors share.

The candidates of an item are chosen among frames of the scene itself and of other motions that are
simulated from the end of the prefix on. No score without prediction must reveal the target
(`data.items.scores`). The motions of chosen candidates are saved as scenes.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from dynapix.conf.schema import WorldConfig
from dynapix.data.items.futures.simulation import (
    alternative_scene,
    scene_states,
    scene_with_states,
)
from dynapix.data.items.pickers import DistractorPicker, Recipe, Timing, new_item
from dynapix.data.items.scores import CandidateFrames, render_small
from dynapix.data.oracle.displacement import frame_displacements
from dynapix.data.records import Candidate, Collision, Scene, SelectionItem
from dynapix.data.sim.physics import Motion
from dynapix.data.store import save_scene, scene_path

TRIES = 3
"""Number of timings of a scene at which futures are simulated in one cell."""


@dataclass(frozen=True)
class Options:
    """The O candidates from which the four of an item are chosen.

    Attributes:
        motions: Motions from the end of the prefix on, by the scene ids of the candidates.
    """

    scene: Scene
    timing: Timing
    candidates: Sequence[Candidate]
    motions: Mapping[str, Motion]
    world: WorldConfig

    @cached_property
    def frames(self) -> Scene:
        """A scene of 1 + O frames: the last observed one, and those of the candidates."""
        stop = self.timing.stop
        shown = [self.motions[c.scene_id].states[c.frame - stop] for c in self.candidates]
        states = np.stack([scene_states(self.scene)[stop], *shown])
        return scene_with_states(self.scene, "futures", states, self.world)

    def displacement(self, subjects: tuple[int, ...] | None = None) -> np.ndarray:
        """Return the displacement of an object of `subjects` (all by default) between any two
        candidates, (O, O) px at 336 x 336."""
        return frame_displacements(self.frames, subjects)[1:, 1:]

    def scores(self, choices: np.ndarray, further: Sequence[np.ndarray] = ()) -> np.ndarray:
        """Return the scores (S, T, 4) of choices (T, 4) of candidates. `further` are more scores of
        each of the `frames`, (1 + O,)."""
        moments = [self.timing.stop, *(candidate.frame for candidate in self.candidates)]
        shown = [(self.frames, k) for k in range(len(moments))]
        images = render_small(self.frames, range(len(moments)), {"world": asdict(self.world)})
        return CandidateFrames.compare(shown, moments, images, further).scores(1 + choices)


@dataclass(kw_only=True)
class FuturesPicker(DistractorPicker):
    """Makes the items of one cell and one split from simulated futures. It uses the timings and the
    subjects of a recipe, but not its distractors.

    Attributes:
        folder: The store or partial build in which alternative futures are saved.
    """

    world: WorldConfig
    folder: Path
    _tries: Counter[str] = field(default_factory=Counter)

    def make_item(
        self, recipe: Recipe, scene: Scene, timing: Timing, subjects: tuple[int, ...]
    ) -> SelectionItem | None:
        self._tries[scene.scene_id] += 1
        if self._tries[scene.scene_id] > TRIES:
            return None
        made = self._make_from_futures(recipe, scene, timing, subjects)
        if isinstance(made, SelectionItem):
            return made
        self.dropped[made] += 1
        return None

    def _make_from_futures(
        self, recipe: Recipe, scene: Scene, timing: Timing, subjects: tuple[int, ...]
    ) -> SelectionItem | str:
        """Make an item from new futures, or return why no choice of them is suitable."""
        raise NotImplementedError

    def _make_from_options(
        self,
        recipe: Recipe,
        options: Options,
        choice: np.ndarray,
        subjects: tuple[int, ...] | None = None,
        collisions: Mapping[str, tuple[Collision, ...]] = {},
        **fields: Any,
    ) -> SelectionItem:
        """Save the futures of four chosen candidates (4,) of `options`, and return their item.

        Args:
            subjects: The objects whose displacement counts for the minimum; all by default.
            collisions: The contacts in the futures by scene id, if they are recorded.
            fields: Fields of the item that replace those of the recipe.
        """
        scene, timing = options.scene, options.timing
        candidates = [options.candidates[k] for k in choice]
        for name in {c.scene_id for c in candidates} - {scene.scene_id}:
            states = options.motions[name].states
            future = alternative_scene(scene, name, timing.stop, states, self.world)
            future = replace(future, collisions=collisions.get(name, ()))
            save_scene(future, scene_path(self.folder, name))
        pairs = options.displacement(subjects)[np.ix_(choice, choice)]
        least = float(pairs[np.triu_indices(4, 1)].min())
        return new_item(recipe, scene, timing, candidates, least, **fields)


def distinct_choices(choices: np.ndarray, displacement: np.ndarray, least: float) -> np.ndarray:
    """Return the choices (T, 4) of candidates that all differ by at least `least` px."""
    pairs = displacement[choices[:, :, None], choices[:, None, :]]
    pairs[:, np.arange(4), np.arange(4)] = np.inf
    return choices[pairs.min(axis=(1, 2)) >= least]
