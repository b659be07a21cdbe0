"""Extracts the predicates of an item from the oracle of its scenes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import replace
from math import dist, hypot

import numpy as np

from dynapix.data.oracle.displacement import MODEL_SIZE
from dynapix.data.oracle.events import collisions_in, next_collision
from dynapix.data.records import CONTACT, LETTERS, Scene, SelectionItem
from dynapix.teacher.predicates.facts import (
    OUT_OF_VIEW,
    CandidateFacts,
    Difference,
    Facts,
    ObjectFacts,
    RelationalPredicates,
    View,
)
from dynapix.teacher.predicates.margins import find_changes, find_relations
from dynapix.teacher.predicates.motion import (
    describe_meeting,
    find_collision_courses,
    find_cut,
    motion_start,
    object_heading,
    object_speed,
)
from dynapix.teacher.predicates.places import (
    close_pairs,
    compass_direction,
    object_region,
    object_sight,
    square_displacement,
)
from dynapix.teacher.predicates.relations import CLEARLY, DISPLACED, Places

STAYS, SHIFTS = 8.0, 60.0
"""Upper bounds of the displacement (px of the square image) of an object that "stays", and of one
that "shifts slightly". An object that moves further "moves across"."""
EVENT_MOMENTS = {"A2_motion": "when an object starts to move", "A3_landing": "at the landing"}
"""The target of an event item in words, by subtype; of other subtypes, it is a collision."""
BORDER = 6.0
"""Displacement (px of the square image) below which a change of region is ignored."""


def extract_facts(
    scene: Scene, start: int, stop: int, target: int, moment: str = "at the target moment"
) -> Facts | None:
    """Return the facts for the prefix [start, stop] and a target frame; None if the prefix is too
    short (see `find_cut`). `moment` names the target in words."""
    cut = find_cut(scene, start, stop)
    if cut is None:
        return None
    objects = tuple(
        ObjectFacts(**_cut_fields(scene, i, cut), **_target_fields(scene, i, cut, scene, i, target))
        for i in range(len(scene.objects))
    )
    contacts = [c.objects for c in collisions_in(scene, cut + 1, target)]
    others = [*collisions_in(scene, cut, cut), *collisions_in(scene, target + 1, scene.frames)]
    later = [c.objects for c in others]
    return Facts(
        instant="at the end of the observation" if cut == stop else "just before the contact",
        moment=moment,
        objects=objects,
        entering=tuple(o.object for o in objects if o.enters),
        leaving=tuple(o.object for o in objects if o.leaves),
        courses=tuple(describe_meeting(scene, p, cut) for p in find_collision_courses(scene, cut)),
        contacts=tuple(describe_meeting(scene, pair, cut) for pair in dict.fromkeys(contacts)),
        close=close_pairs(scene, target),
        records_contacts=scene.records_contacts,
        later=tuple(
            tuple(scene.objects[k].noun_phrase for k in pair) for pair in dict.fromkeys(later)
        ),
    )


def extract_predicates(
    item: SelectionItem, scene: Scene, scene_of: Callable[[str], Scene]
) -> RelationalPredicates | None:
    """Return the predicates of an item; None if the prefix is too short (see `find_cut`).

    Args:
        scene_of: Returns a scene by its id; it is called for candidates from other scenes.
    """
    facts = extract_facts(
        scene, item.prefix_start, item.prefix_stop, item.target_frame, name_moment(item)
    )
    if facts is None:
        return None
    if item.distractors == CONTACT and (upcoming := next_collision(scene, item.prefix_stop)):
        # A text names few pairs: first the one on whose collision the item turns.
        names = tuple(scene.objects[k].noun_phrase for k in upcoming.objects)
        courses, contacts = (
            tuple(sorted(meetings, key=lambda meeting: meeting.objects != names))
            for meetings in (facts.courses, facts.contacts)
        )
        facts = replace(facts, courses=courses, contacts=contacts)
    shown = {
        letter: (scene if c.scene_id == scene.scene_id else scene_of(c.scene_id), c.frame)
        for letter, c in zip(LETTERS, item.candidates, strict=True)
    }
    cut = find_cut(scene, item.prefix_start, item.prefix_stop)
    earlier = Places.from_frame(scene, cut)
    views = tuple(
        _describe_view(letter, facts.objects, scene, cut, earlier, other, frame)
        for letter, (other, frame) in shown.items()
    )
    at_target = views[item.answer].places.image
    both = sorted(earlier.image.keys() & at_target.keys())
    order = np.argsort(scene.image_positions[cut, :, 0], kind="stable")
    return RelationalPredicates(
        **vars(facts),
        candidates=tuple(
            CandidateFacts(letter, True, False, ())
            if letter == item.letter
            else _candidate_facts(letter, scene, item.target_frame, other, frame)
            for letter, (other, frame) in shown.items()
        ),
        left_to_right=tuple(scene.objects[k].noun_phrase for k in order),
        paths={name: dist(earlier.image[name], at_target[name]) for name in both},
        observed=tuple(sorted(find_relations(earlier))),
        views=views,
    )


def name_moment(item: SelectionItem) -> str:
    """Return an item's target in words. The events of some subtypes are no collisions."""
    if item.distractors == CONTACT:
        return "after the collision"
    if item.framing == "future" and item.subtype in EVENT_MOMENTS:
        return EVENT_MOMENTS[item.subtype]
    return {"future": "at the collision", "contact": "just after the collision"}.get(
        item.framing or "", "at the target moment"
    )


