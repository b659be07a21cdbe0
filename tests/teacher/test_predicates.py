"""Predicates of synthetic scenes and of a benchmark, compared with the oracle."""

import math
from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np

from dynapix.teacher.predicates.extraction import extract_facts, extract_predicates
from dynapix.teacher.predicates.facts import COMPASS, REGIONS
from dynapix.teacher.predicates.margins import find_relations
from dynapix.teacher.predicates.motion import find_collision_courses, find_cut
from dynapix.teacher.predicates.places import close_pairs
from dynapix.teacher.predicates.relations import Places
from tests.teacher import synthetic


def toward(start, pixel, frames):
    """Return the velocity that moves an object from a point on the ground to a pixel in a number of
    frames."""
    return (synthetic.on_ground(pixel)[:2] - start) / frames * synthetic.FPS


DIRECTIONS = {
    word: np.array([("east" in word) - ("west" in word), ("south" in word) - ("north" in word)])
    for word in COMPASS
}


def test_contact_distances_are_those_of_the_radii():
    """A scene in other units of length, with its radii, has the same predicates; the standard radii
    are those of a scene that records none. Two objects touch at the sum of their radii."""
    rng = np.random.default_rng(4)
    for _ in range(20):
        scene = synthetic.random_scene(rng)
        count = len(scene.objects)
        larger = replace(
            scene,
            positions=3.5 * scene.positions,
            velocities=3.5 * scene.velocities,
            radii=(0.7,) * count,
        )
        standard = replace(scene, radii=(0.2,) * count)
        assert extract_facts(standard, 0, 30, 60) == (facts := extract_facts(scene, 0, 30, 60))
        other = extract_facts(larger, 0, 30, 60)
        assert (facts and facts.close) == (other and other.close)
        assert find_collision_courses(larger, 30) == find_collision_courses(scene, 30)
        places, wide = (Places.from_frame(s, 60) for s in (scene, larger))
        assert find_relations(wide) == find_relations(places)
    pair = synthetic.scene([(0, 0), (0.8, 0)], [(0, 0), (0, 0)])
    assert not close_pairs(pair, 0)
    assert close_pairs(replace(pair, radii=(0.2, 0.4)), 0)


def test_motion_onsets_and_landings_are_not_called_collisions():
    scene = synthetic.scene([(0, 0), (1, 0)], [(0.5, 0), (0, 0.5)])
    for framing, subtype, moment in (
        ("future", "contact", "at the collision"),
        ("future", "A1_contact", "at the collision"),
        ("future", "A2_motion", "when an object starts to move"),
        ("future", "A3_landing", "at the landing"),
        ("contact", "contact_gap5", "just after the collision"),
        (None, "in_1s", "at the target moment"),
    ):
        item = replace(synthetic.item((40, 50, 60, 70), framing=framing), subtype=subtype)
        assert extract_predicates(item, scene, lambda _: scene).moment == moment


def test_pair_that_has_just_met_is_not_on_a_course():
    scene = synthetic.scene([(-1.5, 0), (1.5, 0)], [(1, 0), (-1, 0)])
    contact = scene.collisions[0].frame
    assert find_collision_courses(scene, contact - 1) == [(0, 1)]
    for cut in range(contact, contact + 4):
        assert find_collision_courses(scene, cut) == []


def test_meeting_after_the_last_frame_is_unseen():
    scene = synthetic.scene([(-1.5, 0), (1.5, 0)], [(0.4, 0), (-0.4, 0)], frames=60)
    assert not scene.collisions
    assert find_collision_courses(scene, 50) == [(0, 1)]
    assert extract_facts(scene, 20, 50, 55).courses[0].when == "unseen"


def test_collision_course_depends_on_the_frame_rate_of_the_scene():
    """Objects that approach at 0.04 units/s count as stationary. The same positions at four times
    the frame rate mean 0.16 units/s."""
    scene = synthetic.scene([(-0.3, 0), (0.3, 0)], [(0.02, 0), (-0.02, 0)])
    assert find_collision_courses(scene, 10) == []
    faster = replace(scene, fps=100, velocities=scene.velocities * 4)
    assert find_collision_courses(faster, 10) == [(0, 1)]


def test_an_object_without_a_recorded_visible_fraction_is_visible_in_view():
    scene = synthetic.scene([(0, 0), (0, -1)], [(0, 0), (0, 0)])
    unknown = replace(scene, visible_fraction=np.full_like(scene.visible_fraction, np.nan))
    sights = {(o.sight, o.target_sight) for o in extract_facts(unknown, 20, 40, 90).objects}
    assert sights == {("shown", "shown")}


def test_time_of_a_meeting_is_counted_from_the_cut():
    scene = synthetic.scene([(-1.5, 0), (1.5, 0)], [(1, 0), (-1, 0)])
    contact = scene.collisions[0].frame
    assert find_cut(scene, 0, contact) == contact - 12
    assert extract_facts(scene, 0, contact, contact + 5).courses[0].when == "imminent"
    assert extract_facts(scene, 0, contact, contact + 5).instant == "just before the contact"
    assert find_cut(scene, contact - 15, contact) is None


