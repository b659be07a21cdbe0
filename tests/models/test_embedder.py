"""The inputs and embeddings of a retriever, and its evaluation during training."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from sentence_transformers import SentenceTransformer

from dynapix.conf.errors import UserError
from dynapix.conf.schema import LateConfig, LoraConfig
from dynapix.conf.schema.benchmark import POOLS
from dynapix.data.items.database import UniqueFrames
from dynapix.data.records import FPS, FRAMES, FrameRef, sample_prefix_frames
from dynapix.models.compat import keep_differentiable
from dynapix.models.layers.attention import BY_FRAME
from dynapix.models.retriever import embedder
from dynapix.models.retriever.inputs import frame_input, query_input
from dynapix.models.towers import count_parameters
from dynapix.train.common.audit import audit_retriever
from dynapix.train.retriever.evaluator import (
    FRAME_STEP,
    HeldOutEvaluator,
    build_database,
)
from tests.user_errors import raises_user_error


def load(micro_store, cfg, folder) -> SentenceTransformer:
    texts = embedder.tokenizer_texts(micro_store.retrieval("train"), cfg)
    return embedder.load_retriever(cfg, "fp32", texts, folder)


def test_a_query_is_instruction_then_video_then_text_and_a_generation_prompt(
    micro_store, frames, retriever_cfg, tmp_path
) -> None:
    model = load(micro_store, retriever_cfg, tmp_path)
    query = micro_store.retrieval("train")[0]
    features = model.preprocess(
        [query_input(query, frames, retriever_cfg)], prompt=retriever_cfg.query_instruction
    )
    text = model[0].processor.tokenizer.decode(features["input_ids"][0])
    assert text.startswith(f"<|im_start|>system\n{retriever_cfg.query_instruction}<|im_end|>")
    assert text.index("<|video_pad|>") < text.index(query.question)
    assert text.endswith("<|im_start|>assistant\n")
    assert features["video_grid_thw"].tolist() == [[6, 6, 6]]
    indices = sample_prefix_frames(query.prefix_start, query.prefix_stop, 12)
    assert f"<{(indices[0] + indices[1]) / 2 / FPS:.1f} seconds>" in text
    assert "of 6 x 3 x 3 tokens" in audit_retriever(model, retriever_cfg, query, frames)


def test_patches_have_the_size_of_the_architecture(
    micro_store, frames, retriever_cfg, tmp_path
) -> None:
    sizes = replace(retriever_cfg.architecture, patch=8)
    cfg = replace(retriever_cfg, architecture=sizes)
    query = micro_store.retrieval("train")[0]
    features = load(micro_store, cfg, tmp_path).preprocess([query_input(query, frames, cfg)])
    side = cfg.image_size // sizes.patch
    assert features["video_grid_thw"].tolist() == [[6, side, side]]


def test_timestamps_follow_the_clips_frame_rate(
    micro_store, frames, retriever_cfg, tmp_path, monkeypatch
) -> None:
    """Scenes of other simulators have 12 or 30 frames per second."""
    query = micro_store.retrieval("train")[0]
    slow = replace(frames.scene(query.scene_id), fps=12)
    monkeypatch.setattr(frames, "scene", lambda _: slow)
    model = load(micro_store, retriever_cfg, tmp_path)
    features = model.preprocess([query_input(query, frames, retriever_cfg)])
    text = model[0].processor.tokenizer.decode(features["input_ids"][0])
    indices = sample_prefix_frames(query.prefix_start, query.prefix_stop, 12)
    assert f"<{(indices[0] + indices[1]) / 2 / 12:.1f} seconds>" in text


def test_a_long_query_is_refused_instead_of_truncated(
    micro_store, frames, retriever_cfg, tmp_path
) -> None:
    model = load(micro_store, retriever_cfg, tmp_path)
    short = micro_store.retrieval("train")[0]
    long = replace(short, question="Which frame? " * 2000)
    assert embedder.longest_query([short, long, short], model.tokenizer) is long
    with pytest.raises(UserError, match=rf"query {long.query_id} has \d{{4,}} tokens, more than"):
        audit_retriever(model, retriever_cfg, long, frames)


def test_the_embedding_is_the_normalised_state_of_the_last_token(
    micro_store, frames, retriever_cfg, tmp_path
) -> None:
    model = load(micro_store, retriever_cfg, tmp_path)
    images = [frame_input(f, frames) for f in micro_store.database()[:2]]
    features = model.preprocess(images, prompt=retriever_cfg.frame_instruction)
    with torch.no_grad():
        states = model[0](dict(features))["token_embeddings"]
    last = states[:, -1] / states[:, -1].norm(dim=-1, keepdim=True)
    encoded = model.encode(images, prompt=retriever_cfg.frame_instruction)
    np.testing.assert_allclose(encoded, last.numpy(), atol=1e-5)


@pytest.mark.parametrize("late", [None, LateConfig(width=24)], ids=["one", "many"])
def test_adapters_are_loaded_over_a_4_bit_base_if_trained_so(
    micro_store, frames, retriever_cfg, saved_base, tmp_path, late
) -> None:
    over = {"architecture": None, "model": saved_base, "quantization": "nf4", "late": late}
    cfg = replace(retriever_cfg, **over, lora=LoraConfig())
    model = load(micro_store, cfg, tmp_path)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if "lora_B" in name:
                weight.normal_(std=0.1, generator=torch.Generator().manual_seed(0))
    towers = count_parameters(model)
    assert towers.loc["language", "4-bit"] > 0
    assert ("projection" in towers.index) == (late is not None)
    model.save_pretrained(str(tmp_path / "saved"), create_model_card=False)
    again = embedder.load_trained(cfg, "fp32", tmp_path / "saved")
    assert count_parameters(again).loc["language", "4-bit"] > 0
    keep_differentiable(again)
    query = [query_input(micro_store.retrieval("train")[0], frames, cfg)]
    one, two = (torch.as_tensor(m.encode_query(query)[0]) for m in (model, again))
    torch.testing.assert_close(one, two, atol=1e-5, rtol=0)


@pytest.mark.parametrize("late", [None, LateConfig(width=24)], ids=["one", "many"])
@pytest.mark.parametrize("quantization", ["none", "nf4"])
def test_adapters_and_projection_are_trained_in_fp32_over_a_bf16_base(
    micro_store, frames, retriever_cfg, saved_base, tmp_path, quantization, late
) -> None:
    over = {"architecture": None, "model": saved_base, "quantization": quantization, "late": late}
    cfg = replace(retriever_cfg, **over, lora=LoraConfig())
    model = embedder.load_retriever(cfg, "bf16", [], tmp_path)
    trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
    assert {p.dtype for p in trained.values()} == {torch.float32}
    assert ("1.linear.weight" in trained) == (late is not None)
    assert next(model[0].parameters()).dtype == torch.bfloat16
    query = [query_input(micro_store.retrieval("train")[0], frames, cfg)]
    assert torch.as_tensor(model.encode_query(query)[0]).isfinite().all()


def test_a_merged_export_has_the_attention_of_its_base(
    micro_store, retriever_cfg, tmp_path
) -> None:
    model = load(micro_store, retriever_cfg, tmp_path / "base")
    model.save_pretrained(str(tmp_path / "merged"), create_model_card=False)
    merged = embedder.load_merged(tmp_path / "merged", retriever_cfg)
    for tower in ("text_config", "vision_config"):
        ours, theirs = (getattr(m[0].model.config, tower) for m in (merged, model))
        assert ours._attn_implementation == theirs._attn_implementation
    assert merged[0].model.config.vision_config._attn_implementation == BY_FRAME


def test_a_missing_base_is_not_called_a_damaged_run(retriever_cfg, tmp_path) -> None:
    (tmp_path / "adapter_config.json").write_text("{}")
    moved = replace(retriever_cfg, architecture=None, model="./moved/base", lora=LoraConfig(rank=4))
    with raises_user_error("missing-model", contains="retriever.model=./moved/base"):
        embedder.load_trained(moved, "fp32", tmp_path)


def test_frames_of_the_database_look_different(micro_store) -> None:
    """The exception are targets, which are always in the database."""
    queries = [q for pool in POOLS for q in micro_store.retrieval("train", pool)]
    targets = {q.target for q in queries}
    database = build_database(queries, micro_store)
    assert targets < set(database)
    album = UniqueFrames(micro_store.scene)
    for target in targets:
        album.add(target)
    assert all(album.add(frame) for frame in database if frame not in targets)
    assert not any(album.add(q.factual_twin) for q in queries if q.factual_twin)
    kept = {(f.scene_id, f.frame) for f in database}
    for scene_id in {scene_id for q in queries for scene_id in (q.scene_id, q.target.scene_id)}:
        left_out = {f for f in range(0, FRAMES, FRAME_STEP) if (scene_id, f) not in kept}
        assert not any(album.add(FrameRef(scene_id, frame)) for frame in left_out)


@pytest.mark.parametrize("late", [None, LateConfig(width=24)])
def test_the_evaluator_ranks_as_the_library_with_all_pixels_in_memory(
    micro_store, frames, retriever_cfg, tmp_path, late
) -> None:
    """The evaluator loads the pixels by mini-batches."""
    cfg = replace(retriever_cfg, late=late)
    model = load(micro_store, cfg, tmp_path).eval()
    queries = micro_store.retrieval("train")[:7]
    database = build_database(queries, micro_store)
    evaluator = HeldOutEvaluator(queries, database, frames, cfg, 2)
    queries_embedded = model.encode_query([query_input(q, frames, cfg) for q in queries])
    frames_embedded = model.encode_document([frame_input(f, frames) for f in database])
    scores = model.similarity(queries_embedded, frames_embedded).cpu().numpy()
    gold = np.array([database.index(q.target) for q in queries])
    metrics = evaluator(model)
    own = scores[np.arange(len(queries)), gold][:, None]
    ranks = 1 + (scores > own).sum(1)
    assert metrics["mrr"] == pytest.approx((1 / ranks).mean(), abs=0.02)
    assert metrics["recall@10"] == pytest.approx((ranks <= 10).mean(), abs=0.2)
