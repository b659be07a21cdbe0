"""Relations between objects follow their bounds, and the symmetries of the image."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.predicates.facts import Relation
from dynapix.teacher.predicates.margins import find_changes, find_relations
from dynapix.teacher.predicates.relations import (
    KINDS,
    OPPOSITES,
    SYMMETRIC,
    Places,
    describe_distance,
    flip_relation,
    normalize_relation,
)
from tests.teacher import synthetic

A, B, C = "blue metal cube", "green metal sphere", "red rubber cylinder"


def places(**pixels: tuple[float, float]) -> Places:
    """Objects a, b and c at shares of the image's width and height; ground distances are ten times
    those in the image."""
    names = dict(zip("abc", (A, B, C), strict=True))
    image = {names[key]: place for key, place in pixels.items()}
    ground = {name: (10 * x, 10 * y) for name, (x, y) in image.items()}
    return Places(image, ground, dict.fromkeys(image, 1.0), dict.fromkeys(image, 1.0))


def values(found: set[Relation], kind: str) -> set[tuple[tuple[str, ...], str]]:
    return {(objects, value) for k, objects, value in found if k == kind}


@pytest.mark.parametrize(
    ("dx", "side"),
    [(-0.041, "right of"), (-0.039, "aligned with"), (0.039, "aligned with"), (0.041, "left of")],
)
def test_sides_and_heights_follow_their_bound(dx: float, side: str) -> None:
    along = find_relations(places(a=(0.5, 0.5), b=(0.5 + dx, 0.5)))
    assert values(along, "side") == {((A, B), side)}
    assert values(along, "height") == {((A, B), "level with")}
    height = {"left of": "above", "right of": "below", "aligned with": "level with"}[side]
    down = find_relations(places(a=(0.5, 0.5), b=(0.5, 0.5 + dx)))
    assert values(down, "height") == {((A, B), height)}


@pytest.mark.parametrize(
    ("width", "scale", "value"),
    [
        (1.14, 1.0, "against"), (1.16, 1.0, "near"), (1.99, 1.0, "near"), (2.01, 1.0, "apart from"),
        (2.01, 2.0, "against"), (3.99, 2.0, "near"),
    ],
)  # fmt: skip
def test_gaps_are_measured_in_widths_of_the_objects(width: float, scale: float, value: str) -> None:
    found = replace_places(places(a=(0.1, 0.1), b=(0.1, 0.1 + width / 10)), scale=scale)
    assert values(find_relations(found), "gap") == {((A, B), value)}


def replace_places(old: Places, scale: float) -> Places:
    return old._replace(scale=dict.fromkeys(old.scale, scale))


@pytest.mark.parametrize(
    ("share", "offset", "between"),
    [
        (0.5, 0.0, True),
        (0.21, 0.0, True),
        (0.19, 0.0, False),
        (0.5, 0.24, True),
        (0.5, 0.26, False),
    ],
)
def test_between_follows_its_bounds(share: float, offset: float, between: bool) -> None:
    found = find_relations(
        places(a=(0.2 + 0.5 * share, 0.3 + 0.5 * offset), b=(0.2, 0.3), c=(0.7, 0.3))
    )
    assert (((A, B, C), "between") in values(found, "between")) == between


def test_nearer_follows_its_bound() -> None:
    found = find_relations(places(a=(0.3, 0.3), b=(0.2, 0.3), c=(0.43, 0.3)))
    assert ((A, B, C), "nearer to") in values(found, "nearer")
    found = find_relations(places(a=(0.3, 0.3), b=(0.2, 0.3), c=(0.42, 0.3)))
    assert [v for o, v in values(found, "nearer") if o[0] == A] == ["as near to"]


@pytest.mark.parametrize(
    ("fraction", "distance", "covers"),
    [(0.89, 0.11, True), (0.91, 0.11, False), (0.89, 0.13, False), (float("nan"), 0.11, False)],
)
def test_lower_object_covers_a_near_one_that_is_partly_hidden(
    fraction: float, distance: float, covers: bool
) -> None:
    where = places(a=(0.5, 0.5), b=(0.5, 0.5 - distance))
    hidden = where._replace(fraction={A: 1.0, B: fraction})
    found = values(find_relations(hidden), "cover")
    assert found == ({((A, B), "in front of")} if covers else set())


@pytest.mark.parametrize(("lead", "is_leftmost"), [(0.041, True), (0.039, False)])
def test_extremes_follow_their_bound(lead: float, is_leftmost: bool) -> None:
    found = find_relations(places(a=(0.5 - lead, 0.2), b=(0.5, 0.5), c=(0.8, 0.8)))
    assert (((A,), "leftmost") in values(found, "extreme")) == is_leftmost


@pytest.mark.parametrize(
    ("place", "edges"),
    [
        ((0.059, 0.5), {"left"}), ((0.061, 0.5), set()), ((0.941, 0.5), {"right"}),
        ((0.939, 0.5), set()), ((0.5, 0.059), {"top"}), ((0.5, 0.061), set()),
        ((0.5, 0.941), {"bottom"}), ((0.5, 0.939), set()), ((0.059, 0.941), {"left", "bottom"}),
    ],
)  # fmt: skip
def test_edges_follow_their_bound(place: tuple[float, float], edges: set[str]) -> None:
    found = find_changes(places(a=(0.5, 0.5)), places(a=place), set())
    assert values(found, "edge") == {((A,), f"reaches the {edge} edge") for edge in edges}


def test_changes_of_an_object_that_passes_another() -> None:
    earlier = places(a=(0.2, 0.5), b=(0.5, 0.5), c=(0.9, 0.5))
    for height, value in (
        (0.5, "passes"),
        (0.6, "crosses in front of"),
        (0.4, "crosses behind"),
    ):
        before = places(a=(0.2, height), b=(0.5, 0.5), c=(0.9, 0.5))
        after = places(a=(0.7, height), b=(0.5, 0.5), c=(0.9, 0.5))
        found = find_changes(before, after, {B, C})
        assert values(found, "passing") == {((A, B), value)}
    later = places(a=(0.7, 0.5), b=(0.5, 0.5), c=(0.9, 0.5))
    assert values(find_changes(earlier, later, {B, C}), "arrival") == {((A, B, C), "comes between")}
    assert find_changes(earlier, later, {A, B, C}) == set()
    leaving = find_changes(earlier, places(a=(0.03, 0.5), b=(0.5, 0.5)), {B})
    assert values(leaving, "edge") == {((A,), "reaches the left edge")}


def random_places(seed: int) -> Places:
    scene = synthetic.random_scene(np.random.default_rng(seed))
    return Places.from_frame(scene, 60)


@pytest.mark.parametrize("seed", range(20))
def test_mirroring_the_image_swaps_left_and_right_only(seed: int) -> None:
    found = random_places(seed)
    mirrored = found._replace(image={name: (1 - x, y) for name, (x, y) in found.image.items()})
    swap = {
        "left of": "right of",
        "right of": "left of",
        "leftmost": "rightmost",
        "rightmost": "leftmost",
    }
    expected = {Relation(k, o, swap.get(v, v)) for k, o, v in find_relations(found)}
    assert find_relations(mirrored) == expected


@pytest.mark.parametrize("seed", range(20))
def test_relations_are_normalized_and_orders_are_total(seed: int) -> None:
    found = random_places(seed)
    relations = find_relations(found)
    assert {normalize_relation(r) for r in relations} == relations
    assert all(normalize_relation(flip_relation(r)) == r for r in relations if r.kind in SYMMETRIC)
    assert all(KINDS[r.value] == r.kind for r in relations)
    pairs = set(combinations(sorted(found.image), 2))
    for kind in ("side", "height", "gap"):
        assert {objects for objects, _ in values(relations, kind)} == pairs
    assert all(OPPOSITES[OPPOSITES[v]] == v for v in OPPOSITES)


def test_objects_that_look_alike_have_no_relations() -> None:
    scene = synthetic.scene([(0, 0), (0.5, 0.5), (-0.5, 0.3)], [(0, 0)] * 3)
    twins = replace(scene, objects=(scene.objects[0], scene.objects[0], scene.objects[2]))
    assert len(Places.from_frame(scene, 0).image) == 3
    assert list(Places.from_frame(twins, 0).image) == [scene.objects[2].noun_phrase]


@pytest.mark.parametrize("words", [{"min_words": 100}, {"max_words": 200}])
def test_narrator_refuses_limits_that_its_rationales_exceed(words: dict[str, int]) -> None:
    [problem] = TeacherConfig(name="t", **words).check("teacher.")
    assert "80 to 250 words" in problem
    served = TeacherConfig(name="t", url="http://127.0.0.1:8000/v1", model="m", **words)
    assert served.check("teacher.") == []


@pytest.mark.parametrize(
    ("distance", "extent"),
    [
        (0.0, None), (11.9 / 336, None), (12.1 / 336, "slightly"), (39.9 / 336, "slightly"),
        (40.1 / 336, "clearly"), (0.249, "clearly"), (0.251, "far"),
    ],
)  # fmt: skip
def test_distances_have_the_words_of_their_bounds(distance: float, extent: str | None) -> None:
    assert describe_distance(distance) == extent
