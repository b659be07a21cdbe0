"""Balanced items: their quotas, candidates and scenes, and bytes that can be repeated."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from dynapix.conf.compose import compose
from dynapix.conf.schema import (
    BenchmarkConfig,
    BuildCommand,
    Quota,
    RetrievalTrackConfig,
    SelectionConfig,
    WorldConfig,
)
from dynapix.data.build import ensure_items
from dynapix.data.items.futures import balanced as balanced_items
from dynapix.data.items.futures.balanced_subset import choose_items
from dynapix.data.items.pickers import CellInputs, shuffle_candidates
from dynapix.data.items.recipes import TIME_CELLS, time_timings
from dynapix.data.items.scores import compare_item, order_target_first
from dynapix.data.oracle.displacement import cross_scene_displacement
from dynapix.data.parallel import Workers
from dynapix.data.records import ALTERNATIVE, SelectionItem, original_scene_id
from dynapix.data.sim.parts import world_boxes
from dynapix.data.sim.shapes import RADIUS, rotation_matrix
from dynapix.data.store import Store
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.train.student.dataset import uses_only
from tests.teacher import synthetic

QUOTAS = {"future_match_gap10": 2, "future_cross_gap10": 2, "contact_offset": 2}


def settings(folder_name: str, **changes) -> BenchmarkConfig:
    cfg = compose("data.build", BuildCommand, ["benchmark=tiny_balanced"]).benchmark
    cfg.name, cfg.scenes = folder_name, 30
    cfg.retrieval = RetrievalTrackConfig(database=0, source=0, counterfactual_source=0)
    cfg.selection = SelectionConfig(
        event={name: Quota(0, test) for name, test in QUOTAS.items()},
        time={"in_1s": Quota(4, 2), "in_2s": Quota(0, 2)},
        window={"G1_A_h16_hard": Quota(0, 2), "G2_B_h24_easy": Quota(0, 2)},
    )
    return replace(cfg, **changes)


@pytest.fixture(scope="module")
def build(tmp_path_factory: pytest.TempPathFactory) -> tuple[Store, list[np.ndarray]]:
    """A small balanced benchmark, and the scores of the items from which its items were chosen."""
    pools = []

    def record(scores: np.ndarray, *args: object) -> list[int]:
        kept = choose_items(scores, *args)
        pools.append(scores[kept])
        return kept

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr("dynapix.data.items.cells.choose_items", record)
        store = ensure_items(settings("balanced"), tmp_path_factory.mktemp("store"), Workers(1))
    return store, pools


@pytest.fixture(scope="module")
def store(build: tuple[Store, list[np.ndarray]]) -> Store:
    return build[0]


@pytest.fixture(scope="module")
def items(store: Store) -> list[SelectionItem]:
    return store.selection()


def is_own(item: SelectionItem, scene_id: str) -> bool:
    return scene_id == item.scene_id


@pytest.mark.slow
def test_families_fill_their_quotas(store: Store, items: list[SelectionItem]) -> None:
    assert {i.family for i in items} == {"event", "time", "window"}
    assert len(items) > 0.7 * (sum(QUOTAS.values()) + 8 + 4)
    assert {i.distractors for i in items} == {"alternative"}


@pytest.mark.slow
def test_alternatives_share_the_past_of_their_scene(
    store: Store, items: list[SelectionItem]
) -> None:
    for item in items:
        scene = store.scene(item.scene_id)
        for candidate in item.candidates:
            other = store.scene(candidate.scene_id)
            assert original_scene_id(candidate.scene_id) == item.scene_id
            if is_own(item, candidate.scene_id):
                continue
            until = item.prefix_stop
            for name in ("positions", "in_view", "visible_fraction"):
                own = getattr(scene, name)[: until + 1]
                np.testing.assert_array_equal(getattr(other, name)[: until + 1], own)
            assert np.abs(other.velocities[until + 1] - scene.velocities[until + 1]).max() > 0
            assert (other.split, other.objects) == (scene.split, scene.objects)


@pytest.mark.slow
def test_items_belong_to_the_scene_whose_futures_they_show(store: Store) -> None:
    """Training leaves out the futures of held-out scenes, and no others."""
    scenes = set(store.scene_ids("train"))
    training = store.selection("train")
    assert training
    for item in training:
        assert uses_only(item, {item.scene_id})
        assert not uses_only(item, scenes - {item.scene_id})


@pytest.mark.slow
def test_only_the_target_shows_the_scene_at_its_moment(
    store: Store, items: list[SelectionItem]
) -> None:
    for item in items:
        frames = [c.frame for c in item.candidates]
        own = [is_own(item, c.scene_id) for c in item.candidates]
        at_moment = [frame == item.target_frame for frame in frames]
        assert [a and b for a, b in zip(own, at_moment, strict=True)].count(True) == 1
        if item.family == "time":
            # Each of the scene's own and another future, at each of two moments.
            assert sorted(zip(own, at_moment, strict=True)) == [
                (False, False), (False, True), (True, False), (True, True),
            ]  # fmt: skip
            assert len(set(frames)) == 2
            assert len({c.scene_id for c in item.candidates}) == 2
        else:
            assert set(frames) == {item.target_frame}


@pytest.mark.parametrize(("subtype", "seconds"), TIME_CELLS.items())
def test_wrong_moments_follow_the_prefix(subtype: str, seconds: float) -> None:
    scene = synthetic.scene([(0.0, -2.0)], [(0.0, 0.8)])
    [timing] = time_timings(seconds, "dynapix", scene)
    rng = np.random.default_rng(0)
    cell = CellInputs({}, lambda _: scene, Quota(), 0, 0.1)
    picker = balanced_items.BalancedPicker(cell, "test", rng, world=WorldConfig(), folder=Path())
    found = set()
    for _ in range(200):
        # Each item counts for one of the sides.
        picker.balance.excess_of("moment")[:] = rng.uniform(-1, 1, 4)
        found.update(picker._wrong_moment(scene, timing, (0,)))
    assert timing.stop < min(found) < timing.target < max(found) < scene.frames
    assert timing.target not in found


@pytest.mark.slow
def test_candidates_differ_visibly(store: Store, items: list[SelectionItem]) -> None:
    for item in items:
        states = [(store.scene(c.scene_id), c.frame) for c in item.candidates]
        least = min(cross_scene_displacement(*a, *b) for a, b in combinations(states, 2))
        assert least >= 12
        assert least == pytest.approx(item.min_displacement, abs=0.1)


def test_hard_distractors_are_nearer_to_the_target_than_easy_ones() -> None:
    places = np.random.default_rng(0).uniform(0, 100, (13, 2))
    displacement = np.linalg.norm(places[:, None] - places[None], axis=-1)
    choices = balanced_items.list_choices(moments=1, futures=12)
    halves = [
        balanced_items.choices_of_difficulty(choices, displacement, is_hard)
        for is_hard in (True, False)
    ]
    near, far = (displacement[0, half[:, 1:]].max(axis=-1) for half in halves)
    assert near.max() <= far.min()
    assert len(near) == len(far) == len(choices) / 2
    assert balanced_items.choices_of_difficulty(choices, displacement, None) is choices


@pytest.mark.slow
def test_predicates_tell_the_candidates_apart(store: Store, items: list[SelectionItem]) -> None:
    facts = [extract_predicates(i, store.scene(i.scene_id), store.scene) for i in items]
    pairs = [(f, i) for f, i in zip(facts, items, strict=True) if f]
    assert len(pairs) > len(items) / 3
    for found, item in pairs:
        assert found.answer == item.letter
        assert not any(candidate.other_objects for candidate in found.candidates)
        assert all(candidate.differences for candidate in found.candidates if not candidate.agrees)


@pytest.mark.slow
def test_alternatives_of_no_item_are_not_kept(store: Store, items: list[SelectionItem]) -> None:
    used = {c.scene_id for i in items for c in i.candidates if ALTERNATIVE in c.scene_id}
    paths = (store.folder / "scenes").glob(f"*{ALTERNATIVE}*.npz")
    assert {path.stem for path in paths} == used


@pytest.mark.slow
def test_bytes_do_not_depend_on_the_number_of_workers(store: Store, tmp_path: Path) -> None:
    again = ensure_items(settings("balanced"), tmp_path, Workers(2))
    assert again.manifest["files"] == store.manifest["files"]
    assert again.identity == store.identity


@pytest.mark.slow
def test_build_with_other_quotas_after_a_kill_leaves_no_alternatives_behind(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def stop(*_: object) -> None:
        raise KeyboardInterrupt

    with monkeypatch.context() as patch:
        patch.setattr("dynapix.data.build.make_databases", stop)
        with pytest.raises(KeyboardInterrupt):
            ensure_items(settings("killed"), tmp_path, Workers(1))
    fewer = settings("killed")
    fewer.selection = replace(fewer.selection, window={}, time={})
    store = ensure_items(fewer, tmp_path, Workers(1))
    used = {c.scene_id for i in store.selection() for c in i.candidates}
    scenes = {Path(name).stem for name in store.manifest["files"] if name.endswith(".npz")}
    assert {name for name in scenes if ALTERNATIVE in name} == {
        name for name in used if ALTERNATIVE in name
    }


@pytest.mark.slow
def test_shuffled_candidates_keep_the_target_and_have_even_letters(
    items: list[SelectionItem],
) -> None:
    shuffled = shuffle_candidates(items, np.random.default_rng(0))
    for before, after in zip(items, shuffled, strict=True):
        assert after.candidates[after.answer] == before.candidates[before.answer]
        assert Counter(after.candidates) == Counter(before.candidates)
    letters = Counter(item.answer for item in shuffled)
    assert max(letters.values()) - min(letters[k] for k in range(4)) <= 1


@pytest.mark.slow
@pytest.mark.parametrize("world", ["falling", "ramp", "screen"])
def test_alternatives_keep_the_laws_of_every_world(tmp_path: Path, world: str) -> None:
    cfg = compose("data.build", BuildCommand, ["benchmark=tiny_balanced", f"world={world}"])
    few = settings("few")
    cfg = replace(cfg.benchmark, scenes=16, selection=few.selection, retrieval=few.retrieval)
    store = ensure_items(cfg, tmp_path, Workers(1))
    items = store.selection()
    assert {i.family for i in items} == {"event", "time", "window"}
    assert {i.distractors for i in items} == {"alternative"}
    for item in items:
        own = store.scene(item.scene_id)
        for candidate in item.candidates:
            scene = store.scene(candidate.scene_id)
            past = slice(item.prefix_stop + 1)
            np.testing.assert_array_equal(scene.positions[past], own.positions[past])
            assert scene.positions[..., 2].min() > 0.1
            for box in world_boxes(cfg.world):
                local = (scene.positions - box.position) @ rotation_matrix(box.quaternion)
                outside = np.linalg.norm(np.maximum(np.abs(local) - box.half, 0), axis=-1)
                assert outside.min() > RADIUS * 0.8


@pytest.mark.slow
def test_scores_of_items_are_those_that_were_balanced(
    build: tuple[Store, list[np.ndarray]], items: list[SelectionItem]
) -> None:
    """The scores that the statistics compute from the store equal those of the builder."""
    store, pools = build
    config = store.manifest["config"]
    scores = np.stack([compare_item(item, store.scene, config).item_scores() for item in items])
    scores = order_target_first(scores, np.array([item.answer for item in items]))
    built = np.concatenate(pools)
    assert len(built) == len(scores)
    # Neither the order of the families nor that of the distractors is the same.
    rows = [np.concatenate([s[..., :1], np.sort(s[..., 1:])], axis=-1) for s in (built, scores)]
    first, second = (r[np.argsort(r[:, 0, 0])] for r in rows)
    np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-6)
