"""What follows from contacts, compared with the frames in which Bullet reports a touch."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations, pairwise

import pytest

from dynapix.conf.schema import WorldConfig
from dynapix.data.items.pickers import Timing
from dynapix.data.items.queries import BUILDERS
from dynapix.data.items.recipes import EVENT_CELLS, MATCHED, make_recipe
from dynapix.data.items.transfer import make_transfer_recipe
from dynapix.data.oracle.events import first_collisions, next_collision
from dynapix.data.records import FPS, Scene
from dynapix.data.sim.physics import Touching
from dynapix.data.sim.sampling import sample_scene
from dynapix.data.sources.scenes import record_scene
from dynapix.teacher.predicates.extraction import extract_facts
from dynapix.teacher.predicates.motion import describe_meeting, find_collision_courses
from tests.data.oracle.test_random_worlds import random_world
from tests.data.simulated import WORLDS, preset_world

CASES = [*((name, index) for name in WORLDS for index in range(3)), *((k, 0) for k in range(12))]


@pytest.fixture(scope="module", params=CASES, ids=str)
def touched(request: pytest.FixtureRequest) -> tuple[Scene, Touching]:
    """A scene of a preset or of a random world, and the frames in which its pairs touch."""
    name, index = request.param
    world: WorldConfig = preset_world(name) if isinstance(name, str) else random_world(name)
    # More collisions than in a benchmark, and repeated ones.
    world = replace(world, start=replace(world.start, max_collisions=None))
    sample = sample_scene(world, 5, index)
    return record_scene("scene", "train", sample, world), sample.motion.touching


def longest_step(scene: Scene) -> int:
    """The largest difference of two frames of a contact with touch: 0.2 s lie between them."""
    return round(0.2 * scene.fps) + 1


def touches_anew(touching: Touching, step: int, first: int, last: int) -> bool:
    """Whether a pair touches at frames `first` to `last` that did not touch in the `step` frames
    before."""
    return any(
        first <= frame <= last and not any(frame - step <= other < frame for other in frames)
        for frames in touching.values()
        for frame in frames
    )


def test_the_next_collision_begins_after_the_frame(touched: tuple[Scene, Touching]) -> None:
    scene, _ = touched
    starts = sorted(contact.frame for contact in scene.collisions)
    for frame in range(scene.frames):
        following = next_collision(scene, frame)
        expected = next((start for start in starts if start > frame), None)
        assert (following and following.frame) == expected


def test_every_touch_belongs_to_one_contact(touched: tuple[Scene, Touching]) -> None:
    scene, touching = touched
    for pair in combinations(range(len(scene.objects)), 2):
        own = [c for c in scene.collisions if c.objects == pair]
        frames = {*touching.get(pair, ())}
        assert {f for c in own for f in range(c.frame, c.end + 1)} >= frames
        assert {f for c in own for f in (c.frame, c.end)} <= frames
        assert all(b.frame - a.end > longest_step(scene) for a, b in pairwise(own))
    assert {c.objects for c in first_collisions(scene)} == touching.keys()


def test_targets_of_events_are_at_the_next_collision(touched: tuple[Scene, Touching]) -> None:
    scene, touching = touched
    timings: list[Timing] = MATCHED.timings(scene)
    for subtype, (framing, *_) in EVENT_CELLS.items():
        if framing == "future":
            timings += make_recipe("dynapix", "event", subtype).timings(scene)
    for recipe, subtype in (("movi_a", "contact"), ("physion", "A1_contact")):
        timings += make_transfer_recipe(recipe, recipe, "event", subtype).timings(scene)
    # Builder 6 asks for the frame half a second after the next collision.
    later = {3: 0, 5: 0, 6: FPS - FPS // 2}
    timings += [
        Timing(start, stop, target - later[builder], event=target - later[builder])
        for builder in later
        for _, start, stop, target in BUILDERS[builder](scene)
    ]
    step = longest_step(scene)
    for timing in timings:
        assert timing.event == timing.target
        assert not touches_anew(touching, step, timing.stop + 1, timing.target - 1)
        assert touches_anew(touching, step, timing.target, timing.target)


def test_pairs_that_will_not_meet_do_not_touch_later(touched: tuple[Scene, Touching]) -> None:
    scene, touching = touched
    for cut in range(5, scene.frames, 3):
        for pair in find_collision_courses(scene, cut):
            meeting = describe_meeting(scene, pair, cut)
            later = [frame for frame in touching.get(pair, ()) if frame > cut]
            assert (meeting.when in (None, "unseen")) == (not later)
    for stop in range(20, scene.frames - 10, 20):
        facts = extract_facts(scene, stop - 16, stop, stop + 10)
        assert facts is None or all(meeting.when for meeting in facts.contacts)
