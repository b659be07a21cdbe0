"""Several ranks train what one rank trains: the same steps, losses and weights."""

from __future__ import annotations

import json
import os
import pickle
import shutil
import subprocess
import sys
from dataclasses import replace
from functools import partial
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest
import torch
from accelerate.data_loader import BatchSamplerShard
from safetensors.torch import load_file
from torch.utils.data import BatchSampler

from dynapix.conf.entry import Run
from dynapix.conf.schema import ContrastiveCommand, LateConfig, LoraConfig, SftCommand
from dynapix.models import distributed
from dynapix.models.student.collator import IGNORED, Collator
from dynapix.models.student.prompts import selection_sample
from dynapix.train import contrastive, sft
from dynapix.train.common import journal
from dynapix.train.common.journal import read_journal
from dynapix.train.common.training_loop import find_damage
from dynapix.train.student import dataset
from dynapix.train.student.samples import LazySample, LengthSampler, StudentDataset
from dynapix.train.student.trainer import token_losses, token_mean
from tests.children import run_child
from tests.train.common import launched
from tests.user_errors import raises_user_error

ROOT = Path(__file__).parents[3]
SHARDED = ("--use_fsdp", "--fsdp_version=2", "--fsdp_auto_wrap_policy=TRANSFORMER_BASED_WRAP")


@pytest.fixture
def settings(few_steps) -> SftCommand:
    return few_steps(batch=4, validation_items=3, generated_items=4, permute_candidates=True)


@pytest.fixture
def five_samples(monkeypatch) -> None:
    """The training samples of the launched ranks."""
    monkeypatch.setattr(dataset, "supervised_items", launched.five_samples)


def train_alone(settings: SftCommand, folder: Path, checkpoint: Path | None = None) -> Path:
    """Train with one rank, from the start or from a checkpoint, and return the run's folder."""
    folder.mkdir(parents=True)
    if checkpoint is not None:
        shutil.copytree(checkpoint, folder / checkpoint.name)
    sft.main.__wrapped__(settings, Run(folder.name, folder))
    return folder


def plan(
    settings: SftCommand | ContrastiveCommand,
    folder: Path,
    fsdp: bool = False,
    checkpoint: Path | None = None,
    failing_rank: int | None = None,
) -> dict[str, Any]:
    """Describe a run for launched.py."""
    return locals()


