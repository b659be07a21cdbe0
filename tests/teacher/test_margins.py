"""How clearly statements are true or false, and the choice of clear ones."""

from __future__ import annotations

from dataclasses import replace
from unittest.mock import patch

import numpy as np
import pytest

from dynapix.teacher.predicates import statement_choice
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.facts import REGIONS, Relation, RelationalPredicates
from dynapix.teacher.predicates.margins import find_relations, measure_margin
from dynapix.teacher.predicates.relations import CHANGES, VALUES, Places, normalize_relation
from dynapix.teacher.predicates.statement_choice import choose_statements
from dynapix.teacher.prompts import format_facts
from tests.teacher import synthetic
from tests.teacher.test_predicates import random_cases
from tests.teacher.test_relations import A, B, C, places, random_places

IN_THE_IMAGE = ("region", "side", "height", "between", "extreme")
"""Kinds of statements whose margins are exact. Gaps and distances are measured on the ground."""


def all_statements(where: Places) -> list[Relation]:
    """Every statement of the vocabulary about the objects, true or false."""
    names, numbers = sorted(where.image), {"between": 3, "nearer": 3, "extreme": 1}
    found = [Relation("region", (n,), region) for n in names for row in REGIONS for region in row]
    for kind, words in VALUES.items():
        if kind not in CHANGES:
            some = np.array(np.meshgrid(*[names] * numbers.get(kind, 2))).reshape(
                numbers.get(kind, 2), -1
            )
            different = [tuple(map(str, o)) for o in some.T if len(set(o)) == len(o)]
            found += [Relation(kind, objects, value) for objects in different for value in words]
    return found


def true_statements(where: Places) -> set[Relation]:
    regions = {
        Relation("region", (name,), REGIONS[min(int(3 * y), 2)][min(int(3 * x), 2)])
        for name, (x, y) in where.image.items()
    }
    return find_relations(where) | regions


def move(where: Places, name: str, step: np.ndarray) -> Places:
    """Move an object in the image."""
    x, y = where.image[name] + step
    image = {**where.image, name: (float(x), float(y))}
    return where._replace(image=image)


@pytest.mark.parametrize("seed", range(20))
def test_margins_are_positive_exactly_for_true_statements(seed: int) -> None:
    where = random_places(seed)
    true = true_statements(where)
    for statement in all_statements(where):
        margin = measure_margin(statement, where)
        assert (margin >= 0) == (normalize_relation(statement) in true), statement


@pytest.mark.parametrize("seed", range(20))
def test_statements_keep_their_truth_if_an_object_moves_by_less_than_the_margin(seed: int) -> None:
    rng = np.random.default_rng(seed)
    where = random_places(seed)
    for statement in all_statements(where):
        if statement.kind not in IN_THE_IMAGE:
            continue
        margin = measure_margin(statement, where)
        angle = rng.uniform(0, 2 * np.pi)
        step = 0.99 * min(abs(margin), 0.5) * np.array([np.cos(angle), np.sin(angle)])
        if statement.kind == "between":
            # If an end moves, the bounds move with the line.
            name = statement.objects[0]
        else:
            name = statement.objects[rng.integers(len(statement.objects))]
        moved = measure_margin(statement, move(where, name, step))
        assert (moved >= 0) == (margin >= 0), statement


def test_margins_have_a_closed_form() -> None:
    where = places(a=(0.30, 0.5), b=(0.50, 0.56), c=(0.9, 0.9))
    margins = {
        Relation("side", (A, B), "left of"): 0.20 - 0.04,
        Relation("side", (A, B), "aligned with"): 0.04 - 0.20,
        Relation("side", (A, B), "right of"): -0.20 - 0.04,
        Relation("height", (A, B), "above"): 0.06 - 0.04,
        Relation("region", (A,), "near the left"): 1 / 3 - 0.30,
        Relation("region", (A,), "near the center"): 0.30 - 1 / 3,
        Relation("region", (C,), "near the bottom-right"): 0.9 - 2 / 3,
        Relation("extreme", (A,), "leftmost"): 0.20 - 0.04,
        Relation("extreme", (B,), "leftmost"): -0.20 - 0.04,
    }
    for statement, expected in margins.items():
        assert measure_margin(statement, where) == pytest.approx(expected)


