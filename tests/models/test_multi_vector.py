"""The multi-vector retriever: the tokens whose vectors are scored, and that sentence-transformers
loads a saved retriever without this project."""

from __future__ import annotations

import sys
from dataclasses import replace

import pytest
import torch
from sentence_transformers import MultiVectorEncoder
from transformers import dynamic_module_utils

from dynapix.conf.compose import compose, register
from dynapix.conf.schema import ContrastiveCommand, LateConfig
from dynapix.models.retriever.embedder import load_retriever, load_trained, tokenizer_texts
from dynapix.models.retriever.inputs import frame_input, query_input
from dynapix.models.retriever.multi_vector import find_scored_tokens
from dynapix.models.retriever.scored_tokens import ScoredTokens
from dynapix.train.common.audit import audit_retriever

FRAME_TOKENS = 9
"""Tokens of a frame of 96 px, and of each of the six pairs of frames of a clip."""


def load(cfg, micro_store, folder) -> MultiVectorEncoder:
    """Return an untrained retriever."""
    torch.manual_seed(0)
    texts = tokenizer_texts(micro_store.retrieval("train"), cfg)
    return load_retriever(cfg, "fp32", texts, folder)


@pytest.fixture(scope="module")
def late_cfg(retriever_cfg):
    return replace(retriever_cfg, late=LateConfig(width=24))


@pytest.fixture(scope="module")
def model(late_cfg, micro_store, tmp_path_factory) -> MultiVectorEncoder:
    return load(late_cfg, micro_store, tmp_path_factory.mktemp("base"))


def test_only_the_question_and_the_pixels_are_scored(model, late_cfg, queries, frames) -> None:
    """This also holds in padded rows, and if the question contains words of a timestamp and of the
    instruction."""
    similar = replace(
        queries[0], question="<0.1 seconds> Retrieve images: user's query, 0.5 seconds"
    )
    features = model.preprocess(
        [query_input(q, frames, late_cfg) for q in (similar, queries[-1])],
        prompt=late_cfg.query_instruction,
    )
    ids = features["input_ids"]
    scored = find_scored_tokens(model).scored(ids, features["attention_mask"])
    video = model.tokenizer.convert_tokens_to_ids("<|video_pad|>")
    for query, row, kept in zip((similar, queries[-1]), ids, scored, strict=True):
        assert (row[kept] == video).sum() == (row == video).sum() == 6 * FRAME_TOKENS
        assert model.tokenizer.decode(row[kept & (row != video)]) == query.question
    image_inputs = model.preprocess(
        [frame_input(similar.target, frames)], prompt=late_cfg.frame_instruction
    )
    kept = find_scored_tokens(model).scored(
        image_inputs["input_ids"], image_inputs["attention_mask"]
    )[0]
    image = model.tokenizer.convert_tokens_to_ids("<|image_pad|>")
    assert image_inputs["input_ids"][0][kept].tolist() == [image] * FRAME_TOKENS


def test_an_input_without_pixels_is_refused(model) -> None:
    with pytest.raises(ValueError, match="neither an image nor a clip"):
        model.encode_query(["Which frame?"])


def test_vectors_are_the_scored_tokens_projected_and_normalised(
    model, late_cfg, queries, frames
) -> None:
    """They depend neither on other inputs of a batch nor on the states of tokens that are not
    scored."""
    inputs = [query_input(q, frames, late_cfg) for q in (queries[0], queries[-1])]
    together = model.encode_query(inputs)
    assert len(together[0]) != len(together[1])
    for one, vectors in zip(inputs, together, strict=True):
        features = model.preprocess([one], prompt=late_cfg.query_instruction, task="query")
        kept = find_scored_tokens(model).scored(features["input_ids"], features["attention_mask"])[
            0
        ]
        with torch.no_grad():
            states = model[0](dict(features))["token_embeddings"][0]
            outputs = torch.nn.functional.normalize(states[kept] @ model[1].linear.weight.T, dim=1)
        torch.testing.assert_close(vectors, outputs, atol=1e-5, rtol=0)

        def spoil(module, given, outputs, kept=kept):
            outputs["token_embeddings"][:, ~kept] = 7.0

        hook = model[0].register_forward_hook(spoil)
        spoilt = model.encode_query([one])[0]
        hook.remove()
        torch.testing.assert_close(spoilt, vectors, atol=1e-5, rtol=0)


def test_a_saved_retriever_encodes_the_same_without_this_project(
    micro_store, late_cfg, queries, frames, tmp_path, monkeypatch
) -> None:
    cfg = late_cfg
    model = load(cfg, micro_store, tmp_path / "base")
    saved = tmp_path / "saved"
    model.save_pretrained(str(saved), create_model_card=False)
    again = load_trained(cfg, "fp32", saved)
    monkeypatch.setattr(dynamic_module_utils, "HF_MODULES_CACHE", str(tmp_path / "modules"))
    for name in [name for name in sys.modules if name.partition(".")[0] == "dynapix"]:
        monkeypatch.setitem(sys.modules, name, None)
    alone = MultiVectorEncoder(str(saved), device="cpu", trust_remote_code=True)
    assert ScoredTokens not in map(type, alone)
    inputs = [query_input(queries[0], frames, cfg), frame_input(queries[0].target, frames)]
    for one in (alone, again):
        for vectors, expected in zip(
            vectors_by(model, inputs), vectors_by(one, inputs), strict=True
        ):
            torch.testing.assert_close(vectors, expected, atol=1e-6, rtol=0)


def vectors_by(model, inputs) -> list[torch.Tensor]:
    return [model.encode_query(inputs[:1])[0], model.encode_document(inputs[1:])[0]]


def test_code_in_a_saved_folder_is_not_executed(micro_store, late_cfg, tmp_path) -> None:
    model = load(late_cfg, micro_store, tmp_path / "base")
    model.save_pretrained(str(tmp_path / "saved"), create_model_card=False)
    (tmp_path / "saved" / "scored_tokens.py").write_text("raise RuntimeError('this ran')")
    assert find_scored_tokens(load_trained(late_cfg, "fp32", tmp_path / "saved")).media_ids


def test_the_audit_marks_scored_tokens(model, late_cfg, queries, frames) -> None:
    audit = audit_retriever(model, late_cfg, queries[0], frames)
    length = len(model.tokenizer(queries[0].question, add_special_tokens=False).input_ids)
    assert f"{6 * FRAME_TOKENS + length} of them scored" in audit
    assert f"{FRAME_TOKENS} of them scored" in audit
    assert f">>>{queries[0].question}<<<<|im_end|>" in audit
    assert audit.count(">>><|video_pad|>...<<<") == 6
    assert ">>><|image_pad|>...<<<" in audit


@pytest.mark.parametrize("retriever", ["tiny", "qwen3_vl_emb_8b"])
def test_the_overlay_turns_any_retriever_into_a_multi_vector_one(retriever) -> None:
    register("train.contrastive", ContrastiveCommand)
    one, many = (
        compose("train.contrastive", ContrastiveCommand, [f"retriever={retriever}", *overlay])
        for overlay in ([], ["+exp=late_interaction"])
    )
    assert one.retriever.late is None
    assert many.retriever == replace(one.retriever, late=LateConfig())
    assert many.train == replace(one.train, scale=1.0)
