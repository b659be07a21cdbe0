"""Settings of the selection track: observed frames, and how quotas are divided among cells."""

from __future__ import annotations

from pathlib import Path

import pytest

from conf.compose import compose
from conf.schema import BenchmarkConfig, BuildCommand, Quota, SelectionConfig
from conf.schema.benchmark import divide_window_quotas
from data.build import check_quota_names, ensure_items
from data.parallel import Workers
from tests.user_errors import raises_user_error


def config(**selection) -> BenchmarkConfig:
    cfg = BenchmarkConfig(name="observed", scenes=20, test_share=1.0)
    cfg.retrieval.database = cfg.retrieval.source = 0
    cfg.retrieval.counterfactual_source = 0
    cfg.selection = SelectionConfig(**selection)
    return cfg


@pytest.mark.slow
def test_observation_sets_the_frames_of_a_family_or_of_a_subtype(tmp_path: Path) -> None:
    cfg = config(
        event={"contact_offset": Quota(test=2), "contact_match": Quota(test=2)},
        window={"G1_A_h8_easy": Quota(test=2), "G2_A_h24_easy": Quota(test=2)},
        observation={"window": 20, "G2_A_h24_easy": 24, "contact_match": 12},
    )
    observed = {
        item.subtype: item.prefix_stop - item.prefix_start + 1
        for item in ensure_items(cfg, tmp_path, Workers(1)).selection()
    }
    assert observed == {
        "contact_offset": 21,
        "contact_match": 12,
        "G1_A_h8_easy": 20,
        "G2_A_h24_easy": 24,
    }


def test_unknown_names_and_lengths_of_observations_are_refused() -> None:
    with raises_user_error("unknown-option", contains="selection.observation.in_1s"):
        check_quota_names(config(observation={"in_1s": 20}))
    (problem,) = SelectionConfig(observation={"window": 3}).check("benchmark.selection.")
    assert "benchmark.selection.observation.window=3" in problem


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
