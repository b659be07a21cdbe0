"""Relations, the statements that decide an item, and rationales that rest on them."""

from __future__ import annotations

from dataclasses import asdict, replace
from itertools import combinations, permutations
from math import dist

import numpy as np
import pytest

from conf.schema import TeacherConfig
from conf.schema.servers import RelationBounds
from data.records import Scene
from teacher.deciding import choose_statements
from teacher.narrator import FULL, write_match_lines, write_rationale
from teacher.predicates.facts import Relation
from teacher.predicates.relations import (
    CHANGES,
    KINDS,
    OPPOSITES,
    SYMMETRIC,
    Bounds,
    Places,
    describe_distance,
    find_changes,
    find_relations,
    flip_relation,
    normalize_relation,
)
from teacher.servers.responses import Response
from teacher.sufficiency import find_predicted, measure_sufficiency
from teacher.validation.claim_extraction import extract_claims
from teacher.validation.grader import RationaleGrader
from teacher.validation.validator import validate_rationale
from teacher.vocabulary import choose_vocabulary
from teacher.writers.relational import RelationalWriter
from tests.teacher import synthetic
from tests.teacher.test_predicates import random_cases

BOUNDS = Bounds()
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
    along = find_relations(places(a=(0.5, 0.5), b=(0.5 + dx, 0.5)), BOUNDS)
    assert values(along, "side") == {((A, B), side)}
    assert values(along, "height") == {((A, B), "level with")}
    height = {"left of": "above", "right of": "below", "aligned with": "level with"}[side]
    down = find_relations(places(a=(0.5, 0.5), b=(0.5, 0.5 + dx)), BOUNDS)
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
    assert values(find_relations(found, BOUNDS), "gap") == {((A, B), value)}


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
        places(a=(0.2 + 0.5 * share, 0.3 + 0.5 * offset), b=(0.2, 0.3), c=(0.7, 0.3)), BOUNDS
    )
    assert (((A, B, C), "between") in values(found, "between")) == between


def test_nearer_and_extremes_follow_their_bounds() -> None:
    found = find_relations(places(a=(0.3, 0.3), b=(0.2, 0.3), c=(0.43, 0.3)), BOUNDS)
    assert ((A, B, C), "nearer to") in values(found, "nearer")
    assert values(found, "extreme") == {((B,), "leftmost"), ((C,), "rightmost")}
    found = find_relations(places(a=(0.3, 0.3), b=(0.2, 0.3), c=(0.42, 0.3)), BOUNDS)
    assert [v for o, v in values(found, "nearer") if o[0] == A] == ["as near to"]
    level = find_relations(places(a=(0.3, 0.3), b=(0.33, 0.3), c=(0.8, 0.5)), BOUNDS)
    assert ((A,), "leftmost") not in values(level, "extreme")


def test_lower_object_covers_one_that_is_partly_hidden() -> None:
    seen = places(a=(0.5, 0.5), b=(0.52, 0.45))
    hidden = seen._replace(fraction={A: 1.0, B: 0.6})
    assert values(find_relations(seen, BOUNDS), "cover") == set()
    assert values(find_relations(hidden, BOUNDS), "cover") == {((A, B), "in front of")}
    unknown = seen._replace(fraction={A: float("nan"), B: float("nan")})
    assert values(find_relations(unknown, BOUNDS), "cover") == set()


@pytest.mark.parametrize(
    ("fraction", "distance", "covers"),
    [(0.89, 0.11, True), (0.91, 0.11, False), (0.89, 0.13, False)],
)
def test_covering_follows_its_bounds(fraction: float, distance: float, covers: bool) -> None:
    where = places(a=(0.5, 0.5), b=(0.5, 0.5 - distance))
    hidden = where._replace(fraction={A: 1.0, B: fraction})
    found = values(find_relations(hidden, BOUNDS), "cover")
    assert found == ({((A, B), "in front of")} if covers else set())


@pytest.mark.parametrize(("lead", "is_leftmost"), [(0.041, True), (0.039, False)])
def test_extremes_follow_their_bound(lead: float, is_leftmost: bool) -> None:
    found = find_relations(places(a=(0.5 - lead, 0.2), b=(0.5, 0.5), c=(0.8, 0.8)), BOUNDS)
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
    found = find_changes(places(a=(0.5, 0.5)), places(a=place), set(), BOUNDS)
    assert values(found, "edge") == {((A,), f"reaches the {edge} edge") for edge in edges}


