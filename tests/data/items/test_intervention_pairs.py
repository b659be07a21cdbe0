"""Tests of the pairs of items about interventions."""

from __future__ import annotations

from dataclasses import replace
from itertools import product
from pathlib import Path

import numpy as np
import pytest

from dynapix.conf.schema import Quota
from dynapix.conf.schema.world import ByMaterial
from dynapix.data.items.controls import pair_items
from dynapix.data.items.futures.contact import collision_timings
from dynapix.data.items.futures.interventions import (
    InterventionPicker,
    find_interventions,
    join_collisions,
    make_intervention_pair,
    make_intervention_recipe,
)
from dynapix.data.items.futures.simulation import scene_states, simulate_futures
from dynapix.data.items.pickers import CellInputs, fill_quota
from dynapix.data.records import Candidate, Scene, SelectionItem
from dynapix.data.sim.physics import Branch, shared_simulator
from dynapix.data.store import load_scene, scene_path
from dynapix.evaluation.metrics.significance import score_pairs
from tests.data.simulated import CLEVRER, simulate_scene

MASSES = replace(
    CLEVRER,
    name="masses",
    objects=replace(CLEVRER.objects, mass=ByMaterial(metal=3.0, rubber=0.5)),
)


@pytest.fixture(scope="module")
def scenes() -> dict[str, Scene]:
    return {scene.scene_id: scene for scene in (simulate_scene(0, k) for k in range(24))}


@pytest.fixture(scope="module", params=["absent", "faster", "other_side"])
def made(
    request: pytest.FixtureRequest,
    scenes: dict[str, Scene],
    tmp_path_factory: pytest.TempPathFactory,
) -> tuple[list[tuple[SelectionItem, SelectionItem]], Path]:
    folder = tmp_path_factory.mktemp("store")
    (folder / "scenes").mkdir()
    ids = {"train": [*scenes], "test": []}
    cell = CellInputs(ids, scenes.__getitem__, Quota(3, 0), 0, 12.0)

    def picker(*arguments: object) -> InterventionPicker:
        return InterventionPicker(*arguments, world=CLEVRER, folder=folder)

    recipe = make_intervention_recipe(request.param)
    items, _ = fill_quota(f"interventions/{request.param}", recipe, cell, picker)
    assert items
    return [make_intervention_pair(item, scenes[item.scene_id]) for item in items], folder


def test_the_items_of_a_pair_differ_in_question_and_answer_alone(made) -> None:
    pairs, _ = made
    for actual, changed in pairs:
        assert actual.question != changed.question
        assert actual.answer != changed.answer
        frames = [[(c.scene_id, c.frame) for c in item.candidates] for item in (actual, changed)]
        assert frames[0] == frames[1]
        assert actual.prefix_stop == changed.prefix_stop < actual.target_frame
        assert {frame for _, frame in frames[0]} == {actual.target_frame}
    assert pair_items([item for pair in pairs for item in pair]) == pairs


def test_futures_share_the_past_and_record_their_contacts(made, scenes: dict[str, Scene]) -> None:
    pairs, folder = made
    for actual, changed in pairs:
        scene, stop = scenes[actual.scene_id], actual.prefix_stop
        future = load_scene(scene_path(folder, changed.target.scene_id))
        np.testing.assert_array_equal(future.positions[: stop + 1], scene.positions[: stop + 1])
        past = [(c.objects, c.frame) for c in scene.collisions if c.frame <= stop]
        assert [(c.objects, c.frame) for c in future.collisions if c.frame <= stop] == past


def test_a_vanished_object_is_in_no_candidate(made, scenes: dict[str, Scene]) -> None:
    pairs, folder = made
    for actual, _ in pairs:
        if actual.subtype != "absent":
            assert "None of the four images" not in actual.question
            assert actual.target.scene_id == actual.scene_id
            continue
        futures = [load_scene(scene_path(folder, c.scene_id)) for c in actual.candidates]
        shown = np.stack([each.in_view[actual.target_frame] for each in futures])
        gone = np.flatnonzero(~shown.any(axis=0))
        names = [scenes[actual.scene_id].objects[k].noun_phrase for k in gone]
        assert any(
            f"None of the four images shows the {name}." in actual.question for name in names
        )


def first_timing(scene: Scene) -> int | None:
    return next((timing.stop for timing in collision_timings(16, scene)), None)


def test_without_an_object_the_others_move_as_if_it_had_never_been(
    scenes: dict[str, Scene],
) -> None:
    checked = 0
    for scene in scenes.values():
        if (stop := first_timing(scene)) is None:
            continue
        for change in find_interventions("absent", scene, stop, CLEVRER):
            (motion,) = simulate_futures(scene, stop, stop + 19, [change.branch], CLEVRER)
            rest = [k for k in range(len(scene.objects)) if k != change.changed]
            states = scene_states(scene)[stop, rest].astype(float)
            objects, scales = (
                [each[k] for k in rest] for each in (scene.objects, scene.object_scales)
            )
            (alone,) = shared_simulator().simulate_branches(
                objects, scales, states, [Branch(states)], CLEVRER, 20
            )
            np.testing.assert_allclose(motion.positions[:, rest], alone.positions, atol=1e-6)
            checked += 1
    assert checked


