"""Hard negatives that the retriever itself finds."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import numpy as np
import pytest

from conf.entry import Run
from conf.schema import LateConfig
from data.records import FrameRef
from data.world.displacement import frame_displacements
from models.retriever.embedder import frame_input, load_trained, query_input
from train import contrastive
from train.common.journal import read_journal
from train.retriever.mining import read, wrong
from train.student.dataset import held_out_scenes

MARGIN = 24.0


def test_what_is_ranked_high_and_wrong_is_taken_in_order(micro_store) -> None:
    query = micro_store.retrieval("train")[0]
    scene, target = query.target.scene_id, query.target.frame
    apart = frame_displacements(micro_store.scene(scene))[target]
    ranked = [FrameRef(scene, f) for f in np.argsort(apart, kind="stable").tolist()]
    elsewhere = [FrameRef("s0-000009", target), FrameRef("s0-000008", 0)]
    found = wrong(query, [*ranked, *elsewhere], micro_store, MARGIN, 5)
    far = [f for f in ranked if f.frame != target and apart[f.frame] >= MARGIN]
    assert found == [*far, *elsewhere][:5]
    assert wrong(query, elsewhere, micro_store, MARGIN, 2) == elsewhere


def test_the_benchmarks_own_fill_what_is_lacking(micro_store) -> None:
    query = micro_store.retrieval("train")[0]
    assert wrong(query, [query.target], micro_store, 1e9, 2) == list(query.hard_negatives[:2])


def test_no_margin_takes_a_frame_that_shows_what_the_target_shows(micro_store) -> None:
    for query in micro_store.retrieval("train"):
        scene, target = query.target.scene_id, query.target.frame
        apart = frame_displacements(micro_store.scene(scene))[target]
        ranked = [FrameRef(scene, f) for f in np.argsort(apart, kind="stable").tolist()]
        found = wrong(query, ranked, micro_store, 0, len(ranked))
        assert {f.frame for f in found} == set(np.flatnonzero(apart >= 1).tolist())


@pytest.mark.slow
@pytest.mark.parametrize(("late", "tokens"), [(None, None), (LateConfig(width=24), 256)])
def test_a_run_mines_what_ranks_highest_and_goes_on_with_it(
    contrastive_settings, micro_store, frames, tmp_path, late, tokens
) -> None:
    often = {"mine_every": 1, "mine_margin": MARGIN, "evaluations": 4, "keep": 4}
    train = replace(contrastive_settings.train, mini_batch_tokens=tokens, **often)
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
    # Killed at its second mining.
    shutil.copytree(whole / "checkpoint-1", killed / "checkpoint-1")
    contrastive.main.__wrapped__(settings, Run("killed", killed))
    for step in (2, 3):
        names = [f / "mined" / f"{step}.json" for f in (whole, killed)]
        assert read(names[0]) == read(names[1])
    later = [[r for r in read_journal(f) if r["step"] > 1] for f in (whole, killed)]
    assert later[0] == later[1]

    mined = read(whole / "mined" / "3.json")
    held_out = held_out_scenes(micro_store)
    queries = [q for q in micro_store.retrieval("train") if q.scene_id not in held_out]
    assert mined.keys() == {q.query_id for q in queries}
    # The checkpoint of the third step is the retriever that mined.
    shutil.copytree(whole / "retriever", tmp_path / "third")
    for weights in (whole / "checkpoint-3").rglob("model.safetensors"):
        shutil.copy(weights, tmp_path / "third" / weights.relative_to(whole / "checkpoint-3"))
    model = load_trained(cfg, "fp32", tmp_path / "third")
    pool = list(dict.fromkeys(f for q in queries for f in (q.target, *q.hard_negatives[:1])))
    shown = model.encode_document([frame_input(f, frames) for f in pool])
    for query in queries[:5]:
        asked = model.encode_query([query_input(query, frames, cfg)])
        found = model.similarity(asked, shown)[0].cpu().numpy()
        ranked = [pool[k] for k in np.argsort(-found, kind="stable")]
        scores = dict(zip(pool, found, strict=True))
        best = wrong(query, ranked, micro_store, MARGIN, 1)[0]
        assert scores[mined[query.query_id][0]] == pytest.approx(scores[best], abs=1e-5)
    assert json.loads((whole / "mined" / "1.json").read_text())