def test_changes_of_an_object_that_passes_another() -> None:
    earlier = places(a=(0.2, 0.5), b=(0.5, 0.5), c=(0.9, 0.5))
    for height, value in (
        (0.5, "moves past"),
        (0.6, "crosses in front of"),
        (0.4, "crosses behind"),
    ):
        before = places(a=(0.2, height), b=(0.5, 0.5), c=(0.9, 0.5))
        after = places(a=(0.7, height), b=(0.5, 0.5), c=(0.9, 0.5))
        found = find_changes(before, after, {B, C}, BOUNDS)
        assert values(found, "passing") == {((A, B), value)}
    later = places(a=(0.7, 0.5), b=(0.5, 0.5), c=(0.9, 0.5))
    assert values(find_changes(earlier, later, {B, C}, BOUNDS), "arrival") == {
        ((A, B, C), "comes between")
    }
    assert find_changes(earlier, later, {A, B, C}, BOUNDS) == set()
    leaving = find_changes(earlier, places(a=(0.03, 0.5), b=(0.5, 0.5)), {B}, BOUNDS)
    assert values(leaving, "edge") == {((A,), "reaches the left edge")}


def random_places(seed: int) -> Places:
    scene = synthetic.random_scene(np.random.default_rng(seed))
    return Places.of(scene, 60)


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
    expected = {Relation(k, o, swap.get(v, v)) for k, o, v in find_relations(found, BOUNDS)}
    assert find_relations(mirrored, BOUNDS) == expected


@pytest.mark.parametrize("seed", range(20))
def test_relations_are_normalized_and_orders_are_total(seed: int) -> None:
    found = random_places(seed)
    relations = find_relations(found, BOUNDS)
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
    assert len(Places.of(scene, 0).image) == 3
    assert list(Places.of(twins, 0).image) == [scene.objects[2].noun_phrase]


def test_bounds_of_words_are_settings() -> None:
    wide = BOUNDS._replace(level=0.2)
    near = places(a=(0.4, 0.5), b=(0.5, 0.5))
    assert values(find_relations(near, BOUNDS), "side") == {((A, B), "left of")}
    assert values(find_relations(near, wide), "side") == {((A, B), "aligned with")}


CFG = TeacherConfig(name="template")


def test_deciding_statements_are_a_place_and_a_smallest_set() -> None:
    """No smaller set of statements excludes what the place does not exclude, by exhaustive
    search."""
    sizes = []
    for _, predicates in random_cases(60, BOUNDS):
        decision = choose_statements(predicates)
        wrong = [v for v in predicates.views if v.letter != predicates.answer]
        excluded = {
            frozenset(v.letter for v in wrong if s not in v.statements)
            for s in predicates.target.statements
            if s.kind not in CHANGES
        }
        possible = frozenset().union(*excluded)
        assert set(decision.rivals) == {v.letter for v in wrong} - possible
        chosen = [
            frozenset(v.letter for v in wrong if s not in v.statements) for s in decision.statements
        ]
        assert frozenset().union(*chosen) == possible
        by_place = chosen[0] if decision.place else frozenset()
        suffices = (
            size
            for size in range(len(chosen) + 1)
            if any(by_place.union(*some) == possible for some in combinations(excluded, size))
        )
        assert len(set(decision.statements)) == len(chosen)
        sizes.append(len(chosen))
        assert next(suffices) == sizes[-1] - bool(decision.place)
        assert set(decision.statements) <= predicates.target.statements
    assert len(sizes) > 40
    assert sizes.count(1) > 0
    assert sizes.count(2) > 0


def test_the_place_is_that_of_an_object_seen_at_the_cut() -> None:
    decides = set()
    for _, predicates in random_cases(60, BOUNDS):
        place = choose_statements(predicates).place
        seen = {o.object for o in predicates.objects if o.sight != "out of view"}
        places = {
            s for s in predicates.target.statements if s.kind == "region" and s.objects[0] in seen
        }
        assert (place is None) == (not places)
        if place is not None:
            assert place in places
            wrong = [v for v in predicates.views if v.letter != predicates.answer]
            decides.add(not any(place in v.statements for v in wrong))
    assert decides == {False, True}