def test_only_a_world_of_two_masses_has_questions_about_mass(scenes: dict[str, Scene]) -> None:
    stops = {name: stop for name, scene in scenes.items() if (stop := first_timing(scene))}
    for change in ("heavier", "lighter"):
        assert not any(
            [*find_interventions(change, scenes[name], stop, CLEVRER)]
            for name, stop in stops.items()
        )
        found = [
            (
                scenes[name].objects[each.changed].material,
                max(each.branch.masses, key=lambda m: abs(m - 1)),
            )
            for name, stop in stops.items()
            for each in find_interventions(change, scenes[name], stop, MASSES)
        ]
        expected = {"heavier": ("rubber", 6.0), "lighter": ("metal", 1 / 6)}[change]
        assert {*found} == {expected}


def test_an_object_on_the_other_side_comes_from_the_mirrored_place(
    scenes: dict[str, Scene],
) -> None:
    checked = 0
    for scene in scenes.values():
        if (stop := first_timing(scene)) is None:
            continue
        before = scene_states(scene)[stop].astype(float)
        for each in find_interventions("other_side", scene, stop, CLEVRER):
            after, k = each.branch.states, each.changed
            moved = np.flatnonzero((before != after).any(axis=-1))
            assert moved.tolist() == [k]
            np.testing.assert_allclose(
                np.linalg.norm(after[k, 7:9]), np.linalg.norm(before[k, 7:9])
            )
            middle = (before[k, :2] + after[k, :2]) / 2
            assert np.abs(before[:, :2] - middle).sum(axis=-1).min() < 1e-6
            checked += 1
    assert checked


def test_the_contacts_of_an_unchanged_continuation_are_those_of_the_scene(
    scenes: dict[str, Scene],
) -> None:
    same = []
    for scene in scenes.values():
        if (stop := first_timing(scene)) is None:
            continue
        branch = Branch(scene_states(scene)[stop].astype(float))
        (motion,) = simulate_futures(scene, stop, stop + 10, [branch], CLEVRER)
        joined = [(c.objects, c.frame) for c in join_collisions(scene, stop, motion)]
        expected = [(c.objects, c.frame) for c in scene.collisions if c.frame <= stop + 10]
        same.append(joined == expected)
    # A continuation may stray by a frame, because Bullet keeps contacts from step to step.
    assert np.mean(same) > 0.8


def made_up_pairs(count: int) -> list[SelectionItem]:
    """Pairs whose answers are A and B."""
    items = []
    for k in range(count):
        frames = [("target", f"s{k}"), ("intervention", f"s{k}-alt-absent-0-5-9-2")]
        frames += [("alternative", f"s{k}-alt-absent-0-5-9-{j}") for j in (3, 4)]
        candidates = tuple(Candidate(scene, 9, source) for source, scene in frames)
        actual = SelectionItem(
            f"a{k}", "test", "interventions", "event", "absent", "?", f"s{k}", 0, 5, 9,
            candidates, 0, 12.0, framing="future",
        )  # fmt: skip
        exchanged = [replace(c, source="actual") for c in candidates[:1]]
        exchanged += [replace(candidates[1], source="target"), *candidates[2:]]
        items += [
            actual,
            replace(
                actual, item_id=f"c{k}", candidates=tuple(exchanged), answer=1,
                framing="intervention",
            ),
        ]  # fmt: skip
    return items


def test_interventions_on_one_collision_are_pairs_of_their_own() -> None:
    items = made_up_pairs(1)
    others = [replace(i, item_id=f"faster-{i.item_id}", subtype="faster") for i in items]
    pairs = pair_items([items[0], *others, items[1]])
    assert pairs == [(items[0], items[1]), (others[0], others[1])]
    assert pair_items([items[0], others[1]]) == []


def score(answers: list[tuple[str, str]]) -> dict[str, float]:
    """The scores of the answers to pairs, those of the actual item first."""
    items = made_up_pairs(len(answers))
    given = dict(
        zip((i.item_id for i in items), (x for pair in answers for x in pair), strict=True)
    )
    credits = {i.item_id: float(given[i.item_id] == i.letter) for i in items}
    *_, overall = score_pairs(items, credits, given, seed=0)
    assert overall.of == "all"
    names = ("actual", "changed", "both", "ignored")
    return {name: getattr(overall, name).value for name in names}


def test_ignoring_the_intervention_gets_no_pair() -> None:
    assert score([("A", "A")] * 6) == {"actual": 1, "changed": 0, "both": 0, "ignored": 1}
    assert score([("A", "B")] * 6) == {"actual": 1, "changed": 1, "both": 1, "ignored": 0}


def test_guesses_get_the_stated_shares_of_pairs() -> None:
    assert score([*product("ABCD", repeat=2)])["both"] == pytest.approx(1 / 16)
    different = [pair for pair in product("ABCD", repeat=2) if pair[0] != pair[1]]
    assert score(different)["both"] == pytest.approx(1 / 12)


def test_masses_of_a_world_are_checked_before_its_scenes_are_simulated() -> None:
    from dynapix.conf.compose import compose
    from dynapix.conf.errors import SettingsError
    from dynapix.conf.schema import BuildCommand

    overrides = ["benchmark=tiny_interventions", "world=above"]
    with pytest.raises(SettingsError, match=r"metal is not heavier than rubber.*world=masses"):
        compose("data.build", BuildCommand, overrides)
