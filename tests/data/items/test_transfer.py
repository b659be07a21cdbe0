"""Selection items of transfer suites: the frames of the prefix, the target and the distractors."""

from __future__ import annotations

import pickle
from collections import Counter
from dataclasses import replace

import numpy as np
import pytest

from dynapix.conf.schema import Quota
from dynapix.data.items.pickers import CellInputs, fill_quota
from dynapix.data.items.recipes import EVENT_QUESTION, TIME_QUESTION
from dynapix.data.items.transfer import CELLS as TRANSFER_CELLS
from dynapix.data.items.transfer import make_transfer_recipe
from dynapix.data.oracle.events import find_motion_onsets
from dynapix.data.records import Collision, Landing, Scene, SceneObject, SelectionItem
from dynapix.data.sources.validation import RecordError

MIN_DISPLACEMENT = 12.0
SCENARIOS = ("Collide", "Drop", "Roll")


def scene_of_suite(suite: str, k: int, frames: int, fps: float) -> Scene:
    """Two objects, of which the second rests until the first hits it at a random frame.

    In some scenes the hit is too early for a prefix. The appearances of the objects alternate
    between two sets from one scene to the next.
    """
    rng = np.random.default_rng(k)
    hit = int(rng.integers(12, 22) if suite.endswith("movi_a") else rng.integers(11, frames - 20))
    t = np.arange(frames)
    pushed = np.maximum(t - hit + 1, 0) * 3.0
    height = rng.uniform(40, 300)
    image = np.stack(
        [
            np.stack([20 + 6.0 * t, height + 0 * t], 1) * [24 / frames, 1],
            np.stack([90 + pushed, height + 0 * t], 1),
        ],
        axis=1,
    )
    scenario = SCENARIOS[k % 3] if suite.endswith("physion") else ""
    return Scene(
        scene_id=f"{suite}-{k:03d}",
        split="test",
        objects=(SceneObject("bowl", "", "red"), SceneObject("cone", "", "blue" * (k % 2))),
        collisions=(Collision(hit, (0, 1), hit),),
        landings=(Landing(hit + 5, 1),),
        positions=np.concatenate([image / 50, np.zeros((frames, 2, 1))], axis=2),
        quaternions=np.tile([0.0, 0, 0, 1], (frames, 2, 1)),
        velocities=np.zeros((frames, 2, 3)),
        angular_velocities=np.zeros((frames, 2, 3)),
        image_positions=image,
        in_view=np.ones((frames, 2), bool),
        visible_fraction=np.full((frames, 2), np.nan),
        image_size=(480, 336),
        fps=fps,
        scenario=scenario,
        footage=f"{k}",
    )


SCENES = {
    suite: {scene.scene_id: scene for scene in (scene_of_suite(suite, k, *clip) for k in range(40))}
    for name, clip in (("movi_a", (24, 12)), ("physion", (120, 30)))
    for suite in (name, f"standin_{name}")
}


def items_of(
    suite: str, family: str, subtype: str, scenes: dict[str, Scene]
) -> list[SelectionItem]:
    scene_ids = {"train": [], "test": list(scenes)}
    cell = CellInputs(
        scene_ids, scenes.__getitem__, Quota(0, 24), seed=0, min_displacement=MIN_DISPLACEMENT
    )
    recipe = make_transfer_recipe(suite.removeprefix("standin_"), suite, family, subtype)
    return fill_quota(subtype, recipe, cell)[0]


CELLS = [
    (suite, family, subtype)
    for name, families in TRANSFER_CELLS.items()
    for suite in (name, f"standin_{name}")
    for family, subtypes in families.items()
    for subtype in subtypes
]


def cells(*words: str) -> pytest.MarkDecorator:
    """Parametrize a test by the cells whose suite, family and subtype include all `words`. The
    fixtures `suite` and `items` depend on the cell."""
    chosen = [c for c in CELLS if set(words) <= set(c)]
    return pytest.mark.parametrize("cell", chosen, ids="/".join)


@pytest.fixture
def suite(cell: tuple[str, str, str]) -> str:
    return cell[0]


