"""Hard negatives that the retriever mines."""

from __future__ import annotations

import shutil
from dataclasses import replace

import numpy as np
import pytest

from conf.entry import Run
from conf.schema import LateConfig
from data.records import FrameRef
from data.world.displacement import frame_displacements
from models.retriever.embedder import embed, load_trained
from tests.user_errors import raises_user_error
from train import contrastive
from train.common.held_out import held_out_scenes
from train.common.journal import read_journal
from train.retriever.mining import read_negatives, select_negatives

MARGIN = 24.0


def ranked_by_displacement(query, store) -> tuple[list[FrameRef], np.ndarray]:
    scene, target = query.target.scene_id, query.target.frame
    distances = frame_displacements(store.scene(scene))[target]
    return [FrameRef(scene, f) for f in np.argsort(distances, kind="stable").tolist()], distances


def test_highly_ranked_wrong_frames_are_selected_in_order(micro_store) -> None:
    query = micro_store.retrieval("train")[0]
    ranked, distances = ranked_by_displacement(query, micro_store)
    elsewhere = [FrameRef("s0-000009", query.target.frame), FrameRef("s0-000008", 0)]
    selected = select_negatives(query, [*ranked, *elsewhere], micro_store, MARGIN, 5)
    far = [f for f in ranked if f.frame != query.target.frame and distances[f.frame] >= MARGIN]
    assert selected == [*far, *elsewhere][:5]
    assert select_negatives(query, elsewhere, micro_store, MARGIN, 2) == elsewhere


def test_the_benchmarks_negatives_fill_up_missing_ones(micro_store) -> None:
    query = micro_store.retrieval("train")[0]
    selected = select_negatives(query, [query.target], micro_store, 1e9, 2)
    assert selected == list(query.hard_negatives[:2])


def test_twins_of_the_target_are_never_selected(micro_store) -> None:
    for query in micro_store.retrieval("train"):
        ranked, distances = ranked_by_displacement(query, micro_store)
        selected = select_negatives(query, ranked, micro_store, 0, len(ranked))
        assert {f.frame for f in selected} == set(np.flatnonzero(distances >= 1).tolist())


def test_a_damaged_mining_is_refused(tmp_path) -> None:
    (tmp_path / "1.json").write_text("{")
    for name in ("1.json", "2.json"):
        with raises_user_error("damaged-file", name):
            read_negatives(tmp_path / name)


@pytest.mark.slow
@pytest.mark.parametrize("late", [None, LateConfig(width=24)])
def test_a_run_mines_the_highest_ranked_frames_and_resumes_with_them(
    contrastive_settings, micro_store, frames, tmp_path, late
) -> None:
    often = {"mine_every": 1, "mine_margin": MARGIN, "evaluations": 4, "keep": 4}
    train = replace(contrastive_settings.train, **often)
    cfg = replace(contrastive_settings.retriever, late=late)
    settings = replace(contrastive_settings, retriever=cfg, train=train)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    for folder in (whole, killed):
        folder.mkdir()
    contrastive.main.__wrapped__(settings, Run("whole", whole))
    assert sorted(p.name for p in (whole / "mined").iterdir()) == ["1.json", "2.json", "3.json"]

    shutil.copytree(whole / "mined", killed / "mined")
    for path in (killed / "mined").glob("[23].json"):
        path.unlink()
    # Killed during its second mining.
    shutil.copytree(whole / "checkpoint-1", killed / "checkpoint-1")
    contrastive.main.__wrapped__(settings, Run("killed", killed))
    for step in (2, 3):
        first, second = (f / "mined" / f"{step}.json" for f in (whole, killed))
        assert read_negatives(first) == read_negatives(second)
    later = [[r for r in read_journal(f) if r["step"] > 1] for f in (whole, killed)]
    assert later[0] == later[1]

    mined = read_negatives(whole / "mined" / "3.json")
    held_out = held_out_scenes(micro_store)
    queries = [q for q in micro_store.retrieval("train") if q.scene_id not in held_out]
    assert mined.keys() == {q.query_id for q in queries}
    # The checkpoint of the third step is the retriever that mined.
    shutil.copytree(whole / "retriever", tmp_path / "third")
    for weights in (whole / "checkpoint-3").rglob("model.safetensors"):
        shutil.copy(weights, tmp_path / "third" / weights.relative_to(whole / "checkpoint-3"))
    model = load_trained(cfg, "fp32", tmp_path / "third")
    pool = list(dict.fromkeys(f for q in queries for f in (q.target, *q.hard_negatives[:1])))
    document_vectors = embed(model, pool, frames, cfg, 8)
    for query in queries[:5]:
        vectors = embed(model, [query], frames, cfg, 1)
        scores = np.array(
            [float(model.similarity([vectors[0]], [row])) for row in document_vectors]
        )
        ranked = [pool[k] for k in np.argsort(-scores, kind="stable")]
        by_frame = dict(zip(pool, scores, strict=True))
        best = select_negatives(query, ranked, micro_store, MARGIN, 1)[0]
        assert by_frame[mined[query.query_id][0]] == pytest.approx(by_frame[best], abs=1e-5)
