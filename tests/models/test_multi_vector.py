"""The multi-vector retriever: the tokens whose vectors are scored, and that sentence-transformers
loads a saved retriever without this project."""

from __future__ import annotations

import sys
from dataclasses import replace

import pytest
import torch
from sentence_transformers import MultiVectorEncoder
from transformers import dynamic_module_utils

from dynapix.conf.schema import LateConfig
from dynapix.models.retriever.embedder import load_retriever, load_trained, tokenizer_texts
from dynapix.models.retriever.inputs import frame_input, query_input
from dynapix.models.retriever.multi_vector import find_scored_tokens
from dynapix.models.retriever.scored_tokens import ScoredTokens
from dynapix.train.common.audit import audit_retriever

FRAME_TOKENS = 9
"""Tokens of a frame of 96 px, and of each of the six pairs of frames of a clip."""


@pytest.fixture(scope="module")
def cfg(retriever_cfg):
    return replace(retriever_cfg, late=LateConfig(width=24))


@pytest.fixture(scope="module")
def model(cfg, micro_store, tmp_path_factory) -> MultiVectorEncoder:
    torch.manual_seed(0)
    texts = tokenizer_texts(micro_store.retrieval("train"), cfg)
    return load_retriever(cfg, "fp32", texts, tmp_path_factory.mktemp("base"))


def test_only_the_question_and_the_pixels_are_scored(model, cfg, queries, frames) -> None:
    """This also holds in padded rows, and if the question contains words of a timestamp and of the
    instruction."""
    similar = replace(
        queries[0], question="<0.1 seconds> Retrieve images: user's query, 0.5 seconds"
    )
    asked = (similar, queries[-1])
    features = model.preprocess(
        [query_input(q, frames, cfg) for q in asked], prompt=cfg.query_instruction
    )
    ids, scored = features["input_ids"], find_scored_tokens(model).scored
    video, image = model.tokenizer.convert_tokens_to_ids(["<|video_pad|>", "<|image_pad|>"])
    kept = scored(ids, features["attention_mask"])
    for query, row, tokens in zip(asked, ids, kept, strict=True):
        assert (row[tokens] == video).sum() == (row == video).sum() == 6 * FRAME_TOKENS
        assert model.tokenizer.decode(row[tokens & (row != video)]) == query.question
    features = model.preprocess([frame_input(similar.target, frames)], prompt=cfg.frame_instruction)
    kept = scored(features["input_ids"], features["attention_mask"])
    assert features["input_ids"][kept].tolist() == [image] * FRAME_TOKENS
    audit = audit_retriever(model, cfg, queries[0], frames)
    assert f">>>{queries[0].question}<<<<|im_end|>" in audit
    assert audit.count(">>><|video_pad|>...<<<") == 6
    assert f"{FRAME_TOKENS} of them scored" in audit
    with pytest.raises(ValueError, match="neither an image nor a clip"):
        model.encode_query(["Which frame?"])


def test_vectors_are_the_scored_tokens_projected_and_normalised(
    model, cfg, queries, frames
) -> None:
    """They depend neither on other inputs of a batch nor on the states of tokens that are not
    scored."""
    inputs = [query_input(q, frames, cfg) for q in (queries[0], queries[-1])]
    together = model.encode_query(inputs)
    assert len(together[0]) != len(together[1])
    for one, vectors in zip(inputs, together, strict=True):
        features = model.preprocess([one], prompt=cfg.query_instruction, task="query")
        ids, mask = features["input_ids"], features["attention_mask"]
        kept = find_scored_tokens(model).scored(ids, mask)[0]
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
    model, cfg, queries, frames, tmp_path, monkeypatch
) -> None:
    """This project does not execute the code in the saved folder."""
    saved = tmp_path / "saved"
    model.save_pretrained(str(saved), create_model_card=False)
    code = (saved / "scored_tokens.py").read_text()
    (saved / "scored_tokens.py").write_text("raise RuntimeError('this ran')")
    again = load_trained(cfg, "fp32", saved)
    (saved / "scored_tokens.py").write_text(code)
    monkeypatch.setattr(dynamic_module_utils, "HF_MODULES_CACHE", str(tmp_path / "modules"))
    for name in [name for name in sys.modules if name.partition(".")[0] == "dynapix"]:
        monkeypatch.setitem(sys.modules, name, None)
    alone = MultiVectorEncoder(str(saved), device="cpu", trust_remote_code=True)
    assert ScoredTokens not in map(type, alone)
    query, frame = query_input(queries[0], frames, cfg), frame_input(queries[0].target, frames)
    expected, *found = (
        (m.encode_query([query])[0], m.encode_document([frame])[0]) for m in (model, again, alone)
    )
    for each in found:
        torch.testing.assert_close(each, expected, atol=1e-6, rtol=0)
