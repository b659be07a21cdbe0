"""Settings of the selection track: quotas, test scenes, minimum displacement."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

from dynapix.conf.compose import compose
from dynapix.conf.schema import (
    BenchmarkConfig,
    BuildCommand,
    Quota,
    RetrievalTrackConfig,
    SelectionConfig,
)
from dynapix.conf.schema.benchmark import divide_window_quotas
from dynapix.data.build import ensure_items
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.parallel import Workers
from dynapix.data.records import original_scene_id
from dynapix.data.seeded_order import named_rng
from dynapix.data.sources.scenes import scene_prefix, split_scenes
from dynapix.data.store import DATABASES


def test_every_seed_has_an_order_of_its_own() -> None:
    """Also seed 0."""
    orders = [named_rng(seed, "cell").permutation(50).tolist() for seed in (0, 1, 2)]
    assert orders[0] not in orders[1:]
    assert orders[0] == named_rng(0, "cell").permutation(50).tolist()


def config(**selection) -> BenchmarkConfig:
    cfg = BenchmarkConfig(name="observed", scenes=20, test_share=1.0)
    cfg.retrieval.database = cfg.retrieval.source = 0
    cfg.retrieval.counterfactual_source = 0
    cfg.selection = SelectionConfig(**selection)
    return cfg


@pytest.mark.slow
@pytest.mark.parametrize("size", [(96, 64), (240, 160)])
def test_candidates_are_distinct_in_pixels_at_the_least_displacement(
    tmp_path: Path, size: tuple[int, int]
) -> None:
    width, height = size
    few = Quota(train=0, test=12)
    cfg = config(
        event={"future_match_gap10": few, "contact_offset": few},
        time={"in_1s": few},
        window={"G1_A_h8_hard": few, "G2_C_h8_hard": few},
        min_displacement=336 / height,
    )
    cfg.width, cfg.height = width, height
    assert not list(cfg.find_problems("benchmark."))
    store = ensure_items(cfg, tmp_path, Workers(1))
    frames = FrameReader(store)
    for item in store.selection():
        pixels = {frames.array(c.scene_id, c.frame).tobytes() for c in item.candidates}
        assert len(pixels) == 4, item.item_id


def test_displacements_below_a_pixel_are_refused() -> None:
    for least in (0.0, 336 / 320 - 0.01):
        [problem] = config(min_displacement=least).find_problems("benchmark.")
        assert "benchmark.selection.min_displacement" in problem


def test_test_scenes_that_cannot_carry_a_quota_are_refused() -> None:
    cfg = config(time={"in_2s": Quota(0, 12)}, event={"contact_match": Quota(0, 9)})
    cfg.retrieval.builders = {"1": Quota(0, 30), "5": Quota(0, 11)}
    cfg.retrieval.counterfactual = Quota(0, 51)
    cfg.retrieval.database = 1281
    cfg.test_scenes = 10
    problems = [*cfg.find_problems("benchmark.")]
    refused = (
        "selection.time.in_2s.test=12", "retrieval.builders.5.test=11",
        "retrieval.counterfactual.test=51", "retrieval.database=1281",
    )  # fmt: skip
    assert len(problems) == len(refused)
    for name, problem in zip(refused, problems, strict=True):
        assert f"benchmark.{name}: a scene gives at most" in problem
    cfg = config(time={"in_1s": Quota(0, 5)})
    cfg.retrieval.database, cfg.test_scenes = 10_000, 5
    # Without queries, there is no database.
    assert not [*cfg.find_problems("benchmark.")]


@pytest.mark.slow
def test_test_scenes_that_are_not_chosen_are_not_made(tmp_path: Path) -> None:
    cfg = config(time={"in_1s": Quota(4, 3)}, event={"contact_cross": Quota(4, 3)})
    cfg = replace(cfg, scenes=40, test_share=0.5, test_scenes=5)
    split = split_scenes(cfg, [scene_prefix(cfg) + f"s0-{k:06d}" for k in range(40)])
    cfg.retrieval = RetrievalTrackConfig(
        builders={"1": Quota(4, 4)}, hard_negatives=1, database=60, source=80
    )
    store = ensure_items(cfg, tmp_path, Workers(1))
    assert store.scene_ids("train") == split["train"]
    assert len(store.scene_ids("test")) == 5
    assert {*store.scene_ids("test")} < {*split["test"]}
    files = {path.stem for path in (store.folder / "scenes").iterdir()}
    assert {original_scene_id(name) for name in files} == {
        *store.scene_ids("train"), *store.scene_ids("test"),
    }  # fmt: skip
    fewer = replace(cfg, name="fewer", test_scenes=21)
    shortfalls = ensure_items(fewer, tmp_path, Workers(1)).manifest["shortfalls"]
    assert shortfalls["scenes/test"] == "20 of 21"
    candidates = (c.scene_id for item in store.selection() for c in item.candidates)
    queries = (f.scene_id for q in store.retrieval() for f in (q.target, *q.hard_negatives))
    frames = (f.scene_id for name in DATABASES for f in store.database(name))
    assert {original_scene_id(name) for name in (*candidates, *queries, *frames)} <= {
        *store.scene_ids("train"), *store.scene_ids("test"),
    }  # fmt: skip
    assert {f.scene_id for f in store.database()} <= {*store.scene_ids("test")}


def test_quota_is_divided_among_cells_without_a_quota_of_their_own() -> None:
    own = {"G1_A_h8_easy": Quota(0, 0), "G1_A_h24_hard": Quota(7, 1)}
    cells = divide_window_quotas({"G1_A": Quota(10, 9), **own})
    shared = {name: quota for name, quota in cells.items() if name not in own}
    assert {name: cells[name] for name in own} == own
    assert [quota.train for quota in shared.values()] == [3, 3, 2, 2]
    assert sum(quota.test for quota in shared.values()) == 9


def test_preset_with_47_cells_has_the_papers_counts() -> None:
    presets = (
        compose("data.build", BuildCommand, [f"benchmark={name}"]).benchmark.selection.window
        for name in ("dynapix_47", "dynapix")
    )
    fewer, every = presets
    used = [quota for quota in fewer.values() if quota.test]
    assert (len(used), len(every)) == (47, 54)
    for split in ("train", "test"):
        totals = {sum(getattr(q, split) for q in cells.values()) for cells in (fewer, every)}
        assert totals == {6598 if split == "train" else 1585}


@pytest.mark.parametrize("bounds", [[1.0, 0.5, 2.0], [0.6, 1.5], [0.01, 0.5, 1.0]])
def test_bounds_of_speed_words_must_rise(bounds: list[float]) -> None:
    cfg = BenchmarkConfig(name="wrong")
    cfg.world.speed_bounds = bounds
    (problem,) = cfg.check("benchmark.")
    assert "benchmark.world.speed_bounds" in problem
