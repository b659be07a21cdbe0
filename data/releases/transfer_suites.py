"""How items of the transfer suites are made, for scenes of MoVi-A and Physion.

`TRANSFER_SUITES[suite][family]` offers what a module of `data.tracks.selection` does: `CELLS` and
`make_item`. The questions are the same. An event item's prefix ends some frames before the
event, whose frame is the target; a time item's prefix is the scene's first second, and its target
is so many seconds after the prefix's last frame. CLEVRER's scenes take the recipes of
`data.tracks.selection` themselves.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from itertools import islice

import numpy as np

from data.records import Candidate, FrameRef, Scene, SelectionItem
from data.tracks.selection import event, time
from data.tracks.selection.distractors import DistractorPicker, new_item, scene_candidates
from data.tracks.selection.event import EventTiming
from data.world.events import find_motion_onsets

MOVI_A_STEP, MOVI_A_GAP = 10, 5
"""Frames from an event item's prefix's start to its end, and on to the event: at 12 fps nearly the
times that the dynapix suite has at 25."""
PHYSION_STEP, PHYSION_GAP = 20, 10
"""The same in Physion, whatever its frame rate."""
LEAST_PREFIX = 5
"""Frames that a prefix has at least, where the scene's beginning cuts it short."""
ELSEWHERE = 8
"""Other scenes looked at for cross-scene distractors."""


@dataclass(frozen=True)
class Cell:
    question: str
    moments: Callable[[Scene], list[EventTiming]]
    """The moments of a scene that the cell can ask about, in order of time."""


@dataclass(frozen=True)
class Recipe:
    """A family of a suite's items.

    Of the three distractors `same` are other moments of the scene that the prefix does not show (if
    `later`, only such as follow the target); the rest are other scenes of its scenario, at such a
    moment of their own.
    """

    suite: str
    family: str
    same: int
    later: bool
    CELLS: dict[str, Cell]

    def make_item(
        self, subtype: str, scene: Scene, rng: np.random.Generator, picker: DistractorPicker
    ) -> SelectionItem | None:
        """An item of the cell at one of the scene's moments, tried in a random order."""
        cell = self.CELLS[subtype]
        found = cell.moments(scene)
        for k in rng.permutation(len(found)):
            moment = found[k]
            unseen = np.arange((moment.target if self.later else moment.stop) + 1, scene.frames)
            wrong = rng.permutation(unseen[unseen != moment.target])
            picked = picker.pick_each(
                FrameRef(scene.scene_id, moment.target),
                (scene_candidates(scene, wrong, "same_time"), self.same),
                (elsewhere(cell, scene, rng, picker), 3 - self.same),
            )
            if picked is None:
                continue
            gap = moment.target - moment.stop
            axes = (
                {"event_frame": moment.event, "framing": "future", "gap": gap}
                if self.family == "event"
                else {"horizon": gap}
            )
            return new_item(
                scene,
                self.family,
                subtype,
                cell.question,
                (moment.start, moment.stop),
                moment.target,
                picked,
                suite=self.suite,
                distractors="mixed",
                **axes,
            )
        return None


def elsewhere(
    cell: Cell, scene: Scene, rng: np.random.Generator, picker: DistractorPicker
) -> Iterator[Candidate]:
    """The first such moment of some other scenes of the scenario, those that share most of the
    scene's looks first."""
    # Read one after the other until there are enough: a scenario is a small part of all scenes.
    drawn = (picker.scene_of(str(name)) for name in rng.permutation(picker.scene_ids))
    kin = (s for s in drawn if s.scene_id != scene.scene_id and s.scenario == scene.scenario)
    such = islice(((other, m[0]) for other in kin if (m := cell.moments(other))), ELSEWHERE)
    looks = set(scene.objects)
    for other, there in sorted(such, key=lambda pair: -len(looks & set(pair[0].objects))):
        yield Candidate(other.scene_id, there.target, "cross_scene")


def around(events: Callable[[Scene], list[int]], step: int, gap: int) -> Cell:
    """Asks for the frame of an event, `gap` frames after a prefix of `step` frames and one."""

    def moments(scene: Scene) -> list[EventTiming]:
        found = []
        for frame in sorted(set(events(scene))):
            stop = frame - gap
            start = max(stop - step, 0)
            if stop - start + 1 >= LEAST_PREFIX:
                found.append(EventTiming(frame, start, stop, frame))
        return found

    return Cell(event.QUESTION, moments)


def ahead(seconds: int) -> Cell:
    """Asks for the frame so many seconds after the scene's first."""

    def moments(scene: Scene) -> list[EventTiming]:
        second = round(scene.fps)
        target = second - 1 + second * seconds
        return [EventTiming(target, 0, second - 1, target)] if target < scene.frames else []

    return Cell(time.question(seconds), moments)


def contacts(scene: Scene) -> list[int]:
    """Frames at which two objects first touch."""
    return [c.frame for c in scene.collisions]


def motions(scene: Scene) -> list[int]:
    """Frames at which an object at rest is set in motion."""
    return [frame for frame, _ in find_motion_onsets(scene)]


def landings(scene: Scene) -> list[int]:
    """Frames at which an object comes down on the ground."""
    return [landing.frame for landing in scene.landings]


MOVI_A_EVENTS = {"contact": around(contacts, MOVI_A_STEP, MOVI_A_GAP)}
MOVI_A_TIMES = {"in_1s": ahead(1)}
"""A scene's 24 frames are the first second and one more."""
PHYSION_EVENTS = {
    "A1_contact": around(contacts, PHYSION_STEP, PHYSION_GAP),
    "A2_motion": around(motions, PHYSION_STEP, PHYSION_GAP),
    "A3_landing": around(landings, PHYSION_STEP, PHYSION_GAP),
}
PHYSION_TIMES = {"in_1s": ahead(1), "in_2s": ahead(2)}

TRANSFER_SUITES = {
    "movi_a": {
        "event": Recipe("movi_a", "event", same=1, later=False, CELLS=MOVI_A_EVENTS),
        "time": Recipe("movi_a", "time", same=1, later=False, CELLS=MOVI_A_TIMES),
    },
    "physion": {
        "event": Recipe("physion", "event", same=2, later=True, CELLS=PHYSION_EVENTS),
        "time": Recipe("physion", "time", same=2, later=True, CELLS=PHYSION_TIMES),
    },
}
TRANSFER_SUITES |= {
    f"standin_{suite}": {
        family: replace(recipe, suite=f"standin_{suite}") for family, recipe in by.items()
    }
    for suite, by in TRANSFER_SUITES.items()
}
"""Scenes that stand in for a suite's take its recipe under a name of their own."""
