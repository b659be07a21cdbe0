"""A run that was killed and goes on ends where an undisturbed one ends, in both trainers."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from sentence_transformers import SentenceTransformerTrainer
from transformers.trainer_callback import TrainerControl, TrainerState

from conf.entry import Run
from conf.errors import UserError
from conf.schema import LateConfig, LoraConfig, SftCommand
from tests.user_errors import raises_user_error
from train import contrastive, sft
from train.common.callbacks import EpochCallback
from train.common.checkpoints import newest_checkpoint
from train.common.journal import read_journal
from train.student import dataset
from train.student.lazy_samples import LazySample, StudentDataset
from train.student.length_sampler import LengthSampler

DRAWING = LoraConfig(rank=4, dropout=0.1)
"""Adapters that draw numbers in each pass, as a run that goes on must too."""


@pytest.fixture
def sft_settings(few_steps) -> SftCommand:
    settings = few_steps(batch=4, validation_items=4, generated_items=8, permute_candidates=True)
    return replace(settings, student=replace(settings.student, lora=DRAWING))


def train_twice(main, settings, folder: Path, step: int = 2) -> tuple[Path, Path]:
    """An undisturbed run, and one that goes on from the first's checkpoint of a step."""
    whole, killed = folder / "whole", folder / "killed"
    whole.mkdir()
    main.__wrapped__(settings, Run("whole", whole))
    killed.mkdir()
    kept = killed / f"checkpoint-{step}"
    for folder in whole.glob("checkpoint-*"):
        if int(folder.name.removeprefix("checkpoint-")) <= step:
            shutil.copytree(folder, killed / folder.name)
    # What a kill leaves: a checkpoint without its state, and a journal past the whole one.
    torn = killed / f"checkpoint-{step + 1}"
    torn.mkdir()
    (torn / "trainer_state.json").write_text("{")
    shutil.copy(whole / "metrics.jsonl", killed / "metrics.jsonl")
    assert newest_checkpoint(killed) == kept
    main.__wrapped__(settings, Run("killed", killed))
    return whole, killed


def same_weights(one: Path, two: Path) -> None:
    first, second = load_file(one), load_file(two)
    assert first.keys() == second.keys()
    for name, weight in first.items():
        torch.testing.assert_close(weight, second[name], atol=1e-6, rtol=1e-5)


def same_journals(one: Path, two: Path) -> None:
    for first, second in zip(read_journal(one), read_journal(two), strict=True):
        assert first == pytest.approx(second, rel=1e-4)


@pytest.mark.slow
def test_a_student_goes_on_as_if_undisturbed(sft_settings, tmp_path) -> None:
    whole, killed = train_twice(sft.main, sft_settings, tmp_path)
    same_weights(*(f / "student" / "adapter_model.safetensors" for f in (whole, killed)))
    same_journals(whole, killed)
    assert (whole / "curves.png").stat().st_size > 1000


@pytest.mark.slow
def test_a_run_does_not_go_on_with_other_data(sft_settings, tmp_path, monkeypatch) -> None:
    whole, killed = tmp_path / "whole", Run("killed", tmp_path / "killed")
    whole.mkdir()
    sft.main.__wrapped__(sft_settings, Run("whole", whole))
    ignored = shutil.ignore_patterns("metrics.json", "student")
    shutil.copytree(whole, killed.folder, ignore=ignored)
    build = dataset.supervised_items

    def one_less(*arguments):
        return {mode: items[:-1] for mode, items in build(*arguments).items()}

    monkeypatch.setattr(dataset, "supervised_items", one_less)
    with raises_user_error("other-data"):
        sft.main.__wrapped__(sft_settings, killed)
    assert not (killed.folder / "student").exists()


