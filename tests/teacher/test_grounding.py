"""Ungrounded rationales: extrapolated and shuffled facts, with the right answer."""

from __future__ import annotations

import logging
from dataclasses import asdict, replace
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.conf.schema.world import WorldConfig
from dynapix.data.records import Scene
from dynapix.data.store import JOURNAL, Store
from dynapix.teacher.journal import read_rationales
from dynapix.teacher.narrate import narrate_store
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.grounding import Grounding, extrapolate_scene, extrapolate_target
from dynapix.teacher.predicates.vocabulary import describe_item
from dynapix.teacher.validation.validator import validate_rationale
from tests.teacher import synthetic
from tests.user_errors import raises_user_error

GUESSES = ("extrapolated", "shuffled")
CLEVRER = {"config": {"simulator": "bullet", "world": asdict(WorldConfig())}}


def teacher(grounding: str, **settings: object) -> TeacherConfig:
    return TeacherConfig(name="guess", predicates="relational", grounding=grounding, **settings)


@pytest.mark.parametrize("seed", range(20))
def test_a_scene_at_constant_velocity_is_its_own_extrapolation(seed: int) -> None:
    scene = synthetic.random_scene(np.random.default_rng(seed))
    store = SimpleNamespace(manifest=CLEVRER, scene=lambda _: scene, name="synthetic")
    guess = extrapolate_scene(scene, 30, store)
    for name in Scene.ARRAYS:
        # The two cameras differ in what they do with points beside and behind them.
        shown = scene.in_view if name == "image_positions" else np.ones_like(scene.in_view)
        one, other = getattr(guess, name)[shown], getattr(scene, name)[shown]
        np.testing.assert_allclose(one, other, atol=0.01)
    assert [(c.frame, c.objects) for c in guess.collisions] == [
        (c.frame, c.objects) for c in scene.collisions
    ]
    item = synthetic.item((60, 70, 90, 110), answer=2)
    expected = extract_predicates(item, scene, store.scene)
    guessed, scene_of = extrapolate_target(item, store)
    found = extract_predicates(guessed, scene_of(guessed.target.scene_id), scene_of)
    if expected is None:
        assert found is None
    else:
        assert found.objects == expected.objects
        assert found.contacts == expected.contacts
        assert found.observed == expected.observed
        assert [v.objects for v in found.views] == [v.objects for v in expected.views]


def test_an_extrapolation_knows_nothing_after_the_prefix(micro_store: Store) -> None:
    for item in micro_store.training_items()[:20]:
        scene = micro_store.scene(item.target.scene_id)
        stop = item.prefix_stop
        changed = replace(
            scene,
            collisions=tuple(c for c in scene.collisions if c.frame <= stop),
            **{
                name: np.concatenate([values[: stop + 1], values[stop + 1 :][::-1]])
                for name in Scene.ARRAYS
                if (values := getattr(scene, name)) is not None
            },
        )
        one, other = (extrapolate_scene(s, stop, micro_store) for s in (scene, changed))
        assert one.collisions == other.collisions
        for name in Scene.ARRAYS:
            np.testing.assert_array_equal(getattr(one, name), getattr(other, name))


def test_a_guess_describes_the_distractors_as_they_are(micro_store: Store) -> None:
    oracle, guess = TeacherConfig(), replace(TeacherConfig(), grounding="extrapolated")
    others = 0
    for item in micro_store.training_items():
        true = describe_item(item, micro_store, oracle)
        found = Grounding(micro_store, guess).describe(item)
        assert (true is None) == (found is None)
        if true is None or true.instant != found.instant:
            continue
        assert found.answer == true.answer == item.letter
        for a, b in zip(true.views, found.views, strict=True):
            assert a.places == b.places or a.letter == item.letter
        others += found.target.places != true.target.places
    assert others


def test_shuffled_facts_are_those_of_another_scene(micro_store: Store) -> None:
    items = {item.item_id: item for item in micro_store.training_items()}
    cfg, oracle = teacher("shuffled"), teacher("oracle")
    known = {k: describe_item(item, micro_store, oracle) for k, item in items.items()}
    for item_id in [k for k, p in known.items() if p is not None]:
        item = items[item_id]
        found = Grounding(micro_store, cfg).describe(item)
        donors = [items[k] for k, predicates in known.items() if predicates == found]
        assert donors
        assert all(d.scene_id != item.scene_id and d.family == item.family for d in donors)
        assert found.answer == item.letter
        assert found == Grounding(micro_store, cfg).describe(item)


