"""The statements that decide an item, and the rationales that rest on them."""

from __future__ import annotations

from dataclasses import replace
from itertools import combinations
from math import dist, hypot

import numpy as np
import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.teacher.narrator import FULL, write_match_lines, write_rationale
from dynapix.teacher.predicates.facts import Relation
from dynapix.teacher.predicates.relations import (
    CHANGES,
    DISPLACED,
    KINDS,
    VALUES,
    describe_distance,
    normalize_relation,
)
from dynapix.teacher.predicates.statement_choice import (
    UNSEEN_DISTANCE,
    choose_statements,
    measure_separation,
)
from dynapix.teacher.validation.claim_extraction import extract_claims
from dynapix.teacher.validation.sufficiency import measure_sufficiency
from dynapix.teacher.validation.validator import validate_rationale
from dynapix.teacher.writers.relational import RelationalWriter
from tests.teacher.test_predicates import random_cases

CFG = TeacherConfig(name="template")


def test_deciding_statements_are_a_place_and_a_smallest_set() -> None:
    """No smaller set of statements excludes what the place does not exclude, by exhaustive
    search."""
    sizes = []
    for _, predicates in random_cases(60, relational=True):
        decision = choose_statements(predicates)
        wrong = [v for v in predicates.views if v.letter != predicates.answer]
        by_statement = {
            s: frozenset(v.letter for v in wrong if s not in v.statements)
            for s in predicates.target.statements
        }
        excluded = {e for s, e in by_statement.items() if s.kind not in CHANGES}
        possible = frozenset().union(*excluded)
        chosen = [by_statement[s] for s in decision.statements]
        assert frozenset().union(*chosen) == frozenset().union(*by_statement.values())
        assert set(decision.rivals) == {v.letter for v in wrong}.difference(*chosen)
        if any(s.kind in CHANGES for s in decision.statements):
            continue
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
    for _, predicates in random_cases(60, relational=True):
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


def test_the_object_does_not_depend_on_which_candidate_is_the_target() -> None:
    """So a student, which sees the candidates only, can learn to choose it."""
    compared = 0
    for _, predicates in random_cases(60, relational=True):
        names = {o.object for o in predicates.objects if o.sight == "shown"}
        everywhere = [names <= v.places.image.keys() for v in predicates.views]
        if not all(everywhere):
            continue
        objects = []
        for view in predicates.views:
            candidates = tuple(
                replace(c, agrees=c.letter == view.letter) for c in predicates.candidates
            )
            supposed = replace(predicates, candidates=candidates)
            objects += choose_statements(supposed).statements[0].objects[:1]
        assert len(set(objects)) == 1
        compared += 1
    assert compared > 3


def test_separation() -> None:
    """The two closest places count; frames that do not show the object are equal."""
    assert measure_separation([(0.1, 0.2), (0.4, 0.6), (0.9, 0.2), (0.4, 0.1)]) == (
        pytest.approx(hypot(0.3, 0.1))
    )
    assert measure_separation([(0.1, 0.2), (0.5, 0.2), (0.9, 0.2), None]) == UNSEEN_DISTANCE
    assert measure_separation([(0.1, 0.2), (0.1, 0.21), None]) == pytest.approx(0.01)
    assert measure_separation([(0.1, 0.2), (0.5, 0.2), None, None]) == 0
    assert measure_separation([(0.5, 0.5)] * 2) == measure_separation([None] * 4) == 0


def test_outcomes_name_the_closest_candidate() -> None:
    named = 0
    for item, predicates in random_cases(250, relational=True):
        text = write_rationale(predicates, item, 0).partition("Outcome: ")[2]
        outcome, *rest = text.partition(".\nAnswer: ")[0].split(". ")
        decision = choose_statements(predicates)
        place = decision.place
        if place is None or "closest" not in outcome:
            continue
        # "Only candidate A agrees" would be false if the words fit another candidate, too.
        assert bool(rest) != bool(decision.rivals)
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
            assert right or dist(there, target) >= DISPLACED
    assert named > 40


def test_every_relational_rationale_is_accepted_and_sufficient() -> None:
    lengths = {"paper": [], "relational": []}
    for item, predicates in random_cases(250, relational=True):
        text = write_rationale(predicates, item, seed=3)
        validation = validate_rationale(text, predicates, item, CFG)
        assert validation.reasons == (), text
        rivals = choose_statements(predicates).rivals
        sufficiency = measure_sufficiency(text, validation.claims, predicates)
        assert sufficiency >= 1 / (1 + len(rivals)), text
        lengths["relational"].append(len(text.split()))
    paper = [len(write_rationale(p, i, seed=3).split()) for i, p in random_cases(250)]
    assert np.mean(lengths["relational"]) < np.mean(paper)