@pytest.mark.slow
@pytest.mark.parametrize(("steps", "step"), [(4, 2), (6, 3)], ids=["at a border", "within"])
@pytest.mark.parametrize("workers", [0, 1])
def test_a_student_goes_on_within_a_later_epoch(
    sft_settings, tmp_path, monkeypatch, steps, step, workers
) -> None:
    """Six samples are two steps an epoch, in each of which candidates stand otherwise."""
    make = dataset.supervised_items
    few = {"reasoning": 3, "answer": 3}

    def fewer(*arguments):
        return {mode: made[: few[mode]] for mode, made in make(*arguments).items()}

    shown: dict[str, set[str]] = {}
    ask = dataset.selection_sample

    def noted(item, mode, regime, frames, frame_count, response):
        shown.setdefault(f"{item.item_id} {mode}", set()).add(item.letter)
        return ask(item, mode, regime, frames, frame_count, response)

    monkeypatch.setattr(dataset, "supervised_items", fewer)
    monkeypatch.setattr(dataset, "selection_sample", noted)
    train = replace(sft_settings.train, max_steps=steps, workers=workers)
    whole, killed = train_twice(sft.main, replace(sft_settings, train=train), tmp_path, step)
    same_weights(*(f / "student" / "adapter_model.safetensors" for f in (whole, killed)))
    same_journals(whole, killed)
    # Another process makes the samples where there are workers.
    assert workers or max(map(len, shown.values())) > 1


def test_each_epoch_reaches_the_samples_and_their_order() -> None:
    """As the trainer tells it: at an epoch's start, and within one that is gone on with."""
    shown: list[int] = []
    training = StudentDataset([LazySample("", 0, shown.append)])
    order = LengthSampler(range(100), 4, seed=0)
    orders = []
    for told, epoch in ((None, 0), (1.0, 1), (1.4, 1), (2.0, 2)):
        EpochCallback(training, order).on_epoch_begin(
            None, TrainerState(epoch=told), TrainerControl()
        )
        training[0]
        assert shown[-1] == epoch
        orders.append(list(order))
    assert orders[1] == orders[2]
    assert orders[0] != orders[1] != orders[3]


@pytest.mark.slow
def test_a_token_weighs_the_same_however_a_batch_is_split(few_steps, tmp_path) -> None:
    """The first step's loss and gradient of four unequal samples, at once and one by one."""
    first = []
    for micro_batch in (4, 1):
        settings = few_steps(batch=4, max_steps=1, validation_items=1, micro_batch=micro_batch)
        run = Run(f"by {micro_batch}", tmp_path / str(micro_batch))
        run.folder.mkdir()
        sft.main.__wrapped__(settings, run)
        first.append(next(r for r in read_journal(run.folder) if "grad_norm" in r))
    assert first[0]["loss"] == pytest.approx(first[1]["loss"], rel=1e-4)
    assert first[0]["grad_norm"] == pytest.approx(first[1]["grad_norm"], rel=1e-3)


@pytest.mark.slow
def test_a_run_killed_after_its_last_step_takes_no_other(sft_settings, tmp_path) -> None:
    """Its student was not yet written; the schedule would move the weights by another step."""
    train = replace(sft_settings.train, schedule="constant", warmup=0.0, max_steps=2)
    settings = replace(sft_settings, train=train)
    run = Run("run", tmp_path)
    sft.main.__wrapped__(settings, run)
    weights, journal = tmp_path / "student" / "adapter_model.safetensors", read_journal(tmp_path)
    kept = load_file(weights)
    shutil.rmtree(tmp_path / "student")
    sft.main.__wrapped__(settings, run)
    assert read_journal(tmp_path) == journal
    again = load_file(weights)
    assert all(torch.equal(again[name], weight) for name, weight in kept.items())
    assert newest_checkpoint(tmp_path).name == "checkpoint-2"


def test_a_batch_beyond_the_queries_is_refused(contrastive_settings, tmp_path) -> None:
    train = replace(contrastive_settings.train, batch=5000)
    settings = replace(contrastive_settings, train=train)
    with pytest.raises(UserError, match=r"train\.batch=5000 is more than the \d+ training queries"):
        contrastive.main.__wrapped__(settings, Run("run", tmp_path))


def test_other_folders_are_no_checkpoints(tmp_path, caplog) -> None:
    for name in ("checkpoint-best", "checkpoint-10-old", "checkpoint-"):
        (tmp_path / name).mkdir()
    assert newest_checkpoint(tmp_path) is None
    assert not caplog.records
    (tmp_path / "metrics.jsonl").write_bytes(b'3\n{"step": 1, "loss": 2}\n\xff\n{"step": 2, "lo')
    assert read_journal(tmp_path) == [{"step": 1, "loss": 2}]


