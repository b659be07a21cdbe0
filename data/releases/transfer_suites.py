"""Selection items of the transfer suites, which test students on scenes of MoVi-A and Physion.

A suite is a set of items that are built in the same way. The transfer suites have the questions of
the suite `dynapix`. Items from CLEVRER's scenes belong to the suite `dynapix`.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass
from itertools import islice
from typing import TYPE_CHECKING

import numpy as np

from data.records import Candidate, Scene, SelectionItem
from data.tracks.selection import event_items, time_items
from data.tracks.selection.distractors import DistractorPicker, Family, Timing, scene_candidates
from data.world.events import find_motion_onsets

if TYPE_CHECKING:
    from conf.schema import BenchmarkConfig

STANDIN = "standin_"
"""Start of the names of the suites whose scenes are simulated instead of read from a release."""
MIN_PREFIX_FRAMES = 5
"""Minimum number of frames in a prefix, for prefixes that are cut at the start of the scene."""
CROSS_SCENES = 8
"""Number of other scenes to sample for cross-scene distractors."""


@dataclass(frozen=True)
class EventCell:
    """A cell whose target is the frame of an event.

    `kind` is a key of `EVENTS`. The prefix ends `gap` frames before the event, and its first frame
    is `span` frames before its last frame.
    """

    kind: str
    span: int
    gap: int
    question = event_items.QUESTION

    def timings(self, scene: Scene) -> list[Timing]:
        stops = [frame - self.gap for frame in sorted(set(EVENTS[self.kind](scene)))]
        return [
            Timing(max(stop - self.span, 0), stop, stop + self.gap, event=stop + self.gap)
            for stop in stops
            if stop + 1 >= MIN_PREFIX_FRAMES
        ]


@dataclass(frozen=True)
class TimeCell:
    """A cell whose prefix is the scene's first second. The target is `seconds` after the prefix."""

    seconds: int

    @property
    def question(self) -> str:
        return time_items.question(self.seconds)

    def timings(self, scene: Scene) -> list[Timing]:
        # As in the suite `dynapix`, the target is the first frame after the stated seconds; a scene
        # of MoVi-A ends one frame earlier.
        second = round(scene.fps)
        target = min(second * (1 + self.seconds), scene.frames - 1)
        is_long_enough = scene.frames >= second * (1 + self.seconds)
        return [Timing(0, second - 1, target)] if is_long_enough else []


def transfer_family(
    suite: str,
    name: str,
    cells: Mapping[str, EventCell | TimeCell],
    same_scene: int,
    after_target: bool,
) -> Family:
    """Return one family of a transfer suite.

    Args:
        cells: Cells of the family by subtype.
        same_scene: Number of distractors from the item's own scene, all from after the prefix. The
            other distractors are targets from other scenes of the same scenario.
        after_target: Whether distractors from the item's own scene must also come after the target.
    """

    def make_item(
        subtype: str,
        scene: Scene,
        timing: Timing,
        rng: np.random.Generator,
        picker: DistractorPicker,
    ) -> SelectionItem | None:
        cell = cells[subtype]
        frames = np.arange((timing.target if after_target else timing.stop) + 1, scene.frames)
        wrong = rng.permutation(frames[frames != timing.target])
        gap = timing.target - timing.stop
        axes = {"framing": "future", "gap": gap} if timing.event is not None else {"horizon": gap}
        return picker.make_item(
            scene,
            timing,
            lambda: [
                (scene_candidates(scene, wrong, "same_time"), same_scene),
                (cross_scene_candidates(cell, scene, rng, picker), 3 - same_scene),
            ],
            family=name,
            subtype=subtype,
            suite=suite,
            question=cell.question,
            distractors="mixed",
            **axes,
        )

    return Family(cells, lambda subtype, scene: cells[subtype].timings(scene), make_item)


def cross_scene_candidates(
    cell: EventCell | TimeCell, scene: Scene, rng: np.random.Generator, picker: DistractorPicker
) -> Iterator[Candidate]:
    """Yield the first target of up to `CROSS_SCENES` other scenes of the same scenario.

    Scenes that share more objects with `scene` come first.
    """
    # The generators are lazy: no more scenes are loaded than needed.
    scenes = (picker.scene_of(str(name)) for name in rng.permutation(picker.scene_ids))
    similar = (s for s in scenes if s.scene_id != scene.scene_id and s.scenario == scene.scenario)
    targets = ((s, timings[0].target) for s in similar if (timings := cell.timings(s)))
    objects = set(scene.objects)
    sample = list(islice(targets, CROSS_SCENES))
    for other, target in sorted(sample, key=lambda pair: -len(objects & set(pair[0].objects))):
        yield Candidate(other.scene_id, target, "cross_scene")


def suite_name(cfg: BenchmarkConfig) -> str:
    """Return the name of the set of items: `dynapix`, a transfer suite, or a stand-in for one,
    whose scenes are simulated."""
    recipe = cfg.item_recipe
    is_standin = recipe in CELLS and cfg.simulator not in CELLS
    return f"{STANDIN}{recipe}" if is_standin else recipe


EVENTS: dict[str, Callable[[Scene], list[int]]] = {
    "contact": lambda scene: [collision.frame for collision in scene.collisions],
    "motion": lambda scene: [frame for frame, _ in find_motion_onsets(scene)],
    "landing": lambda scene: [landing.frame for landing in scene.landings],
}
"""Functions that return the frames of a scene's events, by kind of event."""


CELLS = {
    # Spans and gaps are the paper's numbers of frames at every frame rate. A scene of MoVi-A lasts
    # two seconds, so there is no in_2s.
    "movi_a": {
        "event": {"contact": EventCell("contact", span=20, gap=10)},
        "time": {"in_1s": TimeCell(1)},
    },
    "physion": {
        "event": {
            "A1_contact": EventCell("contact", span=20, gap=10),
            "A2_motion": EventCell("motion", span=20, gap=10),
            "A3_landing": EventCell("landing", span=20, gap=10),
        },
        "time": {"in_1s": TimeCell(1), "in_2s": TimeCell(2)},
    },
}
# Items of a stand-in are built like those of the suite that it imitates, under a name of their own.
TRANSFER_SUITES = {
    f"{prefix}{suite}": {
        family: transfer_family(
            f"{prefix}{suite}",
            family,
            cells,
            same_scene=1 if suite == "movi_a" else 2,
            after_target=suite == "physion",
        )
        for family, cells in families.items()
    }
    for prefix in ("", STANDIN)
    for suite, families in CELLS.items()
}