@pytest.mark.parametrize("value", [value for kind in CHANGES for value in VALUES[kind]])
def test_a_change_decides_what_no_state_decides(value: str) -> None:
    item, predicates = next(
        case for case in random_cases(60, relational=True) if len(case[1].target.places.image) > 2
    )
    target = predicates.target
    names = sorted(target.places.image)
    kind = KINDS[value]
    objects = tuple(names[: {"edge": 1, "passing": 2, "arrival": 3}[kind]])
    change = Relation(kind, objects, value)
    states = tuple(r for r in target.relations if r.kind not in CHANGES)
    views = tuple(
        replace(
            target,
            letter=view.letter,
            relations=(*states, change) if view is target else states,
        )
        for view in predicates.views
    )
    predicates = replace(predicates, views=views)
    decision = choose_statements(predicates)
    assert decision.statements == (*filter(None, [decision.place]), change)
    assert not decision.rivals
    text = write_rationale(predicates, item, 0)
    claims = extract_claims(text, predicates)
    stated = [c for c in claims if (c.kind, c.subjects, c.value) == (kind, objects, value)]
    assert {c.candidate: c.affirmed for c in stated if c.candidate} == {
        view.letter: view.letter == predicates.answer for view in views
    }
    assert {c.verdict for c in stated} == {"supported"}, text
    assert measure_sufficiency(text, claims, predicates) == 1


def test_motion_analyses_mention_the_deciding_objects_that_stay() -> None:
    mentioned = 0
    for item, predicates in random_cases(120, relational=True):
        text = write_rationale(predicates, item, seed=0)
        motion = text.partition("Motion analysis: ")[2].partition("\nPrediction")[0]
        if "The objects hardly move" in motion:
            continue
        names = {n for s in choose_statements(predicates).statements for n in s.objects}
        for o in predicates.objects:
            if o.object in names and o.extent == "stays":
                still = "remains where it is" if o.speed == "stationary" else "hardly moves"
                assert f"The {o.object} {still}." in motion, text
                mentioned += 1
    assert mentioned > 10


def test_wrong_candidates_are_compared_with_the_chosen_statements_only() -> None:
    for item, predicates in random_cases(60, relational=True):
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
    for item, predicates in random_cases(250, relational=True):
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
    for item, predicates in random_cases(60, relational=True):
        parse = write_rationale(predicates, item, 0).split("Motion analysis:")[0]
        named = [[n for n in predicates.left_to_right if n in s] for s in parse.split(". ")]
        # Sentences about two objects name the more relevant one first.
        found = dict.fromkeys(names[0] for names in named if len(names) == 1)
        assert [*found] == [n for n in predicates.left_to_right if n in found]
        counts.append(len(found))
    assert max(counts) > 2


def test_match_lines_give_the_verdict_only() -> None:
    for item, predicates in random_cases(20, relational=True):
        lines = write_match_lines(predicates, item)
        for line, view in zip(lines, predicates.views, strict=True):
            verb = "matches" if view.letter == predicates.answer else "does not match"
            assert line == f"Candidate {view.letter} {verb}."


def test_analyses_describe_all_candidates_in_the_same_respects() -> None:
    """So neither the length of a description nor its last statement tells the target."""
    alike = denied = 0
    for item, predicates in random_cases(60, relational=True):
        writer = RelationalWriter(predicates, choose_statements(predicates), FULL, item.item_id)
        if not writer.statements:
            continue
        texts, descriptions = {}, {}
        for view in predicates.views:
            found = [writer.find_shown(s, view) for s in writer.statements]
            texts[view.letter] = text = writer.comparison(view)
            descriptions[view.letter] = {*found}
            for s, (shown, true) in zip(writer.statements, found, strict=True):
                assert true == (normalize_relation(shown) in view.statements)
                assert {*shown.objects} <= {*s.objects}
                assert all(name in text for name in shown.objects)
                if shown.kind != "sight":
                    assert {*shown.objects} == {*s.objects}
                denied += not true
            if found[0][0].kind == "region":
                (one,) = found[0][0].objects
                assert text.startswith(f"shows the {one} {found[0][0].value}")
        target = texts.pop(predicates.answer)
        for letter, text in texts.items():
            same = descriptions[letter] == descriptions[predicates.answer]
            assert same == (text == target)
            alike += same
    assert alike
    assert denied


def test_the_oracle_checks_how_far_off_an_object_is() -> None:
    extents = ("slightly", "clearly", "far")
    checked = set()
    for _, predicates in random_cases(30, relational=True):
        target = predicates.target.places.image
        for view in predicates.views:
            if view.letter == predicates.answer:
                continue
            for s in (s for s in predicates.target.statements if s.kind == "region"):
                (name,) = s.objects
                shown = view.places.image.get(name)
                actual = shown and describe_distance(dist(shown, target[name]))
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
