"""Laws of the predicates, on scenes that are known in closed form."""

import json

import numpy as np
import pytest

from teacher.numbers import find_numbers
from teacher.predicates import compass, courses, cut_of, facts_of, predicates_of
from tests.teacher import synthetic


def toward(start, pixel, frames):
    """The velocity that takes an object from a ground point to a pixel in so many frames."""
    return (synthetic.on_ground(pixel)[:2] - start) / frames * synthetic.FPS


@pytest.mark.parametrize(
    ("delta", "word"),
    [
        ((0, -5), "north"),
        ((0, 5), "south"),
        ((5, 0), "east"),
        ((-5, 0), "west"),
        ((5, -5), "northeast"),
        ((-5, 5), "southwest"),
        ((0, 0), None),
    ],
)
def test_compass(delta, word):
    assert compass(np.array(delta, dtype=float)) == word


def test_rolling_southwest():
    start = synthetic.on_ground((300, 100))[:2]
    scene = synthetic.scene([start, (0, -1)], [toward(start, (180, 220), 100), (0, 0)])
    moving, still = facts_of(scene, 20, 40, 90).objects
    assert moving.heading == moving.travel == "southwest"
    assert (moving.region, moving.extent) == ("near the center", "moves across")
    assert (still.speed, still.heading, still.extent) == ("stationary", None, "stays")


def test_a_pair_on_a_course_meets():
    scene = synthetic.scene([(-1.5, 0), (1.5, 0.1)], [(1, 0), (-1, 0)])
    (contact,) = scene.collisions
    assert courses(scene, 10) == [(0, 1)]
    names = tuple(o.phrase for o in scene.objects)
    # They close at two units a second and meet after about 32 frames; the cut is 6, then 20.
    for stop, when in ((6, "soon"), (20, "imminent")):
        facts = facts_of(scene, 0, stop, contact.frame)
        assert facts.courses[0].objects == names
        assert facts.contacts == facts.courses
        assert facts.courses[0].when == when
        assert facts.close[0].objects == names


def test_parallel_and_parting_pairs_are_on_no_course():
    scene = synthetic.scene([(0, 0), (0, 1), (-1, -1)], [(0.5, 0), (0.5, 0), (-0.5, -0.5)])
    assert courses(scene, 10) == []


def test_time_to_event_is_counted_from_the_cut():
    scene = synthetic.scene([(-1.5, 0), (1.5, 0)], [(1, 0), (-1, 0)])
    contact = scene.collisions[0].frame
    assert cut_of(scene, 0, contact) == contact - 12
    assert facts_of(scene, 0, contact, contact + 5).courses[0].when == "imminent"
    assert facts_of(scene, 0, contact, contact + 5).instant == "just before the contact"
    assert cut_of(scene, contact - 15, contact) is None


def test_leaving_the_view():
    start = synthetic.on_ground((440, 160))[:2]
    scene = synthetic.scene([start, (0, 0)], [toward(start, (600, 160), 60), (0, 0)])
    moving = facts_of(scene, 0, 10, 80).objects[0]
    assert moving.leaves
    assert moving.target_region == "out of view"


def cases(count):
    rng = np.random.default_rng(1)
    for k in range(count):
        scene, other = synthetic.random_scene(rng), synthetic.random_scene(rng, "other")
        frames = tuple(int(f) for f in 40 + rng.permutation(80)[:4])
        answer = int(rng.integers(4))
        if not scene.in_view[frames[answer]].any():
            continue  # No builder names a target that shows nothing.
        foreign = {(answer + 1) % 4: "other"} if k % 3 == 0 else {}
        item = synthetic.item(
            frames,
            answer=answer,
            item_id=f"item{k}",
            scene_ids=foreign,
            framing=(None, "future", "contact")[k % 3],
        )
        predicates = predicates_of(item, scene, {"other": other}.__getitem__)
        if predicates is not None:
            yield item, predicates


def test_no_number_in_any_predicate():
    for _, predicates in cases(60):
        text = json.dumps(predicates.to_dict())
        assert not any(c.isdigit() for c in text)
        assert not find_numbers(text)


def test_wrong_candidates_disagree_and_the_right_one_agrees():
    for item, predicates in cases(200):
        assert predicates.answer == item.letter
        for candidate in predicates.candidates:
            assert candidate.agrees == (candidate.letter == item.letter)
            assert candidate.agrees == (not candidate.differences)


def test_a_displaced_object_is_named_with_its_direction():
    start = synthetic.on_ground((220, 160))[:2]
    scene = synthetic.scene([start, (0, -1)], [toward(start, (340, 160), 100), (0, 0)])
    item = synthetic.item((60, 80, 100, 120), answer=0)
    late = predicates_of(item, scene, None).candidates[1].differences
    assert [(d.object, d.kind) for d in late] == [(scene.objects[0].phrase, "displaced")]
    assert (late[0].heading, late[0].extent) == ("east", "slightly")