def expected_region(x, y, width, height):
    down = "top" if 3 * y < height else "bottom" if 3 * y >= 2 * height else ""
    across = "left" if 3 * x < width else "right" if 3 * x >= 2 * width else ""
    return f"near the {'-'.join(filter(None, (down, across))) or 'center'}"


def expected_speed(velocity):
    speed = math.sqrt(sum(float(v) ** 2 for v in velocity))
    bounds = [(0.05, "stationary"), (0.6, "slowly"), (1.5, "steadily"), (3.0, "quickly")]
    return next((word for bound, word in bounds if speed < bound), "very quickly")


def expected_extent(distance):
    return "stays" if distance < 8 else "shifts slightly" if distance < 60 else "moves across"


def points_along(word, displacement):
    """Return whether a compass word is the nearest to the direction of a displacement."""
    displacement = np.asarray(displacement, dtype=float)
    cosine = displacement @ DIRECTIONS[word]
    cosine /= np.linalg.norm(displacement) * np.linalg.norm(DIRECTIONS[word])
    return cosine > math.cos(math.pi / 8) - 1e-9


def closest_pass(scene, i, j, cut, since):
    """Return the distances of two objects over 60 frames of straight motion in small steps, and
    their relative speed (units/s)."""
    ground = scene.positions[:, :, :2]
    steps = [(ground[cut, k] - ground[since[k], k]) / (cut - since[k]) for k in (i, j)]
    ahead = np.arange(0, 60, 0.01)[:, None]
    gaps = ground[cut, j] + ahead * steps[1] - ground[cut, i] - ahead * steps[0]
    return np.linalg.norm(gaps, axis=-1), 25 * np.linalg.norm(steps[1] - steps[0])


def expected_sight(scene, frame, k):
    if not scene.in_view[frame, k]:
        return "out of view"
    return "shown" if scene.visible_fraction[frame, k] > 0.05 else "hidden"


def test_every_fact_agrees_with_the_oracle(benchmark_store):
    """Regions, speeds, directions, meetings and closeness are computed here by independent code."""
    counts = Counter()
    for item in benchmark_store.selection():
        scene, target = benchmark_store.scene(item.scene_id), item.target_frame
        predicates = extract_predicates(item, scene, benchmark_store.scene)
        ahead = [c.frame for c in scene.collisions if c.frame >= item.prefix_stop]
        cut = min([item.prefix_stop, *(frame - 12 for frame in ahead)])
        assert (predicates is None) == (cut - item.prefix_start < 4)
        if predicates is None:
            continue
        width, height = scene.image_size
        square = np.array([336 / width, 336 / height])
        since = [cut - 4] * len(scene.objects)
        for c in scene.collisions:
            for k in c.objects:
                since[k] = max(since[k], c.frame) if c.frame <= cut else since[k]
        for k, o in enumerate(predicates.objects):
            assert o.object == scene.objects[k].noun_phrase
            for frame, sight, region in (
                (cut, o.sight, o.region),
                (target, o.target_sight, o.target_region),
            ):
                counts["region"] += 1
                assert sight == expected_sight(scene, frame, k)
                place = expected_region(*scene.image_positions[frame, k], width, height)
                assert region == (sight if sight == "out of view" else place)
            if o.sight == "out of view":
                assert (o.speed, o.heading) == (None, None)
            else:
                assert o.speed == expected_speed(scene.velocities[cut, k])
                way = (scene.image_positions[cut, k] - scene.image_positions[since[k], k]) * square
                rests = o.speed == "stationary" or np.hypot(*way) < 1e-6
                assert rests if o.heading is None else points_along(o.heading, way)
                counts["heading"] += o.heading is not None
            moved = (scene.image_positions[target, k] - scene.image_positions[cut, k]) * square
            distance = math.hypot(*moved)
            if {o.sight, o.target_sight} == {"out of view"}:
                assert (o.extent, o.travel) == ("unseen", None)
            else:
                assert o.extent == expected_extent(distance)
                assert distance < 8 if o.travel is None else points_along(o.travel, moved)
            crosses = {o.sight == "out of view", o.target_sight == "out of view"} == {True, False}
            assert (o.object in (*predicates.entering, *predicates.leaving)) == crosses
            assert not (o.object in predicates.entering and o.sight != "out of view")
            counts["crossing"] += crosses
        check_meetings(scene, predicates, cut, target, since, counts)
    assert min(counts[kind] for kind in ("region", "heading", "crossing", "course", "close")) > 5
    assert counts["never"] > 0


