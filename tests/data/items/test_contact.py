"""Contact items: their candidates are outcomes of one collision, and no simple rule tells them."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import combinations
from pathlib import Path

import numpy as np
import pytest

from dynapix.conf.compose import compose
from dynapix.conf.errors import UserError
from dynapix.conf.schema import (
    BenchmarkConfig,
    BuildCommand,
    Quota,
    RetrievalTrackConfig,
    SelectionConfig,
)
from dynapix.data.build import check_quota_names, empty_benchmark, ensure_items
from dynapix.data.checks.counts import summarize_store
from dynapix.data.checks.statistics import compute_statistics, format_statistics
from dynapix.data.items.futures.contact import (
    APART,
    CELLS,
    GHOST_SHARE,
    LEAD,
    OBSERVED,
    collision_timings,
    has_ghost,
    order_candidates,
    sample_outcomes,
    share_of_quota,
)
from dynapix.data.items.futures.simulation import scene_states, simulate_futures
from dynapix.data.items.pickers import fill_quota
from dynapix.data.items.scores import compare_item, rank_excess
from dynapix.data.oracle.displacement import cross_scene_displacement
from dynapix.data.oracle.events import collisions_in, next_collision, touching_pairs
from dynapix.data.parallel import Workers
from dynapix.data.records import CONTACT, GHOST, Collision, Scene, SelectionItem
from dynapix.data.sim.physics import Branch, Motion, shared_simulator
from dynapix.data.store import Store
from tests.data.simulated import preset_world, simulate_scene

WORLD = preset_world("above_masses")
QUOTA = Quota(4, 8)


def settings(folder_name: str, **changes) -> BenchmarkConfig:
    cfg = compose("data.build", BuildCommand, ["benchmark=tiny_contact"]).benchmark
    cfg.name, cfg.scenes, cfg.test_share = folder_name, 48, 0.7
    cells = dict.fromkeys(("collision_gap16", "collision_gap26"), QUOTA)
    cfg.selection = SelectionConfig(event=cells)
    return replace(cfg, **changes)


@pytest.fixture(scope="module")
def store(tmp_path_factory: pytest.TempPathFactory) -> Store:
    return ensure_items(settings("contact"), tmp_path_factory.mktemp("store"), Workers(1))


@pytest.fixture(scope="module")
def items(store: Store) -> list[SelectionItem]:
    return store.selection()


@pytest.fixture(scope="module")
def scene() -> Scene:
    """A scene with a collision after a prefix."""
    return next(s for s in (simulate_scene(0, k, WORLD) for k in range(20)) if timings(s))


def test_a_collision_that_begins_with_another_has_no_timing(scene: Scene) -> None:
    """Otherwise, the item could be about the pair whose objects are hidden or touch."""
    frame, pair = timings(scene)[0].event, colliding_pair(scene)
    other = tuple(k for k in range(len(scene.objects)) if k not in pair)[:2]
    both = sorted([*scene.collisions, Collision(frame, other, frame)], key=lambda c: c.frame)
    found = timings(replace(scene, collisions=tuple(both)))
    assert frame not in [timing.event for timing in found]


def timings(scene: Scene) -> list:
    return collision_timings(16, scene)


def simulate(scene: Scene, *branches: Branch) -> list[Motion]:
    timing = timings(scene)[0]
    return simulate_futures(scene, timing.stop, timing.target, branches, WORLD)


def branch(scene: Scene, **changes) -> Branch:
    return Branch(scene_states(scene)[timings(scene)[0].stop].astype(float), **changes)


def colliding_pair(scene: Scene) -> tuple[int, int]:
    return next_collision(scene, timings(scene)[0].stop).objects


# Outcomes.


def test_branch_without_a_change_equals_the_plain_branch(scene: Scene) -> None:
    count = len(scene.objects)
    (plain,) = simulate(scene, branch(scene))
    for changes in ({"masses": [1.0] * count}, {"restitution": 1.0}):
        (same,) = simulate(scene, branch(scene, **changes))
        np.testing.assert_array_equal(same.states, plain.states)


def test_branches_leave_no_trace(scene: Scene) -> None:
    pair = colliding_pair(scene)
    masses = np.where(np.arange(len(scene.objects)) == pair[0], 9.0, 1.0).tolist()
    branches = [
        branch(scene), branch(scene, masses=masses), branch(scene, restitution=0.2),
        branch(scene, passing=pair),
    ]  # fmt: skip
    first = simulate(scene, *branches)
    alone = [simulate(scene, each)[0] for each in branches]
    shared_simulator.cache_clear()
    for each, one, together in zip(branches, alone, first, strict=True):
        np.testing.assert_array_equal(simulate(scene, each)[0].states, one.states)
        # A restored state lacks the order of Bullet's contacts.
        np.testing.assert_allclose(one.positions, together.positions, atol=0.01)
    np.testing.assert_array_equal(
        [m.states for m in simulate(scene, *branches)], [m.states for m in first]
    )
    states = [motion.states for motion in first]
    assert all(np.abs(a - b).max() > 0.01 for a, b in combinations(states, 2))


def test_object_that_passes_another_moves_as_if_alone(scene: Scene) -> None:
    pair, timing = colliding_pair(scene), timings(scene)[0]
    (ghost,) = simulate(scene, branch(scene, passing=pair))
    states = scene_states(scene)[timing.stop].astype(float)
    for own, other in (pair, pair[::-1]):
        kept = [k for k in range(len(scene.objects)) if k != other]
        (alone,) = shared_simulator().simulate_branches(
            [scene.objects[k] for k in kept], [scene.object_scales[k] for k in kept],
            states[kept], [Branch(states[kept])], WORLD, timing.target - timing.stop + 1,
        )  # fmt: skip
        # Other objects may meet one of the pair: the motion is compared up to the next contact.
        touches = (motion.touching.values() for motion in (ghost, alone))
        until = min((f for each in touches for frames in each for f in frames), default=None)
        expected = alone.positions[:until, kept.index(own)]
        np.testing.assert_allclose(ghost.positions[:until, own], expected, atol=1e-3)
        assert until is None or until > LEAD
    assert pair not in ghost.touching


def test_heavier_struck_object_moves_less(scene: Scene) -> None:
    pair, stop = colliding_pair(scene), timings(scene)[0].stop
    struck = min(pair, key=lambda k: np.linalg.norm(scene.velocities[stop, k]))
    changes = [
        np.where(np.arange(len(scene.objects)) == struck, factor, 1.0).tolist()
        for factor in (0.25, 1.0, 4.0, 16.0)
    ]
    motions = simulate(scene, *(branch(scene, masses=each) for each in changes))
    after = [m.touching[pair][0] for m in motions]
    gained = [
        np.linalg.norm(m.velocities[first, struck] - m.velocities[0, struck])
        for m, first in zip(motions, after, strict=True)
    ]
    assert gained == sorted(gained, reverse=True)


def test_true_outcome_is_a_sample_of_the_others(scene: Scene) -> None:
    """Masses and directions lie on both sides of the true ones, at every share."""
    pair, stop, rng = colliding_pair(scene), timings(scene)[0].stop, np.random.default_rng(0)
    heavier = []
    for _ in range(300):
        branches = [b for source, b in sample_outcomes(scene, stop, pair, rng) if source == "mass"]
        heavier.append(sum(np.prod(b.masses) > 1 for b in branches))
    counts = Counter(heavier)
    assert len(counts) == 9
    assert max(counts.values()) < 3 * min(counts.values())


# Items.


@pytest.mark.slow
def test_quotas_are_filled_with_the_share_of_ghosts(
    store: Store, items: list[SelectionItem]
) -> None:
    assert store.manifest["shortfalls"] == {}
    assert {item.distractors for item in items} == {CONTACT}
    for split, quota in (("train", QUOTA.train), ("test", QUOTA.test)):
        for cell in ("collision_gap16", "collision_gap26"):
            own = [i for i in items if i.split == split and i.subtype == cell]
            assert len(own) == quota
            assert sum(map(has_ghost, own)) == round(GHOST_SHARE * quota)
    assert share_of_quota(8, True) + share_of_quota(8, False) == 8
    assert not any(item.candidates[item.answer].source == GHOST for item in items)


@pytest.mark.slow
def test_prefix_ends_before_the_collision_and_any_other(
    store: Store, items: list[SelectionItem]
) -> None:
    for item in items:
        own, stop = store.scene(item.scene_id), item.prefix_stop
        assert item.event_frame == stop + LEAD
        assert item.target_frame == item.event_frame + CELLS[item.subtype]
        assert stop - item.prefix_start + 1 == OBSERVED
        assert collisions_in(own, stop + 1, item.event_frame - 1) == []
        collision = next_collision(own, stop)
        assert collision.frame == item.event_frame
        assert collision.objects not in touching_pairs(own, stop, stop)


@pytest.mark.slow
def test_candidates_show_outcomes_of_the_collision(
    store: Store, items: list[SelectionItem]
) -> None:
    least = store.manifest["config"]["selection"]["min_displacement"]
    for item in items:
        own = store.scene(item.scene_id)
        pair = next_collision(own, item.prefix_stop).objects
        reach = sum(own.object_radii[k] for k in pair)
        frames = [(store.scene(c.scene_id), c.frame) for c in item.candidates]
        assert {frame for _, frame in frames} == {item.target_frame}
        found = min(cross_scene_displacement(*a, *b) for a, b in combinations(frames, 2))
        assert found >= least
        assert found == pytest.approx(item.min_displacement, abs=0.1)
        for candidate, (other, target) in zip(item.candidates, frames, strict=True):
            past = slice(item.prefix_stop + 1)
            np.testing.assert_array_equal(other.positions[past], own.positions[past])
            path = other.positions[item.prefix_stop : target + 1, pair]
            gaps = np.linalg.norm(path[:, 0] - path[:, 1], axis=-1)
            if candidate.source == GHOST:
                assert gaps[-1] > APART * reach
            else:
                # Between two frames, objects may touch and part; cubes reach beyond their radius.
                assert gaps.min() < 1.6 * reach
                assert gaps.min() > 0.7 * reach


@pytest.mark.slow
def test_targets_have_each_rank_equally_often(store: Store, items: list[SelectionItem]) -> None:
    """Also among the items without the ghost alone, for the distance from constant velocity."""
    config = store.manifest["config"]
    for ghosts in (False, True):
        own = [item for item in items if has_ghost(item) == ghosts]
        scores = np.stack([compare_item(i, store.scene, config).item_scores() for i in own])
        order = np.array([order_candidates(item) for item in own])
        scores = np.take_along_axis(scores, order[:, None], axis=-1)
        excess = rank_excess(scores, (0, 1, 2) if ghosts else (0, 1, 2, 3)).sum(axis=0)
        # Two cells and two splits, each within the bound of `data.items.scores.LIMIT`.
        assert np.abs(excess).max() < 4 * 1.75 + 0.75 + 0.015 * len(own)


@pytest.mark.slow
def test_killed_build_resumes_to_the_same_bytes(
    store: Store, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    made = []

    def fill_first_cell(*args: object) -> tuple:
        if made:
            raise KeyboardInterrupt
        made.append(fill_quota(*args))
        return made[0]

    with monkeypatch.context() as patch:
        patch.setattr("dynapix.data.items.cells.fill_quota", fill_first_cell)
        with pytest.raises(KeyboardInterrupt):
            ensure_items(settings("contact"), tmp_path, Workers(1))
    assert [*tmp_path.glob(".*.partial/parts/*.json")]
    # The number of workers does not matter either.
    again = ensure_items(settings("contact"), tmp_path, Workers(2))
    assert again.manifest["files"] == store.manifest["files"]


@pytest.mark.slow
def test_statistics_report_horizons_on_both_splits(
    store: Store, items: list[SelectionItem]
) -> None:
    found = compute_statistics(store)
    cells = {"collision_gap16", "collision_gap26"}
    assert found["shortcuts"].keys() == found["shortcuts, both splits"].keys() == cells | {"event"}
    assert found["shortcuts, both splits"]["event"]["items"] == len(items)
    assert found["shortcuts"]["event"]["items"] == 2 * QUOTA.test
    cell = found["cells"]["event/collision_gap16"]
    own = [item for item in items if item.subtype == "collision_gap16"]
    for kind in ("aim", "bounce", GHOST, "mass"):
        assert cell[kind] == sum(any(c.source == kind for c in i.candidates) for i in own)
    text = format_statistics(found)
    assert max(map(len, text.splitlines())) <= 100
    assert "both splits" in text


# Settings.


def test_world_whose_collisions_come_too_early_is_named(scene: Scene) -> None:
    early = replace(scene, collisions=(replace(scene.collisions[0], frame=OBSERVED - 1),))
    error = empty_benchmark(settings("early"), {"train": ["s"], "test": []}, lambda _: early, {})
    assert error.code == "no-collisions"
    assert "benchmark.world.start.distance" in str(error)


@pytest.mark.slow
def test_reasons_of_dropped_items_are_counted(tmp_path: Path) -> None:
    cfg = settings("far", scenes=12)
    cfg.selection = SelectionConfig(event={"collision_gap10": QUOTA}, min_displacement=120.0)
    cfg.retrieval = RetrievalTrackConfig(
        builders={"1": Quota(2, 0)}, database=0, source=8, counterfactual_source=0
    )
    store = ensure_items(cfg, tmp_path, Workers(1))
    assert store.manifest["counts"]["items dropped, too few suitable outcomes/event"] > 0
    summary = summarize_store(store)
    assert "short: event/collision_gap10/test has 0 of 8" in summary
    assert "benchmark.world.start.distance" in summary.splitlines()[-1]


@pytest.mark.parametrize(
    ("benchmark", "distractors"), [("tiny", "contact"), ("tiny_contact", "paper")]
)
def test_cells_of_another_recipe_are_refused(benchmark: str, distractors: str) -> None:
    changes = [f"benchmark={benchmark}", f"benchmark.distractors={distractors}"]
    cfg = compose("data.build", BuildCommand, changes).benchmark
    with pytest.raises(UserError) as caught:
        check_quota_names(cfg)
    assert caught.value.code == "unknown-option"
    assert f"benchmark.distractors={distractors}" in str(caught.value)