def test_margins_of_gaps_are_distances_in_the_image() -> None:
    """With ten units of the ground per width of the image, objects of width one at a distance of
    one and a half are half a width apart, and 0.05 of the image's width from not being near."""
    where = places(a=(0.3, 0.5), b=(0.45, 0.5))
    near = measure_margin(Relation("gap", (A, B), "near"), where)
    assert near == pytest.approx((1.5 - 1.15) / 10)
    apart = measure_margin(Relation("gap", (A, B), "apart from"), where)
    assert apart == pytest.approx((1.5 - 2) / 10)


def test_statements_about_unseen_objects_are_hardly_clear() -> None:
    where = places(a=(0.3, 0.5))
    for statement in (
        Relation("region", (B,), "near the left"),
        Relation("side", (A, B), "left of"),
    ):
        assert -0.02 < measure_margin(statement, where) < 0
    assert 0 < measure_margin(Relation("sight", (B,), "unseen"), where) < 0.02
    assert -0.02 < measure_margin(Relation("sight", (A,), "unseen"), where) < 0


def choose_with_margins(
    predicates: RelationalPredicates, statement: Relation, factor: float, others: float
) -> tuple[Relation, ...]:
    """Choose with the margins of a statement, and those of all others, multiplied."""

    def measure_scaled(s: Relation, where: Places) -> float:
        return measure_margin(s, where) * (factor if s == statement else others)

    with patch.object(statement_choice, "measure_margin", measure_scaled):
        return choose_statements(predicates).statements


def test_clear_statements_are_chosen() -> None:
    """A statement that excludes what the place does not exclude is chosen if it is clear and the
    others are not, and is replaced by another one if its own margins shrink."""
    tried = 0
    for _, predicates in random_cases(150, relational=True):
        place, *chosen = choose_statements(predicates).statements
        left = [
            v for v in predicates.views if v.letter != predicates.answer and place in v.statements
        ]
        alone = [
            s
            for s in sorted(predicates.target.statements)
            if s.kind not in CHANGES and not any(s in v.statements for v in left)
        ]
        if place.kind != "region" or not left or len(alone) < 2:
            continue
        tried += 1
        for statement in alone:
            if statement.kind != "sight" and set(statement.objects) <= predicates.paths.keys():
                clear = choose_with_margins(predicates, statement, 1e6, 0.01)
                assert clear == (place, statement)
        if len(chosen) == 1:
            assert chosen[0] not in choose_with_margins(predicates, *chosen, 1e-6, 1)
    assert tried > 10


def test_objects_with_short_paths_are_preferred() -> None:
    """If the path of one object grows, fewer of the statements after the place are about it."""
    before = after = 0
    for _, predicates in random_cases(150, relational=True):
        name = predicates.objects[0].object
        longer = replace(predicates, paths={**predicates.paths, name: 5.0})
        before += any(name in s.objects for s in choose_statements(predicates).statements[1:])
        after += any(name in s.objects for s in choose_statements(longer).statements[1:])
    assert after < before


def test_item_whose_objects_all_look_alike_has_no_statements() -> None:
    scene = synthetic.random_scene(np.random.default_rng(3))
    twins = replace(scene, objects=(scene.objects[0],) * len(scene.objects))
    item = synthetic.item((45, 60, 75, 90))
    predicates = extract_predicates(item, twins, {}.__getitem__)
    decision = choose_statements(predicates)
    assert decision.statements == ()
    assert decision.rivals == ("B", "C", "D")


def test_prompts_have_the_deciding_statements_and_their_truth_in_each_candidate() -> None:
    for item, predicates in random_cases(30, relational=True):
        stated = format_facts(predicates)["deciding"]
        for statement, fact in zip(choose_statements(predicates).statements, stated, strict=True):
            assert all(name in fact["statement"] for name in statement.objects)
            for view in predicates.views:
                is_true = statement in view.statements
                assert (fact["candidates"][view.letter] is True) == is_true
        assert all(fact["candidates"][item.letter] is True for fact in stated)