def test_outcomes_name_the_closest_candidate() -> None:
    named = 0
    for item, predicates in random_cases(250, BOUNDS):
        outcome = write_rationale(predicates, item, 0).partition("Outcome: ")[2].split(". ")[0]
        place = choose_statements(predicates).place
        if place is None or "closest" not in outcome:
            continue
        named += 1
        (name,) = place.objects
        words = f"The {name} is closest to its expected place in candidate "
        assert outcome == words + predicates.answer
        shown = {v.letter: v.places.image.get(name, (9, 9)) for v in predicates.views}
        target = predicates.target.places.image[name]
        for letter, there in shown.items():
            text = f"Outcome: {words}{letter}."
            verdicts = {c.verdict for c in extract_claims(text, predicates) if c.candidate}
            right = letter == predicates.answer
            assert verdicts == {"supported" if right else "contradicted"}
            assert right or dist(there, target) >= BOUNDS.displaced
    assert named > 40


def test_every_relational_rationale_is_accepted_and_sufficient() -> None:
    lengths = {"paper": [], "relational": []}
    for item, predicates in random_cases(250, BOUNDS):
        text = write_rationale(predicates, item, seed=3)
        validation = validate_rationale(text, predicates, item, CFG)
        assert validation.reasons == (), text
        rivals = choose_statements(predicates).rivals
        sufficiency = measure_sufficiency(text, validation.claims, predicates)
        assert sufficiency >= 1 / (1 + len(rivals)), text
        lengths["relational"].append(len(text.split()))
    paper = [len(write_rationale(p, i, seed=3).split()) for i, p in random_cases(250)]
    assert np.mean(lengths["relational"]) < np.mean(paper)


def test_wrong_candidates_are_compared_with_the_chosen_statements_only() -> None:
    for item, predicates in random_cases(60, BOUNDS):
        text = write_rationale(predicates, item, seed=0)
        decision = choose_statements(predicates)
        compared = {(s.kind, *sorted(s.objects)) for s in decision.statements}
        # Of an object that the target does not show, the analysis says where a candidate shows it.
        compared |= {("region", *s.objects) for s in decision.statements if s.kind == "sight"}
        claims = extract_claims(text, predicates)
        for view in predicates.views:
            about = [c for c in claims if c.candidate == view.letter and c.kind != "agrees"]
            if view.letter not in (predicates.answer, *decision.rivals):
                kinds = {(c.kind, *sorted(c.subjects)) for c in about}
                kinds = {k for k in kinds if k[0] not in ("lacks", "extra", "sight", "displaced")}
                assert kinds <= compared, text
            assert all(c.verdict != "contradicted" for c in about)


def test_objects_out_of_view_at_the_cut_are_named_only_if_they_decide() -> None:
    unseen = 0
    for item, predicates in random_cases(250, BOUNDS):
        decision = choose_statements(predicates)
        deciding = {name for s in decision.statements for name in s.objects}
        names = {o.object for o in predicates.objects if o.sight == "out of view"} - deciding
        # A course with an unseen object is stated if it is the only one, rather than denied.
        names -= {name for course in predicates.courses for name in course.objects}
        if len(names) == len(predicates.objects):
            continue
        unseen += len(names)
        text = write_rationale(predicates, item, 0).split("Candidate analysis:")[0]
        assert not [name for name in names if name in text]
    assert unseen


def test_scene_parses_name_objects_from_left_to_right() -> None:
    counts = []
    for item, predicates in random_cases(60, BOUNDS):
        parse = write_rationale(predicates, item, 0).split("Motion analysis:")[0]
        named = [[n for n in predicates.left_to_right if n in s] for s in parse.split(". ")]
        # Sentences about two objects name the more relevant one first.
        found = dict.fromkeys(names[0] for names in named if len(names) == 1)
        assert [*found] == [n for n in predicates.left_to_right if n in found]
        counts.append(len(found))
    assert max(counts) > 2


def test_match_lines_rest_on_the_statements_of_the_rationale() -> None:
    item, predicates = next(
        (i, p) for i, p in random_cases(60, BOUNDS) if not choose_statements(p).rivals
    )
    lines = write_match_lines(predicates, item)
    analysis = next(
        line for line in write_rationale(predicates, item, 0).splitlines() if "analysis: C" in line
    )
    for line, view in zip(lines, predicates.views, strict=True):
        if view.letter == predicates.answer:
            assert "does not match" not in line
        else:
            named = [o.object for o in view.objects if o.object in line]
            assert named
            assert named[0] in analysis