@pytest.fixture
def items(cell: tuple[str, str, str]) -> list[SelectionItem]:
    return items_of(*cell, SCENES[cell[0]])


@cells()
def test_items_have_their_suite_and_the_questions_of_dynapix(suite: str, items: list) -> None:
    assert len(items) == 24
    assert {i.suite for i in items} == {suite}
    (question,) = {i.question for i in items}
    (subtype,) = {i.subtype for i in items}
    timed = {"in_1s": TIME_QUESTION.format("1 second"), "in_2s": TIME_QUESTION.format("2 seconds")}
    assert question == timed.get(subtype, EVENT_QUESTION)
    assert max(Counter(i.answer for i in items).values()) == 6


@cells()
def test_distractors_are_of_the_scene_and_of_other_scenes(suite: str, items: list) -> None:
    for item in items:
        wrong = [c for c in item.candidates if c.source != "target"]
        others = [c for c in wrong if c.scene_id != item.scene_id]
        assert [c.source for c in wrong].count("cross_scene") == len(others)
        assert len({c.scene_id for c in others}) == len(others)
        assert len(others) == (2 if suite.endswith("movi_a") else 1)
        own = [c.frame for c in item.candidates if c.scene_id == item.scene_id]
        assert min(own) > item.prefix_stop
        assert item.min_displacement >= MIN_DISPLACEMENT
        if suite.endswith("physion"):
            assert min(own) == item.target_frame
            scenarios = {SCENES[suite][c.scene_id].scenario for c in item.candidates}
            assert scenarios == {SCENES[suite][item.scene_id].scenario}


@cells("event")
def test_an_event_items_prefix_ends_before_its_event(suite: str, items: list) -> None:
    gap, step = 10, 20
    events_of = {
        "contact": lambda s: [c.frame for c in s.collisions],
        "motion": lambda s: [frame for frame, _ in find_motion_onsets(s)],
        "landing": lambda s: [landing.frame for landing in s.landings],
    }
    for item in items:
        events = events_of[item.subtype.rpartition("_")[2]]
        assert item.target_frame == item.event_frame
        assert item.event_frame in events(SCENES[suite][item.scene_id])
        assert (item.framing, item.gap) == ("future", gap)
        assert item.event_frame - item.prefix_stop == gap
        assert item.prefix_start == max(item.prefix_stop - step, 0)
        assert item.prefix_stop - item.prefix_start + 1 >= 5
        for other in (c for c in item.candidates if c.source == "cross_scene"):
            assert other.frame in events(SCENES[suite][other.scene_id])


@cells("time")
def test_a_time_item_has_the_frame_rate_of_its_scene(suite: str, items: list) -> None:
    second = 12 if suite.endswith("movi_a") else 30
    for item in items:
        seconds = int(item.subtype[3])
        assert (item.prefix_start, item.prefix_stop) == (0, second - 1)
        last = SCENES[suite][item.scene_id].frames - 1
        assert item.target_frame == min(second * (1 + seconds), last)
        assert item.target_frame - item.prefix_stop == item.horizon
        assert {c.frame for c in item.candidates if c.scene_id != item.scene_id} == {
            item.target_frame
        }


def test_the_frame_rate_changes_time_items_and_not_event_items() -> None:
    fast = {k: scene_of_suite("physion", k, 120, 100) for k in range(30)}
    scenes = {s.scene_id: s for s in fast.values()}
    assert items_of("physion", "time", "in_1s", scenes) == []
    assert {i.gap for i in items_of("physion", "event", "A1_contact", scenes)} == {10}


def test_scenes_without_motion_give_no_item() -> None:
    still = {
        name: replace(scene, image_positions=np.tile(scene.image_positions[:1], (120, 1, 1)))
        for name, scene in SCENES["physion"].items()
    }
    assert items_of("physion", "event", "A1_contact", still) == []


def test_record_errors_keep_their_code_in_another_process() -> None:
    error = pickle.loads(pickle.dumps(RecordError("a file: difference", "damaged-file")))
    assert isinstance(error, RecordError)
    assert (str(error), error.code) == ("a file: difference", "damaged-file")
