"""In both trainers, a run that was killed and resumed ends like an uninterrupted run."""

from __future__ import annotations

import errno
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from dynapix.conf.entry import Run
from dynapix.conf.schema import LateConfig, LoraConfig, SftCommand
from dynapix.train import contrastive, sft
from dynapix.train.common import training_loop
from dynapix.train.common.journal import read_journal
from dynapix.train.common.training_loop import newest_checkpoint
from dynapix.train.student import dataset
from tests.user_errors import raises_user_error

DROPOUT = LoraConfig(rank=4, dropout=0.1)
"""Adapters with dropout; a resumed run must draw the same random numbers."""


@pytest.fixture
def sft_settings(few_steps) -> SftCommand:
    settings = few_steps(batch=4, validation_items=4, generated_items=2, permute_candidates=True)
    return replace(settings, student=replace(settings.student, lora=DROPOUT))


def train(main, settings, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    main.__wrapped__(settings, Run(folder.name, folder))
    return folder


def train_twice(main, settings, folder: Path, step: int) -> tuple[Path, Path]:
    """Return the folders of an uninterrupted run, and of a run that resumes from its checkpoint."""
    whole, resumed = train(main, settings, folder / "whole"), folder / "resumed"
    for checkpoint in whole.glob("checkpoint-*"):
        if int(checkpoint.name.removeprefix("checkpoint-")) <= step:
            shutil.copytree(checkpoint, resumed / checkpoint.name)
    # What a kill leaves: a checkpoint with a damaged state, and later lines in the journal.
    (resumed / f"checkpoint-{step + 1}").mkdir()
    (resumed / f"checkpoint-{step + 1}" / "trainer_state.json").write_text("{")
    shutil.copy(whole / "metrics.jsonl", resumed / "metrics.jsonl")
    assert newest_checkpoint(resumed) == resumed / f"checkpoint-{step}"
    train(main, settings, resumed)
    for first, second in zip(read_journal(whole), read_journal(resumed), strict=True):
        assert first == pytest.approx(second, rel=1e-4)
    return whole, resumed


def check_same_weights(one: Path, two: Path) -> None:
    first, second = load_file(one), load_file(two)
    assert first.keys() == second.keys()
    for name, weight in first.items():
        torch.testing.assert_close(weight, second[name], atol=1e-6, rtol=1e-5)


@pytest.mark.slow
def test_other_data_is_refused(sft_settings, tmp_path, monkeypatch) -> None:
    whole, resumed = train(sft.main, sft_settings, tmp_path / "whole"), tmp_path / "resumed"
    shutil.copytree(whole, resumed, ignore=shutil.ignore_patterns("metrics.json", "student"))
    build = dataset.supervised_items

    def one_less(*arguments):
        return {mode: items[:-1] for mode, items in build(*arguments).items()}

    monkeypatch.setattr(dataset, "supervised_items", one_less)
    with raises_user_error("other-data"):
        train(sft.main, sft_settings, resumed)
    assert not (resumed / "student").exists()


@pytest.mark.slow
@pytest.mark.parametrize(
    ("steps", "step", "workers"), [(4, 2, 0), (6, 3, 1)], ids=["between epochs", "within one"]
)
def test_a_student_resumes_after_its_first_epoch(
    sft_settings, tmp_path, monkeypatch, steps, step, workers
) -> None:
    """An epoch of six samples has two steps, and permutes the candidates."""
    build, render = dataset.supervised_items, dataset.selection_sample
    letters: dict[str, set[str]] = {}

    def six_samples(*arguments):
        return {mode: items[:3] for mode, items in build(*arguments).items()}

    def recorded(item, mode, *arguments):
        letters.setdefault(f"{item.item_id} {mode}", set()).add(item.letter)
        return render(item, mode, *arguments)

    monkeypatch.setattr(dataset, "supervised_items", six_samples)
    monkeypatch.setattr(dataset, "selection_sample", recorded)
    settings = replace(sft_settings.train, max_steps=steps, workers=workers)
    runs = train_twice(sft.main, replace(sft_settings, train=settings), tmp_path, step)
    check_same_weights(*(f / "student" / "adapter_model.safetensors" for f in runs))
    assert (runs[0] / "curves.png").stat().st_size > 1000
    # Workers are other processes, whose samples this one does not see.
    assert workers or max(map(len, letters.values())) > 1


@pytest.mark.slow
def test_a_student_resumes_with_other_settings_of_memory(few_steps, tmp_path) -> None:
    """It resumes within its first epoch, with smaller micro-batches and recomputed activations. A
    run with one evaluation has a checkpoint in its middle, too."""
    settings = few_steps(batch=4, micro_batch=4, evaluations=1)
    less = {"micro_batch": 1, "gradient_checkpointing": True}
    check_resumed_run(sft.main, settings, less, tmp_path)
    journal = read_journal(tmp_path / "whole")
    assert [r["step"] for r in journal if "eval_answer_loss" in r] == [0, 4]


@pytest.mark.slow
def test_a_retriever_resumes_with_other_settings_of_memory(
    contrastive_settings, saved_base, tmp_path
) -> None:
    base = {"architecture": None, "model": saved_base, "lora": LoraConfig(rank=4)}
    cfg = replace(contrastive_settings.retriever, **base)
    train_settings = replace(contrastive_settings.train, mini_batch=4, reuse_features=True)
    settings = replace(contrastive_settings, retriever=cfg, train=train_settings)
    less = {"mini_batch": 2, "reuse_features": False, "gradient_checkpointing": True}
    check_resumed_run(contrastive.main, settings, less, tmp_path)


def check_resumed_run(main, settings, less: dict, tmp_path: Path) -> None:
    """Compare an uninterrupted run with one that resumes at its middle with other settings."""
    whole, resumed = train(main, settings, tmp_path / "whole"), tmp_path / "resumed"
    first = min(whole.glob("checkpoint-*"), key=lambda path: int(path.name[11:]))
    shutil.copytree(first, resumed / first.name)
    train(main, replace(settings, train=replace(settings.train, **less)), resumed)
    (path,) = {p.relative_to(whole) for p in whole.glob("*/adapter_model.safetensors")} - {
        p.relative_to(whole) for p in whole.glob("checkpoint-*/*")
    }
    one, two = load_file(whole / path), load_file(resumed / path)
    for name, weight in one.items():
        torch.testing.assert_close(weight, two[name], atol=1e-4, rtol=1e-3)


@pytest.mark.slow
@pytest.mark.parametrize("weighting", ["token", "sample"])
def test_micro_batches_change_neither_loss_nor_gradient(weighting, few_steps, tmp_path) -> None:
    """In the first step, with four samples of unequal length in one micro-batch or in four."""
    first = []
    for micro_batch in (4, 1):
        sizes = {"batch": 4, "max_steps": 1, "validation_items": 1, "micro_batch": micro_batch}
        settings = few_steps(**sizes, weighting=weighting)
        folder = train(sft.main, settings, tmp_path / str(micro_batch))
        first.append(next(r for r in read_journal(folder) if "grad_norm" in r))
    assert first[0]["loss"] == pytest.approx(first[1]["loss"], rel=1e-4)
    assert first[0]["grad_norm"] == pytest.approx(first[1]["grad_norm"], rel=1e-3)


def test_only_numbered_folders_are_checkpoints(tmp_path, caplog) -> None:
    for name in ("checkpoint-best", "checkpoint-10-old", "checkpoint-"):
        (tmp_path / name).mkdir()
    assert newest_checkpoint(tmp_path) is None
    assert not caplog.records
    (tmp_path / "metrics.jsonl").write_bytes(b'3\n{"step": 1, "loss": 2}\n\xff\n{"step": 2, "lo')
    assert read_journal(tmp_path) == [{"step": 1, "loss": 2}]


def test_a_checkpoint_that_cannot_be_read_stops_the_run(tmp_path, monkeypatch) -> None:
    """It is not skipped as incomplete: the run would start again and delete its journal."""
    checkpoint = tmp_path / "checkpoint-2"
    checkpoint.mkdir()
    for name in ("model.safetensors", "optimizer.pt", "scheduler.pt", "rng_state.pth"):
        (checkpoint / name).touch()
    (checkpoint / "trainer_state.json").write_text("{}")
    assert newest_checkpoint(tmp_path) is None

    def fail(path: Path) -> None:
        raise PermissionError(errno.EACCES, "Permission denied")

    monkeypatch.setitem(training_loop.READERS, ".json", fail)
    for suffix in (".safetensors", ".pt", ".pth"):
        monkeypatch.delitem(training_loop.READERS, suffix)
    with raises_user_error("unreadable-checkpoint", contains=("trainer_state.json", "denied")):
        newest_checkpoint(tmp_path)

    monkeypatch.undo()
    monkeypatch.setattr(training_loop.os, "listdir", fail)
    with raises_user_error("unreadable-checkpoint", contains=("checkpoint-2", "denied")):
        newest_checkpoint(tmp_path)


@pytest.mark.slow
@pytest.mark.parametrize("late", [None, LateConfig(width=24)], ids=["one vector", "many"])
def test_a_retriever_resumes_within_its_second_epoch(
    contrastive_settings, saved_base, tmp_path, late
) -> None:
    changes = {"max_steps": 8, "evaluations": 4, "keep_checkpoints": 4}
    settings = replace(contrastive_settings.train, **changes)
    base = {"architecture": None, "model": saved_base, "quantization": "nf4", "lora": DROPOUT}
    # All weights are trained with one vector, adapters with many.
    cfg = replace(contrastive_settings.retriever, late=late, **(base if late else {}))
    settings = replace(contrastive_settings, retriever=cfg, train=settings)
    whole, resumed = train_twice(contrastive.main, settings, tmp_path, step=6)
    assert 1 < next(r["epoch"] for r in read_journal(whole) if r["step"] == 6) < 2
    weights = ["adapter_model", "1_Dense/model"] if late else ["model"]
    for name in weights:
        path = f"retriever/{name}.safetensors"
        check_same_weights(whole / path, resumed / path)
