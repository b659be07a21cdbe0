"""What cannot be gone on with ends in a sentence that says what to do."""

from __future__ import annotations

import json
from dataclasses import replace

import pytest
import torch

from conf.entry import Run
from conf.errors import UserError
from conf.schema import SftCommand, SftTrainConfig
from train import sft


@pytest.fixture
def settings(micro, micro_store, nf4_cfg) -> SftCommand:
    train = SftTrainConfig(
        lr=1e-3, max_steps=3, micro_batch=2, accumulation=1, precision="fp32",
        gradient_checkpointing=False, evaluations=1, validation_items=2, regime="answer_only",
    )  # fmt: skip
    return SftCommand(
        benchmark=micro,
        store=str(micro_store.folder.parent),
        workers=1,
        student=nf4_cfg,
        train=train,
    )


@pytest.mark.slow
def test_a_loss_that_is_no_number_stops_with_its_samples(settings, micro_store, tmp_path) -> None:
    too_fast = replace(settings, train=replace(settings.train, lr=1e30, warmup=0.0))
    with pytest.raises(UserError, match=r"the loss is nan after step \d; .*stopped\.json names"):
        sft.main.__wrapped__(too_fast, Run("run", tmp_path))
    told = json.loads((tmp_path / "stopped.json").read_text())
    named = {f"{item.item_id} (answer)" for item in micro_store.selection("train")}
    assert len(told["samples"]) == 2
    assert set(told["samples"]) <= named


@pytest.mark.slow
def test_too_little_memory_is_told_with_the_key_to_lower(settings, tmp_path, monkeypatch) -> None:
    def greedy(*_, **__) -> torch.Tensor:
        return torch.empty(1 << 50)

    monkeypatch.setattr("train.sft_trainer.token_mean", greedy)
    with pytest.raises(UserError, match=r"out of memory after step 0: lower train\.micro_batch"):
        sft.main.__wrapped__(settings, Run("run", tmp_path))