SUFFICIENT = "Prediction: At the target moment, the {a} will be {place}."


def sufficiency_of(prediction: str, pixels: list[tuple[float, float]]) -> float:
    """The sufficiency of a prediction about a cube that the candidates show at these pixels; the
    first is the target."""
    steps = np.array([synthetic.on_ground(pixel)[:2] for pixel in pixels])
    still = synthetic.scene([(0.0, 0.0), steps[0]], [(0, 0), (0, 0)])
    positions, image = still.positions.copy(), still.image_positions.copy()
    for frame, pixel in zip((60, 70, 80, 90), pixels, strict=True):
        positions[frame, 1, :2], image[frame, 1] = synthetic.on_ground(pixel)[:2], pixel
    scene = replace(still, positions=positions, image_positions=image, collisions=())
    return _sufficiency(prediction, scene)


def _sufficiency(prediction: str, scene: Scene) -> float:
    from teacher.predicates.extraction import extract_predicates

    item = synthetic.item((60, 70, 80, 90))
    predicates = extract_predicates(item, scene, None, BOUNDS)
    first, second = (o.noun_phrase for o in scene.objects)
    text = f"Prediction: {prediction.format(b=first, a=second)}\nOutcome: none."
    return measure_sufficiency(text, extract_claims(text, predicates), predicates)


PIXELS = [(100, 60), (100, 160), (400, 60), (120, 250)]


@pytest.mark.parametrize(
    ("prediction", "expected"),
    [
        ("The {a} will be near the top-left.", 1.0),
        ("The {a} will be left of the {b}.", 1 / 3),
        ("The {a} will be left of the {b}. The {a} will be above the {b}.", 1.0),
        ("The {a} will not be left of the {b}.", 0.0),
        ("The {a} will be right of the {b}.", 0.0),
        ("The {b} will be near the center.", 1 / 4),
        ("Nothing is known.", 1 / 4),
        ("The {a} will be near the right.", 1 / 4),
    ],
)  # fmt: skip
def test_sufficiency_is_the_chance_of_a_reader_who_knows_only_the_prediction(
    prediction: str, expected: float
) -> None:
    assert sufficiency_of(prediction, PIXELS) == pytest.approx(expected)


def test_only_the_prediction_counts() -> None:
    for item, predicates in random_cases(20, BOUNDS):
        text = write_rationale(predicates, item, 0)
        claims = extract_claims(text, predicates)
        without = "\n".join(x for x in text.splitlines() if not x.startswith("Prediction"))
        assert find_predicted(text, claims)
        assert measure_sufficiency(without, extract_claims(without, predicates), predicates) == 0.25


@pytest.mark.parametrize("order", list(permutations(range(2))))
def test_interchangeable_objects_state_the_same(order: tuple[int, int]) -> None:
    found = places(a=(0.3, 0.5), b=(0.6, 0.5))
    relations = find_relations(found, BOUNDS)
    names = [(A, B)[k] for k in order]
    value = "left of" if order == (0, 1) else "right of"
    assert normalize_relation(Relation("side", tuple(names), value)) in relations


def test_bounds_of_the_settings_are_those_of_the_predicates() -> None:
    """The schema cannot import the teacher, so that it repeats the bounds."""
    assert Bounds(**asdict(RelationBounds())) == Bounds()
    [problem] = TeacherConfig(name="t", bounds=RelationBounds(against=2.0)).check("teacher.")
    assert "teacher.bounds.against=2" in problem
    [problem] = TeacherConfig(name="t", bounds=RelationBounds(clearly=0.3)).check("teacher.")
    assert "teacher.bounds.clearly=0.3 and teacher.bounds.far=0.25" in problem


