"""The retriever's inputs, and that what is saved is a plain SentenceTransformer."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from datasets import Dataset
from sentence_transformers import SentenceTransformer
from sentence_transformers.base.sampler import NoDuplicatesBatchSampler

from conf.errors import UserError
from conf.schema import LoraConfig
from data.records import FPS, shown_frames
from train import retriever
from train.audit import audit_retriever
from train.backbone import keep_differentiable
from train.retriever import LateFrames, column_prompts, frame_input, query_input
from train.towers import count_towers


def load(micro_store, cfg, folder) -> SentenceTransformer:
    texts = retriever.corpus(micro_store.retrieval("train"), cfg)
    return retriever.load_retriever(cfg, "fp32", texts, folder)


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
    shown = shown_frames(query.prefix_start, query.prefix_stop, 12)
    assert f"<{(shown[0] + shown[1]) / 2 / FPS:.1f} seconds>" in text
    assert "of 6 x 3 x 3 tokens" in audit_retriever(model, retriever_cfg, query, frames)


def test_a_long_query_is_refused_and_never_cut(
    micro_store, frames, retriever_cfg, tmp_path
) -> None:
    model = load(micro_store, retriever_cfg, tmp_path)
    short = micro_store.retrieval("train")[0]
    long = replace(short, question="Which frame? " * 2000)
    assert retriever.longest_query([short, long, short], model.tokenizer) is long
    with pytest.raises(UserError, match=rf"query {long.query_id} has \d{{4,}} tokens, more than"):
        audit_retriever(model, retriever_cfg, long, frames)


def test_the_embedding_is_the_last_tokens_state_normalised(
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


def test_a_saved_retriever_encodes_the_same_without_this_project(
    micro_store, frames, retriever_cfg, tmp_path
) -> None:
    model = load(micro_store, retriever_cfg, tmp_path / "base")
    model.save_pretrained(str(tmp_path / "saved"), create_model_card=False)
    again = SentenceTransformer(str(tmp_path / "saved"), device="cpu")
    query = micro_store.retrieval("train")[0]
    for inputs in (
        [query_input(query, frames, retriever_cfg)],
        [frame_input(query.target, frames)],
    ):
        np.testing.assert_allclose(
            model.encode(inputs, prompt_name="query"),
            again.encode(inputs, prompt_name="query"),
            atol=1e-6,
        )


def test_adapters_are_read_back_over_the_4_bit_weights_they_were_trained_on(
    micro_store, frames, retriever_cfg, saved_base, tmp_path
) -> None:
    cfg = replace(
        retriever_cfg, architecture=None, model=saved_base, quantization="nf4", lora=LoraConfig()
    )
    model = load(micro_store, cfg, tmp_path)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if "lora_B" in name:
                weight.normal_(std=0.1, generator=torch.Generator().manual_seed(0))
    model.save_pretrained(str(tmp_path / "saved"), create_model_card=False)
    again = retriever.load_trained(cfg, "fp32", tmp_path / "saved")
    assert count_towers(again)["language"].four_bit > 0
    keep_differentiable(again)
    query = [query_input(micro_store.retrieval("train")[0], frames, cfg)]
    one, two = (m.encode(query, prompt_name="query") for m in (model, again))
    np.testing.assert_allclose(one, two, atol=1e-5)


def test_no_frame_of_a_batch_is_a_negative_of_itself(micro_store) -> None:
    """The library's sampler keeps rows that name one frame apart, whatever column it is in."""
    rows = [retriever.row(q, 1) for q in micro_store.retrieval("train")]
    frames = [f for row in rows for f in (row["target"], row["negative_0"])]
    assert len(set(frames)) < len(frames)
    sampler = NoDuplicatesBatchSampler(
        Dataset.from_list(rows), batch_size=4, drop_last=True, generator=torch.Generator(), seed=0
    )
    for batch in sampler:
        shown = [f for k in batch for f in (rows[k]["target"], rows[k]["negative_0"])]
        assert len(set(shown)) == len(shown) == 8


def test_a_batch_reads_the_pixels_of_its_rows_alone(
    micro_store, frames, retriever_cfg, tmp_path
) -> None:
    model = load(micro_store, retriever_cfg, tmp_path)
    queries = micro_store.retrieval("train")
    rows = [retriever.row(queries[k], 1) for k in (3, 0)]
    prompts = column_prompts(retriever_cfg, rows[0])
    collate = LateFrames(preprocess_fn=model.preprocess, prompts=prompts)
    collate.resolve(queries, frames, retriever_cfg)
    batch = collate(rows)
    one = model.preprocess(
        [frame_input(queries[3].target, frames)], prompt=retriever_cfg.frame_instruction
    )
    torch.testing.assert_close(batch["target_pixel_values"][:36], one["pixel_values"])
    assert {k.partition("_input_ids")[0] for k in batch if k.endswith("input_ids")} == {
        "query",
        "target",
        "negative_0",
    }
