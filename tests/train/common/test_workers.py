"""Worker processes: how many batches they prepare in advance, and how their errors are reported."""

from __future__ import annotations

from dataclasses import replace

import pytest
from torch.utils.data import DataLoader

from dynapix.conf.entry import Run
from dynapix.conf.errors import UserError
from dynapix.models.student.collator import Collator
from dynapix.models.student.prompts import selection_sample
from dynapix.train import sft
from dynapix.train.common.training_loop import user_message
from dynapix.train.student.trainer import prefetch_factor
from tests.user_errors import raises_user_error


@pytest.mark.parametrize("workers", [1, 2, 3, 5])
@pytest.mark.parametrize("batches", [1, 2, 16])
def test_workers_prepare_the_next_step(workers, batches) -> None:
    ahead = prefetch_factor(workers, batches)
    assert ahead * workers >= batches
    assert ahead == 2 or (ahead - 1) * workers < batches
    assert prefetch_factor(0, batches) is None


def test_the_error_of_a_worker_is_reported_without_its_traceback(
    micro_store, frames, student_cfg, processor
) -> None:
    item = micro_store.selection("train")[0]
    samples = [selection_sample(item, "answer", "cot", frames, student_cfg.frames, "Answer: A")]
    collator = Collator(processor, 10)
    with pytest.raises(UserError) as alone:
        collator(samples)
    with pytest.raises(UserError) as of_worker:
        next(iter(DataLoader(samples, collate_fn=collator, num_workers=1)))
    assert "Traceback" in str(of_worker.value)
    assert user_message(of_worker.value) == user_message(alone.value) == str(alone.value)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1])
def test_a_sample_that_is_too_long_ends_the_run(few_steps, tmp_path, monkeypatch, workers) -> None:
    """The audit may miss the longest sample, because lengths are estimated."""
    monkeypatch.setattr("dynapix.train.student.trainer.audit_student", lambda *_: "")
    settings = few_steps(regime="answer_only", workers=workers)
    settings = replace(settings, student=replace(settings.student, max_length=150))
    # The error of a worker process loses its code.
    code = "user-error" if workers else "sample-too-long"
    with raises_user_error(code, contains="student.max_length=150"):
        sft.main.__wrapped__(settings, Run("run", tmp_path))
