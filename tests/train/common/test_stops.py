"""What a run must not do: train on what measures it or on other GPUs, or go on where it cannot."""

from __future__ import annotations

import json
import os
from dataclasses import replace
from typing import Any

import pytest
import torch

from conf import gpus
from conf.entry import Run
from conf.schema import SftCommand
from data.records import SelectionItem
from data.store import Store
from tests.user_errors import raises_user_error
from train import sft
from train.common.held_out import held_out_scenes
from train.student.dataset import shows_only
from train.student.run import load_datasets
from train.student.trainer import token_mean


@pytest.fixture
def settings(few_steps) -> SftCommand:
    return few_steps(regime="answer_only", max_steps=3, evaluations=1)


@pytest.mark.slow
def test_a_loss_that_is_no_number_stops_with_its_samples(settings, micro_store, tmp_path) -> None:
    too_fast = replace(settings, train=replace(settings.train, lr=1e30, warmup=0.0))
    with raises_user_error("non-finite-loss", contains="stopped.json"):
        sft.main.__wrapped__(too_fast, Run("run", tmp_path))
    told = json.loads((tmp_path / "stopped.json").read_text())
    named = {f"{item.item_id} (answer)" for item in micro_store.selection("train")}
    assert len(told["samples"]) == 2
    assert set(told["samples"]) <= named


class Spoilt(torch.autograd.Function):
    """A loss that is a number, with a gradient that is none."""

    @staticmethod
    def forward(ctx: Any, loss: torch.Tensor) -> torch.Tensor:
        return loss.clone()

    @staticmethod
    def backward(ctx: Any, given: torch.Tensor) -> torch.Tensor:
        return given * torch.nan


@pytest.mark.slow
def test_a_gradient_that_is_no_number_stops_with_its_steps_samples(
    settings, tmp_path, monkeypatch
) -> None:
    def spoilt(*given: Any, **named: Any) -> torch.Tensor:
        return Spoilt.apply(token_mean(*given, **named))

    monkeypatch.setattr("train.student.run.token_mean", spoilt)
    with raises_user_error("non-finite-gradient", contains="stopped.json"):
        sft.main.__wrapped__(settings, Run("run", tmp_path))
    told = json.loads((tmp_path / "stopped.json").read_text())
    assert len(told["samples"]) == settings.train.batch
    assert not list(tmp_path.glob("checkpoint-*"))


@pytest.mark.slow
def test_too_little_memory_is_told_with_the_key_to_lower(settings, tmp_path, monkeypatch) -> None:
    def greedy(*_, **__) -> torch.Tensor:
        return torch.empty(1 << 50)

    monkeypatch.setattr("train.student.run.token_mean", greedy)
    with raises_user_error("out-of-memory", contains="train.micro_batch"):
        sft.main.__wrapped__(settings, Run("run", tmp_path))


class OneMore:
    """A store with one more training item."""

    def __init__(self, store: Store, item: SelectionItem) -> None:
        self.store, self.item = store, item

    def selection(self, split: str) -> list[SelectionItem]:
        return [*self.store.selection(split), self.item]

    def __getattr__(self, name: str) -> Any:
        return getattr(self.store, name)


@pytest.mark.parametrize("regime", ["answer_only", "describe"])
def test_nothing_is_trained_on_that_shows_a_held_out_scene(
    settings, micro_store, frames, regime
) -> None:
    held_out = held_out_scenes(micro_store)
    others = set(micro_store.scene_ids("train")) - held_out
    item = next(i for i in micro_store.selection("train") if shows_only(i, others))
    stranger = replace(item.candidates[item.answer - 1], scene_id=next(iter(held_out)))
    candidates = list(item.candidates)
    candidates[item.answer - 1] = stranger
    crossed = replace(item, item_id="crossed", candidates=tuple(candidates))
    told = replace(settings, train=replace(settings.train, regime=regime))
    plain, _ = load_datasets(told, micro_store, [])
    more, _ = load_datasets(told, OneMore(micro_store, crossed), [])
    again, _ = load_datasets(told, OneMore(micro_store, replace(item, item_id="again")), [])
    assert len(plain) == len(more) < len(again)


@pytest.mark.parametrize(
    ("visible", "rank", "kept"),
    [("2,3", None, "2"), ("1", None, "1"), ("", None, ""), ("2,3", "0", "2,3")],
)
def test_a_run_keeps_to_one_gpu_unless_ranks_were_started(monkeypatch, visible, rank, kept) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    if rank is not None:
        monkeypatch.setenv("LOCAL_RANK", rank)
    gpus.restrict_to_one_gpu()
    assert os.environ["CUDA_VISIBLE_DEVICES"] == kept
