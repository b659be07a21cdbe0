"""Errors that stop a training run, scenes that it must not train on, and the GPU that it uses."""

from __future__ import annotations

import json
import os
import resource
from dataclasses import replace
from typing import Any

import pytest
import torch
from safetensors.torch import save_file

from dynapix.conf import gpus
from dynapix.conf.entry import Run
from dynapix.conf.failures import report_failures
from dynapix.conf.schema import SftCommand
from dynapix.data.store import Store
from dynapix.train import sft
from dynapix.train.common.held_out import HELD_OUT_SHARE, held_out_scenes
from dynapix.train.student.dataset import split_items, uses_only
from dynapix.train.student.trainer import LOSSES, token_mean
from tests.user_errors import raises_user_error


@pytest.fixture
def settings(few_steps) -> SftCommand:
    return few_steps(regime="answer_only", max_steps=3, evaluations=1)


@pytest.mark.slow
def test_a_non_finite_loss_stops_the_run(settings, micro_store, tmp_path) -> None:
    too_fast = replace(settings, train=replace(settings.train, lr=1e30, warmup=0.0))
    with raises_user_error("non-finite-loss", contains="stopped.json"):
        sft.main.__wrapped__(too_fast, Run("run", tmp_path))
    samples = json.loads((tmp_path / "stopped.json").read_text())["samples"]
    assert len(samples) == 2
    assert set(samples) <= {f"{i.item_id} (answer)" for i in micro_store.selection("train")}


class NanGradient(torch.autograd.Function):
    """Returns a loss unchanged, but its gradient is NaN."""

    @staticmethod
    def forward(ctx: Any, loss: torch.Tensor) -> torch.Tensor:
        return loss.clone()

    @staticmethod
    def backward(ctx: Any, gradient: torch.Tensor) -> torch.Tensor:
        return gradient * torch.nan


@pytest.mark.slow
def test_a_non_finite_gradient_stops_the_run(few_steps, tmp_path, monkeypatch) -> None:
    def loss(*args: Any, **options: Any) -> torch.Tensor:
        return NanGradient.apply(token_mean(*args, **options))

    monkeypatch.setitem(LOSSES, "token", loss)
    settings = few_steps(regime="answer_only", batch=4, micro_batch=2)
    with raises_user_error("non-finite-gradient", contains="stopped.json"):
        sft.main.__wrapped__(settings, Run("run", tmp_path))
    assert len(json.loads((tmp_path / "stopped.json").read_text())["samples"]) == 4
    assert not list(tmp_path.glob("checkpoint-*"))


@pytest.mark.slow
def test_too_little_memory_names_the_settings_to_lower(settings, tmp_path, monkeypatch) -> None:
    monkeypatch.setitem(LOSSES, "token", lambda *_, **__: torch.empty(1 << 50))
    with raises_user_error("out-of-memory", contains="train.micro_batch"):
        sft.main.__wrapped__(settings, Run("run", tmp_path))


def test_no_training_item_shows_a_held_out_scene(micro_store, monkeypatch) -> None:
    held_out = held_out_scenes(micro_store)
    others = set(micro_store.scene_ids("train")) - held_out
    items = micro_store.training_items()
    item = next(i for i in items if uses_only(i, others))
    candidates = list(item.candidates)
    distractor = replace(candidates[item.answer - 1], scene_id=next(iter(held_out)))
    candidates[item.answer - 1] = distractor
    crossed = replace(item, item_id="crossed", candidates=tuple(candidates))
    counts = []
    for more in ([], [crossed], [replace(item, item_id="copy")]):
        monkeypatch.setattr(Store, "training_items", lambda _, more=more: [*items, *more])
        counts.append(len(split_items(micro_store, 4, seed=0)[0]))
    assert counts == [counts[0], counts[0], counts[0] + 1]


class Names:
    """A store of scene names only."""

    def __init__(self, names: list[str]) -> None:
        self.names = names

    def scene_ids(self, split: str) -> list[str]:
        return self.names


def test_whether_a_scene_is_held_out_depends_on_its_name_only() -> None:
    names = [f"s0-{k:06d}" for k in range(2000)]
    held_out = held_out_scenes(Names(names))
    assert len(held_out) == pytest.approx(HELD_OUT_SHARE * len(names), rel=0.15)
    assert held_out_scenes(Names(names[:500])) == held_out & set(names[:500])
    assert len(held_out_scenes(Names(names[:1]))) == 1
    # A transfer suite has no training scenes.
    assert held_out_scenes(Names([])) == set()


@pytest.mark.parametrize(
    ("visible", "rank", "expected"),
    [("2,3", None, "2"), ("1", None, "1"), ("", None, ""), ("2,3", "0", "2,3")],
)
def test_a_run_without_ranks_uses_one_gpu(monkeypatch, visible, rank, expected) -> None:
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
    monkeypatch.delenv("LOCAL_RANK", raising=False)
    if rank is not None:
        monkeypatch.setenv("LOCAL_RANK", rank)
    gpus.restrict_to_one_gpu()
    assert os.environ["CUDA_VISIBLE_DEVICES"] == expected


@pytest.mark.parametrize("save", [torch.save, save_file])
def test_weights_that_cannot_be_written_end_the_command(tmp_path, capsys, save):
    """The libraries raise errors that are not OSErrors."""
    limits = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (100_000, limits[1]))
    try:
        with pytest.raises(SystemExit) as ended, report_failures(str(tmp_path)):
            save({"weight": torch.zeros(60_000)}, tmp_path / "weights")
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, limits)
    assert ended.value.code == 1
    assert "[file-error]" in capsys.readouterr().err
