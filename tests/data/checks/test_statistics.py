"""Statistics and the accuracy of baselines, on scenes for which both are known."""

from __future__ import annotations

import shutil
from dataclasses import asdict, replace
from types import SimpleNamespace

import numpy as np
import pytest

from dynapix.conf.entry import Run
from dynapix.conf.schema import ExportCommand, StatisticsCommand, WorldConfig
from dynapix.data import export, statistics
from dynapix.data.checks.baselines import score_baselines
from dynapix.data.checks.statistics import compute_statistics, format_statistics
from tests.teacher import synthetic

STANDARD = {"config": {"simulator": "bullet", "world": asdict(WorldConfig())}}
"""A manifest of scenes of the world of CLEVRER."""


def synthetic_store(count: int = 24) -> tuple[list, SimpleNamespace]:
    """Items over scenes that move at constant velocity, with targets at random letters."""
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


def accuracy(items: list, store: SimpleNamespace) -> dict[str, float]:
    scores = [score_baselines(item, store) for item in items]
    return {name: np.mean([score[name] for score in scores]) for name in scores[0]}


def test_velocity_baseline_is_right_where_velocities_are_constant() -> None:
    assert accuracy(*synthetic_store())["velocity"] == 1


def test_nearest_compares_with_the_last_observed_frame() -> None:
    items, store = synthetic_store()
    scores = accuracy(items, store)
    # At constant velocity the earliest frame is the nearest; the others lie close together.
    assert scores["nearest"] == np.mean([i.target_frame == 50 for i in items])
    assert scores["odd"] == scores["nearest"]
    assert scores["latest"] == np.mean([i.target_frame == 120 for i in items])
    assert scores["first"] == np.mean([i.answer == 0 for i in items])


def test_a_baseline_that_ties_scores_the_share_of_the_tied_candidates() -> None:
    items, _ = synthetic_store(4)
    still = synthetic.scene([(0, 0)], [(0, 0)])
    store = SimpleNamespace(scene=lambda _: still, manifest=STANDARD)
    assert accuracy(items, store)["nearest"] == pytest.approx(0.25)


def test_velocity_baseline_is_unknown_for_releases_without_a_camera() -> None:
    items, store = synthetic_store(4)
    store.manifest = {"config": STANDARD["config"] | {"simulator": "physion"}}
    scores = accuracy(items, store)
    assert np.isnan(scores["velocity"])
    assert not np.isnan([score for name, score in scores.items() if name != "velocity"]).any()


def test_velocity_baseline_tells_objects_that_look_alike_apart() -> None:
    """Two bowls move past each other; only the target has both where they are expected."""
    items, store = synthetic_store(4)
    scene = store.scene(items[0].scene_id)
    twin = replace(scene, objects=(scene.objects[0],) * len(scene.objects))
    same = SimpleNamespace(scene=lambda _: twin, manifest=STANDARD)
    assert accuracy(items[:1], same)["velocity"] == accuracy(items[:1], store)["velocity"] == 1


@pytest.mark.slow
def test_commands_that_need_no_frames_render_none(micro, micro_store, tmp_path) -> None:
    folder = tmp_path / "store" / "micro"
    shutil.copytree(micro_store.folder, folder, ignore=shutil.ignore_patterns("frames"))
    settings = {"benchmark": micro, "store": str(folder.parent), "workers": 1}
    (tmp_path / "run").mkdir()
    run = Run("run", tmp_path / "run")
    assert (
        statistics.main.__wrapped__(StatisticsCommand(**settings), run)["moment, highest_time"] <= 1
    )
    command = ExportCommand(**settings, folder=str(tmp_path / "export"), images=False)
    assert export.main.__wrapped__(command, run)["bytes"] > 0
    assert not (folder / "frames").exists()


@pytest.mark.slow
def test_statistics_of_a_benchmark_are_consistent(micro_store) -> None:
    items = micro_store.selection()
    found = compute_statistics(micro_store)
    shortcuts, cells = found["shortcuts"], found["cells"]
    assert sum(found["scenes"]["collisions"].values()) == 10
    assert sum(found["answers"].values()) == len(items)
    tested = [shortcuts[family]["items"] for family in ("event", "time", "window")]
    assert sum(tested) == sum(item.split == "test" for item in items)
    assert shortcuts["event"]["velocity"] > 0.9
    assert cells.keys() == {f"{item.family}/{item.subtype}" for item in items}
    assert sum(cell["test"] for cell in cells.values()) == sum(tested)
    for row in found["candidates"].values():
        assert row["nearest distractor"] >= row["least"] - 1e-3
    easy, hard = (shortcuts[f"window, {difficulty}"] for difficulty in ("easy", "hard"))
    assert easy["nearness, lowest"] > hard["nearness, lowest"] + 0.3
    text = format_statistics(found)
    assert max(map(len, text.splitlines())) <= 100
    assert all(category in text for category in found["candidates"])
