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
from dynapix.data.records import FPS, sample_prefix_frames
from dynapix.models.layers.attention import BY_FRAME
from dynapix.models.retriever import embedder
from dynapix.models.retriever.inputs import frame_input, query_input
from dynapix.models.towers import count_parameters
from dynapix.train.common.audit import audit_retriever
from dynapix.train.retriever.evaluator import HeldOutEvaluator, build_database
from tests.tiny_models import randomize_adapters
from tests.user_errors import raises_user_error

LATE = LateConfig(width=24)


def load(micro_store, cfg, folder) -> SentenceTransformer:
    texts = embedder.tokenizer_texts(micro_store.retrieval("train"), cfg)
    return embedder.load_retriever(cfg, "fp32", texts, folder)


@pytest.fixture(scope="module")
def model(micro_store, retriever_cfg, tmp_path_factory) -> SentenceTransformer:
    return load(micro_store, retriever_cfg, tmp_path_factory.mktemp("base"))


@pytest.mark.parametrize("fps", [FPS, 12])
def test_a_query_has_the_released_embedding_format_and_its_true_times(
    model, micro_store, frames, retriever_cfg, monkeypatch, fps
) -> None:
    """Scenes of other simulators have other numbers of frames per second."""
    query = micro_store.retrieval("train")[0]
    scene = replace(frames.scene(query.scene_id), fps=fps)
    monkeypatch.setattr(frames, "scene", lambda _: scene)
    prompt = retriever_cfg.query_instruction
    features = model.preprocess([query_input(query, frames, retriever_cfg)], prompt=prompt)
    assert features["video_grid_thw"].tolist() == [[6, 6, 6]]
    indices = sample_prefix_frames(query.prefix_start, query.prefix_stop, 12)
    times = [(a + b) / 2 / fps for a, b in zip(indices[::2], indices[1::2], strict=True)]
    frame = f"<|vision_start|>{'<|video_pad|>' * 9}<|vision_end|>"
    clip = "".join(f"<{time:.1f} seconds>{frame}" for time in times)
    assert model.tokenizer.decode(features["input_ids"][0]) == (
        f"<|im_start|>system\n{prompt}<|im_end|>\n<|im_start|>user\n{clip}{query.question}"
        "<|im_end|>\n<|im_start|>assistant\n"
    )
    assert "of 6 x 3 x 3 tokens" in audit_retriever(model, retriever_cfg, query, frames)


def test_a_long_query_is_refused_instead_of_truncated(
    model, micro_store, frames, retriever_cfg
) -> None:
    short = micro_store.retrieval("train")[0]
    long = replace(short, question="Which frame? " * 2000)
    assert embedder.longest_query([short, long, short], model.tokenizer) is long
    with pytest.raises(UserError, match=rf"query {long.query_id} has \d{{4,}} tokens, more than"):
        audit_retriever(model, retriever_cfg, long, frames)


def test_the_embedding_is_the_normalised_state_of_the_last_token(
    model, micro_store, frames, retriever_cfg, tmp_path
) -> None:
    """Also that of a merged export, which has the attention of its base."""
    images = [frame_input(f, frames) for f in micro_store.database()[:2]]
    features = model.preprocess(images, prompt=retriever_cfg.frame_instruction)
    with torch.no_grad():
        states = model[0](dict(features))["token_embeddings"]
    last = states[:, -1] / states[:, -1].norm(dim=-1, keepdim=True)
    model.save_pretrained(str(tmp_path), create_model_card=False)
    merged = embedder.load_merged(tmp_path, retriever_cfg)
    for each in (model, merged):
        encoded = each.encode(images, prompt=retriever_cfg.frame_instruction)
        np.testing.assert_allclose(encoded, last.numpy(), atol=1e-5)
    text, vision = (
        [
            getattr(m[0].model.config, f"{tower}_config")._attn_implementation
            for m in (model, merged)
        ]
        for tower in ("text", "vision")
    )
    assert text[0] == text[1]
    assert vision == [BY_FRAME] * 2


@pytest.mark.parametrize(("quantization", "late"), [("nf4", None), ("none", LATE), ("nf4", LATE)])
def test_adapters_and_projection_are_fp32_over_the_base_they_were_trained_on(
    micro_store, frames, retriever_cfg, saved_base, tmp_path, quantization, late
) -> None:
    over = {"architecture": None, "model": saved_base, "quantization": quantization, "late": late}
    cfg = replace(retriever_cfg, **over, lora=LoraConfig())
    model = embedder.load_retriever(cfg, "bf16", [], tmp_path)
    randomize_adapters(model, 0.1)
    trained = {name: p for name, p in model.named_parameters() if p.requires_grad}
    assert {p.dtype for p in trained.values()} == {torch.float32}
    assert ("1.linear.weight" in trained) == (late is not None)
    assert next(model[0].parameters()).dtype == torch.bfloat16
    model.save_pretrained(str(tmp_path / "saved"), create_model_card=False)
    again = embedder.load_trained(cfg, "bf16", tmp_path / "saved")
    for each in (model, again):
        towers = count_parameters(each)
        assert (towers.loc["language", "4-bit"] > 0) == (quantization == "nf4")
        assert ("projection" in towers.index) == (late is not None)
    query = [query_input(micro_store.retrieval("train")[0], frames, cfg)]
    one, two = (torch.as_tensor(m.encode_query(query)[0]) for m in (model, again))
    assert one.isfinite().all()
    torch.testing.assert_close(one, two, atol=1e-5, rtol=0)


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


@pytest.mark.parametrize("late", [None, LATE])
def test_the_evaluator_ranks_as_the_library_with_all_pixels_in_memory(
    micro_store, frames, retriever_cfg, tmp_path, late
) -> None:
    """The evaluator loads the pixels by mini-batches."""
    cfg = replace(retriever_cfg, late=late)
    model = load(micro_store, cfg, tmp_path).eval()
    queries = micro_store.retrieval("train")[:7]
    database = build_database(queries, micro_store)
    queries_embedded = model.encode_query([query_input(q, frames, cfg) for q in queries])
    frames_embedded = model.encode_document([frame_input(f, frames) for f in database])
    scores = model.similarity(queries_embedded, frames_embedded).cpu().numpy()
    gold = np.array([database.index(q.target) for q in queries])
    metrics = HeldOutEvaluator(queries, database, frames, cfg, 2)(model)
    own = scores[np.arange(len(queries)), gold][:, None]
    ranks = 1 + (scores > own).sum(1)
    assert metrics["mrr"] == pytest.approx((1 / ranks).mean(), abs=0.02)
    assert metrics["recall@10"] == pytest.approx((ranks <= 10).mean(), abs=0.2)