def test_analyses_state_what_a_candidate_shows_up_to_the_first_false_statement() -> None:
    walked = 0
    for item, predicates in random_cases(60, BOUNDS):
        writer = RelationalWriter(predicates, choose_statements(predicates), FULL, item.item_id)
        for view in predicates.views:
            false = [s for s in writer.statements if normalize_relation(s) not in view.statements]
            is_off = any(writer.offset(s, view) for s in writer.statements)
            text = writer.comparison(view)
            # Only a relation that has no opposite, such as "between", is denied.
            denied = [writer.instead(s, view) for s in false[:1]]
            assert " not " not in text or "not " in denied[0]
            assert (writer.mismatch(view) is None) == (not false and not is_off)
            if not false:
                assert text == f"shows {writer.all_shown(writer.statements)}"
                continue
            first, *after = writer.statements[writer.statements.index(false[0]) :]
            before = writer.statements[: -1 - len(after)]
            assert {*first.objects} & {n for n in predicates.left_to_right if n in text}
            unsaid = {n for s in after for n in s.objects}
            unsaid -= {n for s in (*before, first) for n in s.objects}
            assert not [n for n in unsaid if n in text]
            if [s.kind for s in before] == ["region"]:
                (one,) = before[0].objects
                assert text.startswith(f"shows the {one} {before[0].value} and ")
                walked += 1
            facts = {o.object: o for o in view.objects}
            if not before and first.kind == "region":
                (one,) = first.objects
                if facts[one].target_sight == "shown":
                    assert text == f"shows the {one} {facts[one].target_region}"
                    assert writer.mismatch(view) == f"{text}, not {first.value}"
    assert walked


@pytest.mark.parametrize(
    ("distance", "extent"),
    [
        (0.0, None), (11.9 / 336, None), (12.1 / 336, "slightly"), (39.9 / 336, "slightly"),
        (40.1 / 336, "clearly"), (0.249, "clearly"), (0.251, "far"),
    ],
)  # fmt: skip
def test_distances_have_the_words_of_their_bounds(distance: float, extent: str | None) -> None:
    assert describe_distance(distance, BOUNDS) == extent


def test_bounds_of_distances_are_settings() -> None:
    near = BOUNDS._replace(displaced=0.01, clearly=0.02, far=0.03)
    words = [describe_distance(distance, near) for distance in (0.005, 0.015, 0.025, 0.035)]
    assert words == [None, "slightly", "clearly", "far"]


def test_only_displaced_objects_are_off() -> None:
    found = set()
    for item, predicates in random_cases(30, BOUNDS):
        writer = RelationalWriter(predicates, choose_statements(predicates), FULL, item.item_id)
        target = predicates.target.places.image
        for view in predicates.views:
            for s in (s for s in predicates.target.statements if s.kind == "region"):
                (name,) = s.objects
                text = writer.offset(s, view)
                shown = view.places.image.get(name)
                is_off = shown is not None and dist(shown, target[name]) >= 12 / 336
                assert (text is not None) == is_off
                found.add(text)
    assert found == {None, "slightly off", "clearly off", "far off"}


def test_the_oracle_checks_how_far_off_an_object_is() -> None:
    extents = ("slightly", "clearly", "far")
    checked = set()
    for _, predicates in random_cases(30, BOUNDS):
        target = predicates.target.places.image
        for view in predicates.views:
            if view.letter == predicates.answer:
                continue
            for s in (s for s in predicates.target.statements if s.kind == "region"):
                (name,) = s.objects
                shown = view.places.image.get(name)
                actual = shown and describe_distance(dist(shown, target[name]), BOUNDS)
                region = f"Candidate {view.letter} shows the {name} {s.value}"
                for extent in extents if actual else ():
                    text = f"Candidate analysis: {region}, {extent} off."
                    claims = [c for c in extract_claims(text, predicates) if c.kind == "displaced"]
                    verdicts = {c.value: c.verdict for c in claims}
                    true = {actual} | ({"clearly"} if actual == "far" else set())
                    expected = "supported" if extent in true else "contradicted"
                    assert verdicts == {extent: expected, "": "supported"}
                    checked.add((extent, expected))
    assert len(checked) == 6


def test_a_rationale_that_does_not_decide_a_decidable_item_is_insufficient() -> None:
    """The paper's words decide fewer items than relations."""
    reasons = {"paper": set(), "relational": set()}
    for item, predicates in random_cases(60, BOUNDS):
        for vocabulary, found in reasons.items():
            cfg = TeacherConfig(name="t", predicates=vocabulary, sufficient=True)
            text = write_rationale(choose_vocabulary(predicates, cfg), item, 0)
            graded = RationaleGrader(cfg).grade(Response(text), predicates, item, 0)
            assert graded.accepted == (graded.sufficiency == 1)
            assert graded.undecided == ("undecided" in graded.reasons)
            found |= {(item.item_id, reason) for reason in graded.reasons}
    insufficient = {i for i, reason in reasons["paper"] if reason == "insufficient"}
    assert insufficient
    assert not {i for i, reason in reasons["relational"] if reason == "insufficient"}