@pytest.mark.parametrize("grounding", GUESSES)
def test_narration_accepts_false_facts_and_no_false_form(
    micro_store: Store, grounding: str, caplog: pytest.LogCaptureFixture
) -> None:
    caplog.set_level(logging.INFO)
    cfg = teacher(grounding)
    grounded = narrate_store(micro_store, teacher("oracle"))
    narration = narrate_store(micro_store, cfg)
    assert [r.item_id for r in narration.rationales] == [r.item_id for r in grounded.rationales]
    items = {item.item_id: item for item in micro_store.training_items()}
    for rationale in narration.rationales:
        assert rationale.answer == items[rationale.item_id].letter
        assert grounding in rationale.predicates
    supported, contradicted, _ = np.sum([*narration.figures["claims"].values()], axis=0)
    assert contradicted > 0.02 * supported
    assert f"teacher.grounding={grounding}: the facts of the rationales are not" in caplog.text
    # The journal keeps the rationales of both groundings apart.
    assert narrate_store(micro_store, teacher("oracle")).rationales == grounded.rationales
    journal = read_rationales(micro_store.folder / JOURNAL)
    assert len({r.predicates for r in journal}) >= 2
    item = items[rationale.item_id]
    facts = describe_item(item, micro_store, cfg)
    numbered = rationale.text.replace("Answer:", "The distance is 2.5 m.\nAnswer:")
    assert not validate_rationale(numbered, facts, item, cfg).accepted
    wrong = f"Answer: {'ABCD'[item.answer - 1]}"
    wrong = rationale.text.replace(f"Answer: {item.letter}", wrong)
    assert validate_rationale(wrong, facts, item, cfg).reasons == (f"wrong answer: {wrong[-1]}",)


def test_a_scene_without_a_camera_cannot_be_extrapolated(tmp_path: Path) -> None:
    scene = synthetic.scene([(0, 0), (1, 1)], [(1, 0), (0, 0)])
    manifest = {"config": {"simulator": "movi_a"}}
    store = SimpleNamespace(manifest=manifest, scene=lambda _: scene, name="movi_a-1")
    with raises_user_error("no-camera", contains="movi_a-1 records no camera"):
        Grounding(store, teacher("extrapolated")).describe(synthetic.item((60, 70, 90, 110)))


def test_sufficient_rationales_need_the_facts_of_the_simulator() -> None:
    problems = [*teacher("shuffled", sufficient=True).find_problems("teacher.")]
    assert any("teacher.sufficient=true and teacher.grounding=shuffled" in p for p in problems)


def test_a_guess_starts_from_the_intervention(micro_store: Store) -> None:
    """The frame after the prefix is the first that an intervention changes."""
    item = next(i for i in micro_store.training_items() if i.prefix_stop + 2 < i.target_frame)
    scene, stop = micro_store.scene(item.scene_id), item.prefix_stop
    moved = {"positions": scene.positions.copy(), "velocities": scene.velocities.copy()}
    moved["positions"][stop + 1 :, 0, 0] += 1
    moved["velocities"][stop + 1 :, 0] *= 3
    other = replace(scene, scene_id=f"{scene.scene_id}-alt-faster", **moved)
    candidates = list(item.candidates)
    candidates[item.answer] = replace(item.target, scene_id=other.scene_id)
    changed = replace(item, candidates=tuple(candidates))
    store = SimpleNamespace(
        manifest=micro_store.manifest,
        name="changed",
        scene=lambda i: other if i == other.scene_id else micro_store.scene(i),
    )
    guessed, scene_of = extrapolate_target(changed, store)
    guess = scene_of(guessed.target.scene_id)
    expected = other.positions[stop + 1] + other.velocities[stop + 1] / scene.fps
    np.testing.assert_allclose(guess.positions[stop + 2], expected, atol=1e-6)
    plain, _ = extrapolate_target(item, micro_store)
    assert guessed.candidates[item.answer] != plain.candidates[item.answer]


def test_an_object_that_rests_stays_in_view(micro_store: Store) -> None:
    item = micro_store.training_items()[0]
    scene, stop = micro_store.scene(item.scene_id), item.prefix_stop
    # Its centre is beside the image, and a part of it is in the image.
    positions, velocities = scene.positions.copy(), scene.velocities.copy()
    positions[:, 0, :2], velocities[:, 0] = (0.0, 9.0), 0.0
    in_view = scene.in_view.copy()
    in_view[:, 0] = True
    still = replace(scene, positions=positions, velocities=velocities, in_view=in_view)
    assert extrapolate_scene(still, stop, micro_store).in_view[:, 0].all()
    velocities = velocities.copy()
    velocities[:, 0, 1] = 1.0
    moving = replace(still, velocities=velocities)
    assert not extrapolate_scene(moving, stop, micro_store).in_view[stop + 1 :, 0].any()


def test_nothing_is_said_of_contacts_where_none_are_recorded() -> None:
    scene = synthetic.scene([(-1, 0), (1, 0)], [(1, 0), (-1, 0)])
    store = SimpleNamespace(manifest=CLEVRER, name="synthetic")
    assert extrapolate_scene(scene, 10, store).collisions
    unknown = replace(scene, records_contacts=False, collisions=())
    assert not extrapolate_scene(unknown, 10, store).collisions


def test_false_facts_do_not_replace_the_table_of_rationales(micro_store: Store) -> None:
    narrate_store(micro_store, teacher("oracle"))
    before = micro_store.rationales()
    assert narrate_store(micro_store, teacher("shuffled")).rationales != before
    assert micro_store.rationales() == before
