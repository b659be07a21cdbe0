"""Strategies without foresight, on scenes where what they get is known."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from data.statistics import (
    cell_counts,
    hard_margin,
    item_statistics,
    scene_statistics,
    strategy_accuracy,
    table,
)
from tests.teacher import synthetic

STANDARD = {"config": {"simulator": "bullet"}}
"""A manifest of standard scenes."""


def made(count: int = 24) -> tuple[list, SimpleNamespace]:
    """Items over scenes that move at constant velocity, each with its target at a random letter."""
    rng = np.random.default_rng(3)
    scenes, items = {}, []
    for k in range(count):
        start = synthetic.on_ground((rng.uniform(60, 200), rng.uniform(60, 260)))[:2]
        end = synthetic.on_ground((rng.uniform(280, 420), rng.uniform(60, 260)))[:2]
        velocity = (end - start) / 127 * synthetic.FPS
        scenes[f"s{k}"] = synthetic.scene([start, (0, -1)], [velocity, (0, 0)], scene_id=f"s{k}")
        answer = int(rng.integers(4))
        frames = list(rng.permutation([50, 90, 110, 120]))
        items.append(
            synthetic.item(
                tuple(int(f) for f in frames), answer=answer, item_id=f"i{k}", scene_id=f"s{k}",
                stop=30,
            )
        )  # fmt: skip
    return items, SimpleNamespace(scene=scenes.__getitem__, manifest=STANDARD)


def test_constant_velocity_foresees_what_moves_so() -> None:
    items, store = made()
    found = strategy_accuracy(items, store)["event"]
    assert found["velocity"] == 1
    assert found["items"] == len(items)


def test_nearest_and_farthest_go_by_the_frames_after_the_observation() -> None:
    items, store = made()
    found = strategy_accuracy(items, store)["event"]
    # At constant velocity the earliest frame is the nearest, and the latest the farthest.
    assert found["nearest"] == np.mean([i.target_frame == 50 for i in items])
    assert found["farthest"] == np.mean([i.target_frame == 120 for i in items])
    assert found["first"] == np.mean([i.answer == 0 for i in items])


def test_a_tie_counts_its_share() -> None:
    items, _ = made(4)
    still = synthetic.scene([(0, 0)], [(0, 0)])
    store = SimpleNamespace(scene=lambda _: still, manifest=STANDARD)
    assert strategy_accuracy(items, store)["event"]["nearest"] == pytest.approx(0.25)


@pytest.mark.slow
def test_a_real_benchmark_is_told_whole(micro_store) -> None:
    items = micro_store.selection()
    found = {
        "scenes": scene_statistics(micro_store),
        "cells": cell_counts(items),
        "items": item_statistics(items, micro_store),
        "strategies": strategy_accuracy(items, micro_store),
    }
    assert sum(found["scenes"]["collisions a scene"].values()) == 10
    assert sum(found["items"]["answers"].values()) == len(items)
    by_family = [found["strategies"][f]["items"] for f in ("event", "time", "window")]
    assert sum(by_family) == len(items)
    assert found["strategies"]["event, cross_scene"]["nearest"] == 1
    assert found["cells"]["window"]["test"] == sum(
        n["test"] for name, n in found["cells"].items() if name.startswith("window/G1_")
    ) + sum(found["cells"][f"window/{group}"]["test"] for group in ("G2", "G3", "G4"))
    # A median over items of distances that are at least the items' least.
    for group, far in found["items"]["median to the nearest distractor"].items():
        assert far >= found["items"]["median least displacement"][group] - 1e-3
    assert hard_margin(found["strategies"]) > 0.3
    told = table(found)
    assert max(map(len, told.splitlines())) <= 100
    assert all(group in told for group in found["strategies"])
