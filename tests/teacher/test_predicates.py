"""Laws of the predicates, on scenes that are known in closed form."""

import json

import numpy as np
import pytest

from teacher.numbers import find_numbers
from teacher.predicates import REGIONS, compass, courses, cut_of, facts_of, predicates_of
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


def test_a_pair_that_has_just_met_is_on_no_course():
    scene = synthetic.scene([(-1.5, 0), (1.5, 0)], [(1, 0), (-1, 0)])
    contact = scene.collisions[0].frame
    assert courses(scene, contact - 1) == [(0, 1)]
    for cut in range(contact, contact + 4):
        assert courses(scene, cut) == []


def test_what_the_clip_does_not_show_is_not_foretold():
    """A pair that would meet after the last frame neither will nor will not meet."""
    scene = synthetic.scene([(-1.5, 0), (1.5, 0)], [(0.4, 0), (-0.4, 0)], frames=60)
    assert not scene.collisions
    assert courses(scene, 50) == [(0, 1)]
    assert facts_of(scene, 20, 50, 55).courses[0].when == "unseen"


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


DIRECTIONS = {
    "north": np.array([0, -1]),
    "south": np.array([0, 1]),
    "east": np.array([1, 0]),
    "west": np.array([-1, 0]),
    "northeast": np.array([1, -1]),
    "northwest": np.array([-1, -1]),
    "southeast": np.array([1, 1]),
    "southwest": np.array([-1, 1]),
}


def test_facts_of_real_scenes_are_true(micro_store):
    """What a predicate says holds in the oracle's own positions, velocities and collisions."""
    never = headings = close = 0
    for item in micro_store.selection():
        scene = micro_store.scene(item.scene_id)
        cut = cut_of(scene, item.prefix_start, item.prefix_stop)
        facts = facts_of(scene, item.prefix_start, item.prefix_stop, item.target_frame)
        if facts is None:
            continue
        index = {o.phrase: i for i, o in enumerate(scene.objects)}
        for meeting in facts.courses:
            pair = {index[name] for name in meeting.objects}
            met = [c.frame for c in scene.collisions if set(c.objects) == pair]
            assert (meeting.when in (None, "unseen")) == (not any(frame > cut for frame in met))
            assert not any(cut - 4 <= frame <= cut for frame in met)
            never += meeting.when is None
        for o in facts.objects:
            if o.heading is not None:
                way = scene.image_positions[cut + 1, index[o.object]]
                way = way - scene.image_positions[cut, index[o.object]]
                hit = any(
                    cut < c.frame <= cut + 2 and index[o.object] in c.objects
                    for c in scene.collisions
                )
                if not hit and np.hypot(*way) > 0.5:
                    assert way @ DIRECTIONS[o.heading] > 0
                    headings += 1
        for pair in facts.close:
            i, j = (index[name] for name in pair.objects)
            ground = scene.positions[item.target_frame, :, :2]
            assert np.hypot(*(ground[i] - ground[j])) < 0.6
            middle = scene.image_positions[item.target_frame, [i, j]].mean(0)
            column, row = np.floor(middle / scene.image_size * 3).astype(int)
            assert pair.region == REGIONS[row][column]
            close += 1
    assert min(headings, close) > 5
    assert never > 0


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


def test_differences_of_a_candidate_are_there(micro_store):
    """A region or a missing object that a candidate is said to show is what its frame shows."""
    told = 0
    for item in micro_store.selection():
        scene = micro_store.scene(item.scene_id)
        predicates = predicates_of(item, scene, micro_store.scene)
        for candidate in predicates.candidates if predicates else ():
            named = item.candidates["ABCD".index(candidate.letter)]
            frame, other = named.frame, micro_store.scene(named.scene_id)
            right = (named.scene_id, frame) == (item.scene_id, item.target_frame)
            assert candidate.agrees == right
            here, there = ([o.phrase for o in s.objects] for s in (scene, other))
            assert candidate.other_objects == (set(here) != set(there))
            for d in candidate.differences:
                i = here.index(d.object) if d.object in here else None
                j = there.index(d.object) if d.object in there else None
                if d.kind == "region":
                    cell = other.image_positions[frame, j] / other.image_size * 3
                    column, row = np.clip(np.floor(cell), 0, 2).astype(int)
                    assert d.region in (REGIONS[row][column], "out of view")
                if d.kind == "missing":
                    assert j is None or other.visible_fraction[frame, j] <= 0.05
                if d.kind == "extra":
                    assert i is None or scene.visible_fraction[item.target_frame, i] <= 0.05
                if d.kind == "displaced" and d.heading:
                    way = other.image_positions[frame, j]
                    way = way - scene.image_positions[item.target_frame, i]
                    assert way @ DIRECTIONS[d.heading] > 0
                told += 1
    assert told > 50


def test_a_displaced_object_is_named_with_its_direction():
    start = synthetic.on_ground((220, 160))[:2]
    scene = synthetic.scene([start, (0, -1)], [toward(start, (340, 160), 100), (0, 0)])
    item = synthetic.item((60, 80, 100, 120), answer=0)
    late = predicates_of(item, scene, None).candidates[1].differences
    assert [(d.object, d.kind) for d in late] == [(scene.objects[0].phrase, "displaced")]
    assert (late[0].heading, late[0].extent) == ("east", "slightly")