def launch(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Start two ranks with accelerate. They use CPUs, even if there are GPUs."""
    accelerate = Path(sys.executable).with_name("accelerate")
    environment = {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    return run_child(
        [accelerate, "launch", "--num_processes=2", "--main_process_port=0", *arguments],
        cwd=ROOT,
        env={**os.environ, **environment},
    )


def check_same(one: Path, two: Path, step: int = -1) -> None:
    """Compare the journals of two runs after a step, and their weights."""
    check_same_journals(one, two, step)
    check_same_weights(one, two)


def check_same_journals(one: Path, two: Path, step: int = -1) -> None:
    """Compare all values but the epoch, a fraction that counts the micro-batches of one rank."""
    journals = [
        [{k: v for k, v in r.items() if k != "epoch"} for r in read_journal(f) if r["step"] > step]
        for f in (one, two)
    ]
    for first, second in zip(*journals, strict=True):
        # The ranks sum gradients in another order; on some processors, norms differ by 1.1e-5.
        assert first == pytest.approx(second, rel=1e-4)


def check_same_weights(
    one: Path, two: Path, name: str = "student/adapter_model.safetensors"
) -> None:
    weights = [load_file(f / name) for f in (one, two)]
    assert weights[0].keys() == weights[1].keys()
    # Where a gradient is near 0, Adam scales its rounding up: to 1% of a step of the learning rate.
    for name, weight in weights[0].items():
        # Ranks sum gradients in another order, which changes the rounding in fp32.
        torch.testing.assert_close(weight, weights[1][name], atol=2e-5, rtol=1e-5)


def error_lines(ended: subprocess.CompletedProcess[str]) -> list[str]:
    """Return the lines with errors; require that no rank printed a traceback."""
    assert "[rank0]: Traceback" not in ended.stderr
    assert "[rank1]: Traceback" not in ended.stderr
    return [line for line in ended.stderr.splitlines() if line.startswith("error: ")]


@pytest.mark.slow
def test_two_ranks_train_what_one_trains(
    settings, contrastive_settings, saved_base, five_samples, tmp_path
) -> None:
    """Two ranks train the same weights as one rank with the same batch. This also holds with FSDP,
    for resumed runs, and for runs that one rank starts and two ranks resume, or the reverse. An
    error on one rank ends both ranks with one message.
    """
    runs = tmp_path / "sft"
    one = train_alone(settings, runs / "one")
    # Unlike 4-bit weights, those of an unquantised base are sharded too.
    unquantised = replace(settings.student, quantization="none")
    plain = replace(settings, student=unquantised)
    train_alone(plain, runs / "plain")
    train = contrastive_settings.train
    many = replace(contrastive_settings.retriever, late=LateConfig(width=24))
    late = replace(contrastive_settings, retriever=many, train=replace(train, scale=1.0))
    base = {"architecture": None, "model": saved_base, "lora": LoraConfig(rank=4)}
    adapted = replace(contrastive_settings.retriever, **base)
    train = replace(train, reuse_features=True)
    reused = replace(contrastive_settings, retriever=adapted, train=train)
    retrievers = {"plain": contrastive_settings, "adapters": reused, "late": late}
    for name, retriever_settings in retrievers.items():
        (folder := tmp_path / "contrastive" / name).mkdir(parents=True)
        contrastive.main.__wrapped__(retriever_settings, Run(name, folder))
    sharded = runs / "sharded"
    planned = [
        plan(settings, runs / "two"),
        plan(settings, runs / "resumed", checkpoint=one / "checkpoint-2"),
        plan(settings, sharded, fsdp=True),
        plan(settings, runs / "sharded-resumed", fsdp=True, checkpoint=sharded / "checkpoint-2"),
        plan(settings, runs / "sharded-ended", fsdp=True, checkpoint=sharded / "checkpoint-4"),
        *(plan(cfg, tmp_path / "contrastive" / f"{name}-two") for name, cfg in retrievers.items()),
        plan(plain, runs / "plain-sharded", fsdp=True),
        plan(settings, runs / "failing", failing_rank=1),
    ]
    file = tmp_path / "runs.pkl"
    file.write_bytes(pickle.dumps(planned))
    ended = launch(*SHARDED, launched.__file__, file)
    assert error_lines(ended) == ["error: a failure of this rank  [test-failure]"], ended.stderr
    assert ended.returncode == 1
    check_same(one, runs / "two")
    check_same(one, sharded)
    check_same(runs / "plain", runs / "plain-sharded")
    for name in retrievers:
        whole, two = tmp_path / "contrastive" / name, tmp_path / "contrastive" / f"{name}-two"
        check_same_journals(whole, two)
        weights = "adapter_model" if name == "adapters" else "model"
        check_same_weights(whole, two, f"retriever/{weights}.safetensors")
    check_same_weights(whole, two, "retriever/1_Dense/model.safetensors")
    for name in ("resumed", "sharded-resumed"):
        check_same(one, runs / name, step=2)
    check_same_weights(one, runs / "sharded-ended")
    fewer = train_alone(settings, runs / "fewer", checkpoint=runs / "two" / "checkpoint-2")
    check_same(one, fewer, step=2)
    with raises_user_error("other-launch", contains="checkpoint-2"):
        train_alone(settings, runs / "mixed", checkpoint=sharded / "checkpoint-2")
    last = sharded / "checkpoint-4"
    for part, folder in (("file of weights", "pytorch_model_fsdp_0"), ("optimizer", "optimizer_0")):
        metadata = last / folder / ".metadata"
        moved = metadata.rename(runs / "moved")
        assert find_damage(last) == f"its {part} is missing"
        moved.rename(metadata)
    assert find_damage(last) is None
    record = json.loads((runs / "two" / "run.json").read_text())
    assert (record["ranks"], record["earlier_starts"]) == (2, [])
    # Only the main rank logs.
    starts = [p for p in planned if isinstance(p["settings"], SftCommand)]
    assert ended.stderr.count("loading student ") == len(starts)
    assert json.loads((runs / "two" / "metrics.json").read_text()) == pytest.approx(
        journal.run_metrics(one), rel=1e-5
    )


@pytest.mark.slow
def test_an_error_on_all_ranks_is_printed_once(tmp_path) -> None:
    command = ["+exp=cot", "train.batch=6", "train.micro_batch=2", f"checkpoints={tmp_path}"]
    ended = launch("--multi_gpu", "-m", "train.sft", *command)
    assert ended.returncode == 1
    (line,) = error_lines(ended)
    assert "train.batch=6" in line
    assert line.endswith("[uneven-batch]")


@pytest.mark.slow
def test_fsdp_without_effect_is_refused(settings, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("ACCELERATE_USE_FSDP", "true")
    with raises_user_error("unsupported-with-fsdp", contains="--use_fsdp"):
        train_alone(settings, tmp_path / "run")


@pytest.mark.parametrize("count", [1, 2, 5, 8, 11, 64])
@pytest.mark.parametrize(("micro_batch", "number"), [(1, 2), (2, 2), (4, 2), (2, 4), (1, 8)])
def test_ranks_divide_each_step_of_a_single_rank(count, micro_batch, number) -> None:
    """accelerate deals the micro-batches to the ranks in turn."""
    lengths = np.random.default_rng(0).integers(1, 1000, count).tolist()
    items = [f"item-{k // 2}" for k in range(count)]
    alone = list(LengthSampler(lengths, items, 8, 0))
    order = LengthSampler(lengths, items, 8, 0, micro_batch, number)
    batches = BatchSampler(order, micro_batch, drop_last=False)
    shares = [list(BatchSamplerShard(batches, number, rank)) for rank in range(number)]
    assert len(order) == len(list(order)) == sum(len(b) for part in shares for b in part)
    each = 8 // (micro_batch * number)
    for step in range(0, count, 8):
        first = step // 8 * each
        samples = [i for part in shares for b in part[first : first + each] for i in b]
        supervised = sorted(i for i in samples if i >= 0)
        assert supervised == sorted(alone[step : step + 8])
        # The samples that fill up a step repeat its last sample.
        assert {~i for i in samples if i < 0} <= {alone[step : step + 8][-1]}
    assert len({len(part) for part in shares}) == 1


@pytest.mark.parametrize(("micro_batch", "number"), [(2, 2), (4, 2), (8, 2), (2, 4)])
def test_the_two_samples_of_an_item_are_in_one_micro_batch(micro_batch, number) -> None:
    """Some items have one sample, since their rationale was rejected."""
    items = [f"item-{k}" for k in range(500)] + [f"item-{k}" for k in range(500 - 13)]
    lengths = np.random.default_rng(0).integers(1, 1000, len(items)).tolist()
    order = LengthSampler(lengths, items, 16, 0, micro_batch, number, pairs=True)
    batches = BatchSampler(order, micro_batch, drop_last=False)
    shares = [BatchSamplerShard(batches, number, rank) for rank in range(number)]
    seen: dict[str, set[tuple[int, int]]] = {}
    for rank, share in enumerate(shares):
        for place, batch in enumerate(share):
            for sample in batch:
                if sample >= 0:
                    seen.setdefault(items[sample], set()).add((rank, place))
    assert len(seen) == 500
    assert all(len(places) == 1 for places in seen.values())


def test_ranks_get_samples_of_equal_length() -> None:
    """The longer of two consecutive samples goes to each rank in turn."""
    lengths = np.random.default_rng(0).integers(1, 1000, 64)
    sampler = LengthSampler(lengths.tolist(), [str(k) for k in range(64)], 64, 0, 1, 2)
    order = np.array(list(sampler)).reshape(-1, 2)
    loads = lengths[order].sum(axis=0)
    assert abs(loads[0] - loads[1]) <= lengths.max() - lengths.min()
    assert (lengths[order[::2, 0]] >= lengths[order[::2, 1]]).all()
    assert (lengths[order[1::2, 0]] <= lengths[order[1::2, 1]]).all()


def test_a_filler_changes_no_loss(micro_store, frames, student_cfg, processor, model) -> None:
    items = micro_store.selection("train")[:2]
    samples = StudentDataset(
        [
            LazySample("", 0, item.item_id, partial(render, item, frames, student_cfg, text))
            for item, text in zip(items, ("Answer: A", "near the top\nAnswer: B"), strict=True)
        ]
    )
    collate = Collator(processor, 1500)
    plain = collate([samples[0], samples[1]])
    filled = collate([samples[0], samples[1], samples[~0]])
    count = int((plain["labels"] != IGNORED).sum())
    assert int((filled["labels"] != IGNORED).sum()) == count
    losses = []
    for batch in (plain, filled, collate([samples[~1]])):
        labels = batch.pop("labels")
        logits = model(**batch, use_cache=False).logits
        losses.append(token_mean(SimpleNamespace(logits=logits), labels, count))
        each = token_losses(logits, labels)
        torch.testing.assert_close(each[:, 0].sum() / count, losses[-1])
    torch.testing.assert_close(losses[0], losses[1])
    assert losses[2] == 0
    losses[2].backward()
    assert all((p.grad == 0).all() for p in model.parameters() if p.grad is not None)


def render(item, frames, cfg, text, epoch):
    return selection_sample(item, "answer", "cot", frames, cfg.frames, text)


def test_a_step_is_split_over_micro_batches_and_ranks(monkeypatch) -> None:
    assert distributed.split_batch(16, 2) == 8
    monkeypatch.setenv("LOCAL_RANK", "1")
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert distributed.split_batch(16, 2) == 2
    with raises_user_error("uneven-batch", contains=("train.batch=16", "a multiple of 32")):
        distributed.split_batch(16, 8)
    with raises_user_error("uneven-batch", contains="set train.batch to a multiple of 8"):
        distributed.split_batch(14, 2)