def check_meetings(scene, predicates, cut, target, since, counts):
    """Check the collision courses, contacts and close pairs of `predicates`."""
    names = [o.noun_phrase for o in scene.objects]
    on_course = {frozenset(m.objects): m.when for m in predicates.courses}
    contacts = {frozenset(m.objects): m.when for m in predicates.contacts}
    close = {frozenset(c.objects): c.region for c in predicates.close}
    for i, j in combinations(range(len(names)), 2):
        pair = frozenset((names[i], names[j]))
        met = sorted(c.frame for c in scene.collisions if set(c.objects) == {i, j})
        later = next((frame - cut for frame in met if frame > cut), None)
        bounds = {15: "imminent", 40: "soon", math.inf: "later"}
        when = later and next(word for bound, word in bounds.items() if later <= bound)
        assert (pair in contacts) == any(cut < frame <= target for frame in met)
        assert contacts.get(pair, when) == when
        if any(cut - 5 < frame <= cut for frame in met) or cut in (since[i], since[j]):
            assert pair not in on_course
        else:
            distances, closing = closest_pass(scene, i, j, cut, since)
            nearing = distances[1] < distances[0] and closing >= 0.05
            if abs(distances.min() - 0.5) > 1e-3:  # Otherwise, the steps are too coarse to tell.
                assert (pair in on_course) == (nearing and distances.min() < 0.5)
            if pair in on_course:
                assert on_course[pair] == when or (when is None and on_course[pair] == "unseen")
                counts["course"] += 1
                counts["never"] += on_course[pair] is None
        ground = scene.positions[target, :, :2]
        near = np.hypot(*(ground[i] - ground[j])) < 0.6 and scene.in_view[target, [i, j]].all()
        assert (pair in close) == near
        if near:
            middle = scene.image_positions[target, [i, j]].mean(0)
            assert close[pair] == expected_region(*middle, *scene.image_size)
            counts["close"] += 1


def random_cases(count, relational=False):
    """Yield items of random scenes with their predicates, at most `count`. They have
    relations if `relational` is true."""
    rng = np.random.default_rng(1)
    for k in range(count):
        scene, other = synthetic.random_scene(rng), synthetic.random_scene(rng, "other")
        frames = tuple(int(f) for f in 40 + rng.permutation(80)[:4])
        answer = int(rng.integers(4))
        if not scene.in_view[frames[answer]].any():
            continue  # The builders of items never select a target without visible objects.
        foreign = {(answer + 1) % 4: "other"} if k % 3 == 0 else {}
        item = synthetic.item(
            frames,
            answer=answer,
            item_id=f"item{k}",
            scene_ids=foreign,
            framing=(None, "future", "contact")[k % 3],
        )
        predicates = extract_predicates(item, scene, {"other": other}.__getitem__)
        if predicates is not None:
            yield item, predicates if relational else predicates.without_relations()


def test_differences_of_candidates_agree_with_the_oracle(benchmark_store):
    checked = 0
    for item in benchmark_store.selection():
        scene = benchmark_store.scene(item.scene_id)
        predicates = extract_predicates(item, scene, benchmark_store.scene)
        for candidate in predicates.candidates if predicates else ():
            named = item.candidates["ABCD".index(candidate.letter)]
            frame, other = named.frame, benchmark_store.scene(named.scene_id)
            right = (named.scene_id, frame) == (item.scene_id, item.target_frame)
            assert candidate.agrees == right
            names, others = ([o.noun_phrase for o in s.objects] for s in (scene, other))
            assert candidate.other_objects == (set(names) != set(others))
            for d in candidate.differences:
                i = names.index(d.object) if d.object in names else None
                j = others.index(d.object) if d.object in others else None
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
                checked += 1
    assert checked > 50


def test_objects_with_equal_noun_phrases_are_compared_one_by_one(benchmark_store):
    compared = 0
    for item in benchmark_store.selection()[:40]:
        if len({c.scene_id for c in item.candidates}) > 1:
            continue
        scene = benchmark_store.scene(item.scene_id)
        alike = replace(scene, objects=(scene.objects[0],) * len(scene.objects))
        both = (extract_predicates(item, s, lambda name, s=s: s) for s in (scene, alike))
        one, other = both
        for a, b in zip(one.candidates, other.candidates, strict=True) if one else ():
            assert len(a.differences) == len(b.differences)
            compared += len(a.differences) > 1
    assert compared


def test_displacement_has_a_direction_and_an_extent():
    start = synthetic.on_ground((220, 160))[:2]
    scene = synthetic.scene([start, (0, -1)], [toward(start, (340, 160), 100), (0, 0)])
    item = synthetic.item((60, 80, 100, 120), answer=0)
    late = extract_predicates(item, scene, None).candidates[1].differences
    assert [(d.object, d.kind) for d in late] == [(scene.objects[0].noun_phrase, "displaced")]
    assert (late[0].heading, late[0].extent) == ("east", "slightly")


def test_bounds_of_a_scene_change_its_speed_words():
    scene = synthetic.scene([(0, 0), (0, -1)], [(0.7, 0.0), (0.2, 0.0)])
    half = replace(scene, speed_bounds=(0.1, 0.3, 0.6))
    words = [[o.speed for o in extract_facts(s, 0, 20, 60).objects] for s in (scene, half)]
    assert words == [["steadily", "slowly"], ["very quickly", "steadily"]]
