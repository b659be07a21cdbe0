"""Balanced items: alternative futures, even ranks of the target, and bytes that can be repeated."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from conf.compose import compose
from conf.schema import BenchmarkConfig, BuildCommand, Quota, RetrievalTrackConfig, SelectionConfig
from data.build import ensure_items
from data.parallel import Workers
from data.records import ALTERNATIVE, Scene, SelectionItem, original_scene_id
from data.store import Store, built_files
from data.tracks.quota import shuffle_candidates
from data.tracks.selection import balanced
from data.tracks.selection.balance import (
    LIMIT,
    SCORES,
    TOLERANCE,
    Balance,
    compare_candidates,
    rank_shares,
)
from data.tracks.selection.futures import (
    MOVING,
    alternative_scene,
    joint_groups,
    moving_objects,
    sample_velocities,
    simulate_futures,
)
from data.tracks.selection.pooling import choose_items, item_deviations
from data.tracks.shortcuts import (
    fit_logistic,
    item_scores,
    logistic_accuracies,
    order_target_first,
    simple_accuracies,
)
from data.tracks.shortfalls import summarize_store
from data.world.displacement import cross_scene_displacement
from data.world.parts import world_boxes
from data.world.physics import shared_simulator
from data.world.shapes import RADIUS, rotation_matrix
from teacher.predicates.extraction import extract_predicates
from tests.data.simulated import CLEVRER, simulate_scene
from train.student.dataset import uses_only

QUOTAS = {"future_match_gap10": 2, "future_cross_gap10": 2, "contact_offset": 2}


def settings(folder_name: str, **changes) -> BenchmarkConfig:
    cfg = compose("data.build", BuildCommand, ["benchmark=tiny_balanced"]).benchmark
    cfg.name, cfg.scenes = folder_name, 30
    cfg.retrieval = RetrievalTrackConfig(standard=0, database=0, source=0, counterfactual_source=0)
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
        patch.setattr("data.tracks.build_items.choose_items", record)
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
def test_short_cells_are_named_with_the_settings_to_change(tmp_path: Path) -> None:
    selection = replace(settings("short").selection, min_displacement=90.0, time={}, window={})
    cfg = settings("short", scenes=6, selection=selection)
    cfg.retrieval.builders = {"1": Quota(2, 0)}
    summary = summarize_store(ensure_items(cfg, tmp_path, Workers(1)))
    assert "short: event/contact_offset/test has 0 of 2" in summary
    assert "raise benchmark.scenes" in summary.splitlines()[-1]


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


@pytest.mark.slow
def test_candidates_differ_visibly(store: Store, items: list[SelectionItem]) -> None:
    for item in items:
        states = [(store.scene(c.scene_id), c.frame) for c in item.candidates]
        least = min(cross_scene_displacement(*a, *b) for a, b in combinations(states, 2))
        assert least >= 12
        assert least == pytest.approx(item.min_displacement, abs=0.1)


def test_hard_distractors_are_nearer_to_the_target_than_easy_ones() -> None:
    places = rng().uniform(0, 100, (14, 2))
    displacement = np.linalg.norm(places[:, None] - places[None], axis=-1)
    choices = balanced._choices(moments=1, futures=12)
    halves = [balanced._of_difficulty(choices, displacement, nearest) for nearest in (True, False)]
    near, far = (displacement[1, half[:, 1:]].max(axis=-1) for half in halves)
    assert near.max() <= far.min()
    assert len(near) == len(far) == len(choices) / 2
    assert balanced._of_difficulty(choices, displacement, None) is choices


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
        patch.setattr("data.build.remove_unused_futures", stop)
        with pytest.raises(KeyboardInterrupt):
            ensure_items(settings("killed"), tmp_path, Workers(1))
    fewer = settings("killed")
    fewer.selection = replace(fewer.selection, window={}, time={})
    store = ensure_items(fewer, tmp_path, Workers(1))
    used = {c.scene_id for i in store.selection() for c in i.candidates}
    scenes = {Path(name).stem for name in built_files(store.folder) if name.endswith(".npz")}
    assert {name for name in scenes if ALTERNATIVE in name} == {
        name for name in used if ALTERNATIVE in name
    }


@pytest.fixture(scope="module")
def scene() -> Scene:
    return simulate_scene(0, 3)


def rng() -> np.random.Generator:
    return np.random.default_rng(0)


def single_groups(scene: Scene, frame: int) -> list[tuple[int, ...]]:
    """Each moving object as a group of its own."""
    return [(k,) for k in moving_objects(scene, frame, range(len(scene.objects)))]


def test_branch_with_the_true_velocities_continues_the_scene(scene: Scene) -> None:
    true = np.concatenate([scene.velocities[40], scene.angular_velocities[40]], axis=-1)
    (states,) = simulate_futures(scene, 40, 70, true[None].astype(float), CLEVRER)
    np.testing.assert_allclose(states[:, :, :3], scene.positions[40:71], atol=0.01)


def test_futures_do_not_depend_on_earlier_simulations(scene: Scene) -> None:
    velocities = sample_velocities(scene, 40, single_groups(scene, 40), 4, 1, rng())
    first = simulate_futures(scene, 40, 60, velocities, CLEVRER)
    simulate_scene(0, 5)
    np.testing.assert_array_equal(simulate_futures(scene, 40, 60, velocities, CLEVRER), first)
    shared_simulator.cache_clear()
    np.testing.assert_array_equal(simulate_futures(scene, 40, 60, velocities, CLEVRER), first)


def test_alternative_scene_joins_past_and_future(scene: Scene) -> None:
    velocities = sample_velocities(scene, 50, single_groups(scene, 50), 1, 0, rng())
    (states,) = simulate_futures(scene, 50, 64, velocities, CLEVRER)
    other = alternative_scene(scene, "other", 50, states, CLEVRER)
    assert other.frames == 65
    np.testing.assert_array_equal(other.positions[:51], scene.positions[:51])
    np.testing.assert_allclose(other.positions[50:], states[:, :, :3], atol=1e-6)


@pytest.mark.parametrize("quarter", range(4))
def test_true_speed_lies_in_its_quarter_of_all_speeds(scene: Scene, quarter: int) -> None:
    random = rng()
    group, *_ = single_groups(scene, 40)
    true = np.linalg.norm(scene.velocities[40, group[0], :2])
    assert true > MOVING
    lower = []
    for _ in range(40):
        velocities = sample_velocities(scene, 40, [group], 50, quarter, random)
        lower.append(np.linalg.norm(velocities[:, group[0], :2], axis=-1) < true)
    assert np.mean(lower) == pytest.approx((quarter + 0.5) / 4, abs=0.04)


def test_objects_that_collide_keep_their_relative_velocity(scene: Scene) -> None:
    every = range(len(scene.objects))
    stop, target = 40, 52
    met = [c.objects for c in scene.collisions if stop < c.frame <= target]
    groups = joint_groups(scene, stop, target, every)
    assert sorted(k for group in groups for k in group) == list(every)
    assert met
    for pair in met:
        (group,) = (g for g in groups if pair[0] in g)
        assert pair[1] in group
        velocities = sample_velocities(scene, stop, [group], 6, 1, rng())[..., :3]
        relative = velocities[:, pair[0]] - velocities[:, pair[1]]
        true = scene.velocities[stop, pair[0]] - scene.velocities[stop, pair[1]]
        np.testing.assert_allclose(relative, np.tile(true, (6, 1)), atol=1e-6)
        assert np.abs(velocities - scene.velocities[stop]).max() > 0.05
    assert joint_groups(scene, stop, stop, [0, 2]) == [(0,), (2,)]


def test_only_objects_whose_velocity_can_be_observed_get_another(scene: Scene) -> None:
    every = range(len(scene.objects))
    chosen = moving_objects(scene, 40, every)
    hidden = replace(scene, visible_fraction=scene.visible_fraction.copy())
    hidden.visible_fraction[37, chosen[0]] = 0.0
    assert len(chosen) > 1
    assert moving_objects(hidden, 40, every) == chosen[1:]


def test_shares_of_ranks_are_a_distribution_that_splits_ties() -> None:
    shares = rank_shares(np.array([[2.0, 1.0, 3.0, 4.0], [1.0, 1.0, 1.0, 2.0], [5.0] * 4]))
    np.testing.assert_allclose(shares, [[0, 1, 0, 0], [1 / 3, 1 / 3, 1 / 3, 0], [1 / 4] * 4])


def test_nearly_equal_scores_are_lowest_together() -> None:
    """The precision of stored scenes does not decide which candidate is lowest or highest."""
    scores = np.array([[10.0, 10.0004, 12.0, 15.0]])
    _, lowest, highest = compare_candidates(scores)
    assert lowest.tolist() == [1, 1, 0, 0]
    assert highest.tolist() == [0, 0, 0, 1]


def test_balance_keeps_every_count_within_the_limit() -> None:
    random = rng()
    balance, refused = Balance(random), 0
    for _ in range(200):
        # The target is often the lowest, so that an unbalanced choice would reveal it.
        scores = random.normal(size=(len(SCORES), 30, 4))
        scores[..., 0] -= random.uniform(0, 1)
        refused += balance.choose(scores) is None
        assert np.abs(balance.counts - balance.items / 4).max() <= LIMIT + TOLERANCE * balance.items
    assert balance.items > 150
    only_lowest = np.tile([0.0, 1.0, 2.0, 3.0], (len(SCORES), 1, 1))
    assert [balance.choose(only_lowest) is None for _ in range(4)][-1]


def test_balance_accepts_items_that_make_the_counts_more_even() -> None:
    """If the targets have the lowest rank in all scores too seldom, no item of some other ranks is
    within the limit, but most make the counts more even."""
    random = rng()
    balance = Balance(random)
    balance.counts = np.tile([-LIMIT, LIMIT / 3, LIMIT / 3, LIMIT / 3], (len(SCORES), 1))
    accepted = [
        balance.choose(random.normal(size=(len(SCORES), 12, 4))) is not None for _ in range(40)
    ]
    assert sum(accepted) > 30
    assert np.abs(balance.counts - balance.items / 4).max() < LIMIT


def test_choice_from_a_pool_fills_quotas_and_removes_a_joint_shortcut() -> None:
    random = rng()
    scores = random.normal(size=(600, len(SCORES), 4))
    # The sum of two scores reveals the target of every second item.
    scores[::2, :2, 0] += 1.5
    cells = random.choice(["a", "b", "c"], size=600).tolist()
    quotas = {"a": 100, "b": 120, "c": 1000}
    kept = choose_items(scores, cells, quotas, random)
    assert Counter(cells[k] for k in kept) == {"a": 100, "b": 120, "c": cells.count("c")}
    assert kept == sorted(set(kept))

    def deviation(chosen: list[int]) -> float:
        return float((item_deviations(scores)[chosen].sum(axis=0) ** 2).sum())

    first = [k for cell, n in quotas.items() for k in np.flatnonzero(np.array(cells) == cell)[:n]]
    assert deviation(kept) < 0.7 * deviation(first)
    fair = random.normal(size=(600, len(SCORES), 4))
    even = item_deviations(fair)[choose_items(fair, ["a"] * 600, {"a": 500}, random)]
    assert np.abs(even.mean(axis=0)).max() < 0.02


@pytest.mark.slow
def test_shuffled_candidates_keep_the_target_and_have_even_letters(
    items: list[SelectionItem],
) -> None:
    shuffled = shuffle_candidates(items, rng())
    for before, after in zip(items, shuffled, strict=True):
        assert after.candidates[after.answer] == before.candidates[before.answer]
        assert Counter(after.candidates) == Counter(before.candidates)
    letters = Counter(item.answer for item in shuffled)
    assert max(letters.values()) - min(letters[k] for k in range(4)) <= 1


def test_simple_strategies_score_shares_of_ties() -> None:
    scores = np.zeros((2, len(SCORES), 4))
    scores[:, 0] = [3.0, 1.0, 2.0, 2.0]
    right = simple_accuracies(scores, np.array([1, 0]))
    np.testing.assert_allclose(right[:, :2], [[1, 0], [0, 1]])
    np.testing.assert_allclose(right[:, 2:], 0.25)


def test_logistic_model_finds_a_shortcut_and_nothing_without_one() -> None:
    random = rng()
    answers = random.integers(4, size=1200)
    scores = random.normal(size=(1200, len(SCORES), 4))
    nothing = fit_logistic(compare_candidates(scores).swapaxes(1, 2), answers)
    assert np.abs(nothing).max() < 0.2
    # The target is slightly high or low in six scores: none alone is decisive.
    rows = np.arange(1200)
    for score in (0, 2, 4):
        scores[rows, score, answers] += 0.6
        scores[rows, score + 1, answers] -= 0.6

    class Item:
        family = "event"

        def __init__(self, split: str) -> None:
            self.split = split

    items = [Item("train" if k < 800 else "test") for k in range(1200)]
    right = logistic_accuracies(items, scores, answers)
    assert np.isnan(right[:800]).all()
    simple = simple_accuracies(scores, answers)[800:].mean(axis=0)
    assert np.mean(right[800:]) > simple.max() + 0.05 > 0.4


@pytest.mark.slow
@pytest.mark.parametrize(
    "world", ["dusk", "falling", "masses", "near", "ramp", "screen", "settling"]
)
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
    scores = np.stack([item_scores(item, store.scene, config) for item in items])
    scores = order_target_first(scores, np.array([item.answer for item in items]))
    built = np.concatenate(pools)
    assert len(built) == len(scores)
    # Neither the order of the families nor that of the distractors is the same.
    rows = [np.concatenate([s[..., :1], np.sort(s[..., 1:])], axis=-1) for s in (built, scores)]
    first, second = (r[np.argsort(r[:, 0, 0])] for r in rows)
    np.testing.assert_allclose(first, second, rtol=1e-6, atol=1e-6)
