"""The multi-vector retriever: what is scored, its loss held against the library's, and that what
is saved is a plain MultiVectorEncoder."""

from __future__ import annotations

import os
import re
import subprocess
import sys
from dataclasses import replace

import pytest
import torch
from sentence_transformers import MultiVectorEncoder
from sentence_transformers.multi_vector_encoder.losses import (
    CachedMultiVectorMultipleNegativesRankingLoss,
)
from sentence_transformers.util.similarity import maxsim
from torch.nn.functional import cross_entropy

from conf.schema import LateConfig, LoraConfig
from train.audit import audit_retriever
from train.batches import batch_of
from train.inputs import Inputs
from train.late import scored_tokens
from train.late_loss import LateRankingLoss
from train.negatives import Weighing
from train.retriever import corpus, frame_input, load_retriever, load_trained, query_input

SCALE = 0.5
NEGATIVES = 2
FRAME = 9
"""Tokens of a frame of 96 px; a clip has as many for each of its six pairs of frames."""


def load(cfg, micro_store, folder, noise: float = 0.0) -> MultiVectorEncoder:
    """In which adapters, if any, already do something."""
    torch.manual_seed(0)
    model = load_retriever(cfg, "fp32", corpus(micro_store.retrieval("train"), cfg), folder)
    with torch.no_grad():
        for name, weight in model.named_parameters():
            if "lora_B" in name:
                weight.normal_(std=noise)
    return model


@pytest.fixture(scope="module")
def late_cfg(retriever_cfg):
    return replace(retriever_cfg, late=LateConfig(width=24))


@pytest.fixture(scope="module")
def queries(micro_store):
    """Ten of several lengths, some of one prefix and some that name one frame."""
    asked = micro_store.retrieval("train")[:6]
    again = [
        replace(
            q,
            query_id=f"{q.query_id} again",
            question=f"{q.question} Or else, which frame comes before that?",
            target=q.hard_negatives[0],
            hard_negatives=(q.target, asked[0].target),
        )
        for q in asked[1:5]
    ]
    return [*asked, *again]


@pytest.fixture(scope="module", params=["whole", "adapters", "pooled"])
def trained(request, micro_store, late_cfg, saved_base, tmp_path_factory):
    cfg = late_cfg
    if request.param == "adapters":
        cfg = replace(cfg, architecture=None, model=saved_base, lora=LoraConfig(rank=4))
    if request.param == "pooled":
        cfg = replace(cfg, late=LateConfig(width=24, pool=2))
    return load(cfg, micro_store, tmp_path_factory.mktemp("base"), noise=0.05).train(), cfg


def columns_of(model, cfg, queries, frames) -> list[dict]:
    """As a data collator of the library's makes them of a batch."""
    shown = [[q.target, *q.hard_negatives[:NEGATIVES]] for q in queries]
    asked = [query_input(q, frames, cfg) for q in queries]
    return [
        model.preprocess(asked, prompt=cfg.query_instruction, task="query"),
        *(
            model.preprocess(
                [frame_input(f, frames) for f in column],
                prompt=cfg.frame_instruction,
                task="document",
            )
            for column in zip(*shown, strict=True)
        ),
    ]


@pytest.fixture(scope="module")
def library(trained, queries, frames) -> tuple[float, dict[str, torch.Tensor]]:
    model, cfg = trained
    loss = CachedMultiVectorMultipleNegativesRankingLoss(model, scale=SCALE, mini_batch_size=4)
    return gradients(model, loss, columns_of(model, cfg, queries, frames))


def gradients(model, loss, features) -> tuple[float, dict[str, torch.Tensor]]:
    model.zero_grad()
    found = loss(features, None)
    found.backward()
    trained = {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}
    return found.item(), trained


def ours(trained, queries, frames, store, distinct=True, shared=True, **settings):
    model, cfg = trained
    settings = {"mini_batch": 4, "weighing": Weighing(store), "scale": SCALE, **settings}
    loss = LateRankingLoss(model, Inputs(model, frames, cfg, "fp32"), **settings)
    return gradients(model, loss, [batch_of(queries, NEGATIVES, distinct, shared)])


@pytest.mark.parametrize(
    "settings",
    [
        {"distinct": False, "shared": False},
        {"distinct": True, "shared": False},
        {"mini_batch": 1},
        {"mini_batch": 12, "ahead": 2},
        {"mini_batch_tokens": 400},
    ],
    ids=str,
)
def test_gradients_are_the_librarys(
    trained, queries, frames, micro_store, library, settings
) -> None:
    loss, found = ours(trained, queries, frames, micro_store, **settings)
    assert loss == pytest.approx(library[0], rel=1e-5)
    assert found.keys() == library[1].keys()
    for name, gradient in library[1].items():
        apart = (found[name] - gradient).norm() / gradient.norm().clamp(min=1e-9)
        assert apart < 1e-4, (name, apart)
