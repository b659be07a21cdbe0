"""Processes that prepare batches: what they make ahead, and how their errors end."""

from __future__ import annotations

from dataclasses import replace

import pytest
from torch.utils.data import DataLoader

from conf.entry import Run
from conf.errors import UserError
from conf.schema import SftCommand, SftTrainConfig
from models.student.collator import Collator
from models.student.prompts import selection_sample
from tests.user_errors import raises_user_error
from train import sft
from train.common import arguments, training_loop


@pytest.mark.parametrize("workers", [1, 2, 3, 5])
@pytest.mark.parametrize("batches", [1, 2, 16])
def test_the_next_step_is_made_ahead(workers, batches) -> None:
    ahead = arguments.prefetch_factor(workers, batches)
    assert ahead * workers >= batches
    assert ahead == 2 or (ahead - 1) * workers < batches


def test_no_worker_makes_nothing_ahead() -> None:
    assert arguments.prefetch_factor(0, 16) is None


def test_a_workers_error_is_the_one_sentence(micro_store, frames, student_cfg, processor) -> None:
    item = micro_store.selection("train")[0]
    samples = [selection_sample(item, "answer", "cot", frames, student_cfg.frames, "Answer: A")]
    collator = Collator(processor, 10)
    with pytest.raises(UserError) as alone:
        collator(samples)
    with pytest.raises(UserError) as found:
        next(iter(DataLoader(samples, collate_fn=collator, num_workers=1)))
    # What the library makes of it, should it change, needs another look.
    assert "Traceback" in str(found.value)
    assert (
        training_loop.user_message(found.value)
        == training_loop.user_message(alone.value)
        == str(alone.value)
    )


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1])
def test_a_sample_that_is_too_long_ends_a_run_in_a_sentence(
    micro, micro_store, nf4_cfg, tmp_path, monkeypatch, workers
) -> None:
    """The audit finds the longest by an estimate, and may pass by one that is longer."""
    monkeypatch.setattr("train.student.run.audit", lambda *_: "")
    settings = SftCommand(
        benchmark=micro,
        store=str(micro_store.folder.parent),
        workers=1,
        student=replace(nf4_cfg, max_length=150),
        train=SftTrainConfig(
            max_steps=1, micro_batch=1, gradient_checkpointing=False, regime="answer_only",
            precision="fp32", validation_items=2, workers=workers,
        ),
    )  # fmt: skip
    # A worker process loses the code.
    code = "user-error" if workers else "sample-too-long"
    with raises_user_error(code, contains="student.max_length=150"):
        sft.main.__wrapped__(settings, Run("run", tmp_path))