def _describe_view(
    letter: str,
    seen: Sequence[ObjectFacts],
    scene: Scene,
    cut: int,
    earlier: Places,
    other: Scene,
    frame: int,
) -> View:
    """Return the view of a candidate, a frame of the scene `other`.

    Args:
        seen: The facts of the objects of `scene`, with the item's target.
        earlier: The places at the cut.
    """
    index = {key: k for k, key in enumerate(other.object_keys)}
    objects = tuple(
        replace(o, **_target_fields(scene, k, cut, other, index.get(key), frame))
        for k, (o, key) in enumerate(zip(seen, scene.object_keys, strict=True))
    )
    later = Places.from_frame(other, frame)
    at_rest = {o.object for o in objects if o.extent == "stays"}
    relations = find_relations(later) | find_changes(earlier, later, at_rest)
    return View(letter, objects, close_pairs(other, frame), tuple(sorted(relations)), later)


def _cut_fields(scene: Scene, index: int, cut: int) -> dict[str, str | None]:
    """Return the fields of `ObjectFacts` that describe an object at the cut."""
    sight = object_sight(scene, cut, index)
    speed = heading = None
    if sight != OUT_OF_VIEW:
        speed = object_speed(scene, index, cut)
        heading = object_heading(scene, index, motion_start(scene, index, cut), cut)
    return {
        "object": scene.objects[index].noun_phrase,
        "region": object_region(scene, cut, index),
        "sight": sight,
        "speed": speed,
        "heading": heading,
    }


def _target_fields(
    scene: Scene, index: int, cut: int, other: Scene, other_index: int | None, target: int
) -> dict[str, str | None]:
    """Return the fields of `ObjectFacts` that describe an object at frame `target` of `other`, and
    its displacement since the cut of `scene`.

    Args:
        other_index: The object's index in `other`; None if that scene lacks it.
    """
    sight, target_sight = object_sight(scene, cut, index), OUT_OF_VIEW
    target_region = OUT_OF_VIEW
    if other_index is not None:
        target_sight = object_sight(other, target, other_index)
        target_region = object_region(other, target, other_index)
    travel = None
    if sight == OUT_OF_VIEW == target_sight:
        extent = "unseen"
    elif other_index is None:
        extent = "moves across"
    else:
        shift = square_displacement(scene, cut, index, other, target, other_index)
        distance = hypot(*shift)
        extent = "stays"
        if distance >= STAYS:
            extent = "shifts slightly" if distance < SHIFTS else "moves across"
            travel = compass_direction(shift)
    return {
        "target_region": target_region,
        "target_sight": target_sight,
        "extent": extent,
        "travel": travel,
    }


def _candidate_facts(
    letter: str, scene: Scene, target: int, other: Scene, frame: int
) -> CandidateFacts:
    in_target, in_candidate = (
        {key: k for k, key in enumerate(s.object_keys)} for s in (scene, other)
    )
    ranked: list[tuple[tuple[bool, bool, float], Difference]] = []
    for key in {**in_target, **in_candidate}:
        name, i, j = key[0].noun_phrase, in_target.get(key), in_candidate.get(key)
        expected = i is not None and object_sight(scene, target, i) == "shown"
        visible = j is not None and object_sight(other, frame, j) == "shown"
        if expected != visible:
            difference = Difference(name, "missing" if expected else "extra")
            ranked.append(((True, True, float(MODEL_SIZE)), difference))
        elif i is not None and j is not None:
            shift = square_displacement(scene, target, i, other, frame, j)
            distance = hypot(*shift)
            region = object_region(other, frame, j)
            if region != object_region(scene, target, i):
                bound, difference = BORDER, Difference(name, "region", region=region)
            else:
                extent = "clearly" if distance >= CLEARLY * MODEL_SIZE else "slightly"
                heading = compass_direction(shift)
                difference = Difference(name, "displaced", heading=heading, extent=extent)
                bound = DISPLACED * MODEL_SIZE
            ranked.append(((visible and distance >= bound, visible, distance), difference))
    ranked.sort(key=lambda entry: entry[0], reverse=True)
    # If every difference is below its bound, name the largest: the candidate is not the target.
    differences = tuple(d for (clear, *_), d in ranked if clear) or (ranked[0][1],)
    other_objects = in_target.keys() != in_candidate.keys()
    return CandidateFacts(letter, False, other_objects, differences)
