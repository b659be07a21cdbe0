"""What the retriever's trainer chooses for itself fits, moves nothing that is learnt, and leaves no
trace."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from conf.entry import Run
from conf.schema import LateConfig
from models.retriever.embedder import load_retriever, tokenizer_texts
from train import contrastive
from train.common import memory_probe
from train.common.journal import read_journal
from train.retriever.inputs import RetrieverInputs
from train.retriever.late_loss import MultiVectorRankingLoss
from train.retriever.loss import RankingLoss
from train.retriever.mini_batches import MiniBatches, settle


@pytest.fixture
def train(contrastive_settings):
    auto = {"mini_batch": "auto", "gradient_checkpointing": "auto", "batch": 8}
    return replace(contrastive_settings.train, **auto)


@pytest.fixture(params=[None, LateConfig(width=24)], ids=["one", "late"])
def given(request, micro_store, frames, retriever_cfg, tmp_path):
    cfg = replace(retriever_cfg, late=request.param)
    texts = tokenizer_texts(micro_store.retrieval("train"), cfg)
    model = load_retriever(cfg, "fp32", texts, tmp_path / "untrained")
    ranking = MultiVectorRankingLoss if request.param else RankingLoss
    return (
        model,
        RetrieverInputs(model, frames, cfg, "fp32"),
        ranking,
        micro_store.retrieval("train")[:12],
    )


def test_a_probe_leaves_no_trace_and_a_note(train, given, tmp_path, monkeypatch) -> None:
    model = given[0]
    before = {name: weight.clone() for name, weight in model.state_dict().items()}
    torch.manual_seed(3)
    drawn = torch.rand(3)
    torch.manual_seed(3)
    found = settle(train, tmp_path, *given)
    assert torch.equal(torch.rand(3), drawn)
    assert all(torch.equal(weight, before[name]) for name, weight in model.state_dict().items())
    assert all(parameter.grad is None for parameter in model.parameters())
    assert not model[0].model.is_gradient_checkpointing
    assert 1 <= found.mini_batch <= train.batch
    assert found.gradient_checkpointing is False
    # A run that goes on takes what was noted.
    monkeypatch.setattr(memory_probe, "choose", None)
    assert settle(train, tmp_path, *given) == found
    numbers = replace(train, mini_batch=3, gradient_checkpointing=True)
    assert settle(numbers, tmp_path, *given) == numbers


def test_where_memory_is_short_activations_are_recomputed(
    train, given, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr(memory_probe, "available", lambda _: 1 << 20)
    found = settle(train, tmp_path, *given)
    assert (found.mini_batch, found.gradient_checkpointing) == (1, True)


def test_more_at_once_hold_more(train, given) -> None:
    """The longest are tried, and nothing beyond those that there are."""
    trial = MiniBatches(*given, train, 8)
    lengths = [sum(len(q.question) for q in group) for group in trial._longest]
    assert lengths[0] == max(lengths)
    one, four = (trial.bytes(size, recompute=False) for size in (1, 4))
    assert one < four < 8 * one
    assert trial.bytes(64, recompute=False) > four
    assert trial.seconds(4, recompute=False) > 0


@pytest.mark.slow
def test_what_is_chosen_learns_what_a_given_one_learns(contrastive_settings, tmp_path) -> None:
    journals = []
    for name, train in (
        ("auto", {"mini_batch": "auto", "gradient_checkpointing": "auto"}),
        ("given", {"mini_batch": 1, "gradient_checkpointing": True}),
    ):
        settings = replace(contrastive_settings, train=replace(contrastive_settings.train, **train))
        (tmp_path / name).mkdir()
        contrastive.main.__wrapped__(settings, Run(name, tmp_path / name))
        journals.append(read_journal(tmp_path / name))
    chosen = json.loads((tmp_path / "auto" / memory_probe.NOTE).read_text())
    assert chosen["gradient_checkpointing"] is False
    assert not (tmp_path / "given" / memory_probe.NOTE).exists()
    for one, two in zip(*journals, strict=True):
        assert one == pytest.approx(two, rel=1e-3)


def test_what_cannot_go_together_is_told(contrastive_settings) -> None:
    for change, said in (
        ({"mini_batch": "auto", "mini_batch_tokens": 512}, "train.mini_batch_tokens=512"),
        ({"mini_batch": "some"}, "train.mini_batch=some: give a number or auto"),
        ({"gradient_checkpointing": "some"}, "train.gradient_checkpointing=some"),
    ):
        (problem,) = replace(contrastive_settings.train, **change).check()
        assert said in problem