@pytest.mark.slow
@pytest.mark.parametrize("late", [None, LateConfig(width=24)], ids=["one vector", "many"])
def test_a_retriever_goes_on_as_if_undisturbed(contrastive_settings, tmp_path, late) -> None:
    """Within its second epoch."""
    changes = {"max_steps": 8, "evaluations": 4, "keep_checkpoints": 4}
    train = replace(contrastive_settings.train, best_metric="mrr", **changes)
    cfg = replace(contrastive_settings.retriever, late=late)
    settings = replace(contrastive_settings, retriever=cfg, train=train)
    whole, killed = train_twice(contrastive.main, settings, tmp_path, step=6)
    journal = read_journal(whole)
    assert 1 < next(r["epoch"] for r in journal if r["step"] == 6) < 2
    measured = {r["step"]: r["eval_mrr"] for r in journal if "eval_mrr" in r}
    best = max((2, 4, 6, 8), key=measured.get)
    kept = load_file(whole / f"checkpoint-{best}" / "model.safetensors")
    weights = load_file(whole / "retriever" / "model.safetensors")
    assert all(torch.equal(kept[name], weight) for name, weight in weights.items())
    for name in ("model.safetensors", *(["1_Dense/model.safetensors"] if late else [])):
        same_weights(*(f / "retriever" / name for f in (whole, killed)))
    same_journals(whole, killed)


@pytest.mark.slow
@pytest.mark.parametrize("late", [None, LateConfig(width=24)], ids=["one vector", "many"])
def test_a_retriever_of_adapters_goes_on_as_if_undisturbed(
    contrastive_settings, saved_base, tmp_path, late
) -> None:
    train = replace(contrastive_settings.train, best_metric="mrr")
    over = {"architecture": None, "model": saved_base, "quantization": "nf4", "lora": DRAWING}
    cfg = replace(contrastive_settings.retriever, late=late, **over)
    settings = replace(contrastive_settings, retriever=cfg, train=train)
    whole, killed = train_twice(contrastive.main, settings, tmp_path)
    measured = {r["step"]: r["eval_mrr"] for r in read_journal(whole) if "eval_mrr" in r}
    best = whole / f"checkpoint-{max((2, 4), key=measured.get)}"
    for name in ("adapter_model.safetensors", *(["1_Dense/model.safetensors"] if late else [])):
        same_weights(best / name, whole / "retriever" / name)
        same_weights(*(f / "retriever" / name for f in (whole, killed)))
    same_journals(whole, killed)


@pytest.mark.slow
def test_a_best_checkpoint_that_was_lost_is_told(contrastive_settings, tmp_path) -> None:
    train = replace(contrastive_settings.train, best_metric="mrr")
    settings = replace(contrastive_settings, train=train)
    whole, killed = tmp_path / "whole", tmp_path / "killed"
    whole.mkdir()
    contrastive.main.__wrapped__(settings, Run("whole", whole))
    kept = shutil.copytree(whole / "checkpoint-4", killed / "checkpoint-4")
    state = json.loads((kept / "trainer_state.json").read_text())
    state["best_global_step"] = 2
    (kept / "trainer_state.json").write_text(json.dumps(state))
    with raises_user_error("damaged-file", contains="checkpoint-2"):
        contrastive.main.__wrapped__(settings, Run("killed", killed))


@pytest.mark.slow
def test_a_best_checkpoint_that_cannot_be_read_is_no_silent_last_one(
    contrastive_settings, tmp_path, monkeypatch
) -> None:
    def torn(*_: object) -> None:
        raise RuntimeError("torn")

    monkeypatch.setattr(SentenceTransformerTrainer, "_load_from_checkpoint", torn)
    train = replace(contrastive_settings.train, best_metric="mrr")
    with pytest.raises(RuntimeError, match="torn"):
        contrastive.main.__wrapped__(
            replace(contrastive_settings, train=train), Run("run", tmp_path)
        )
    assert not (tmp_path / "retriever").exists()
