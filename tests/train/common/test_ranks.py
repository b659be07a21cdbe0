"""Several ranks train what one does: the same steps, numbers and weights, however they share."""

from __future__ import annotations

import importlib.util
import json
import os
import shutil
import subprocess
import sys
from dataclasses import asdict, replace
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

from conf.entry import Run
from conf.schema import ContrastiveCommand, LateConfig, LoraConfig, SftCommand
from models import distributed
from models.student.collator import IGNORED, Collator
from models.student.prompts import selection_sample
from tests.user_errors import raises_user_error
from train import contrastive, sft
from train.common import journal
from train.common.checkpoints import find_damage
from train.common.journal import read_journal
from train.student import dataset
from train.student.lazy_samples import LazySample, StudentDataset
from train.student.length_sampler import LengthSampler
from train.student.trainer import token_losses, token_mean

ROOT = Path(__file__).parents[3]
LAUNCHED = Path(__file__).with_name("launched.py")
TIMEOUT = 1200
"""Seconds after which ranks that wait for each other fail the test."""
SHARDED = ("--use_fsdp", "--fsdp_version=2", "--fsdp_auto_wrap_policy=TRANSFORMER_BASED_WRAP")


@pytest.fixture
def settings(few_steps) -> SftCommand:
    return few_steps(batch=4, validation_items=3, generated_items=8, permute_candidates=True)


@pytest.fixture
def few(monkeypatch) -> None:
    """Five training samples, as for the ranks that are launched."""
    spec = importlib.util.spec_from_file_location("launched", LAUNCHED)
    launched = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(launched)
    monkeypatch.setattr(dataset, "supervised_items", launched.fewer)


def alone(settings: SftCommand, folder: Path, after: Path | None = None) -> Path:
    """A run of one rank, from its start or a checkpoint."""
    folder.mkdir(parents=True)
    if after is not None:
        shutil.copytree(after, folder / after.name)
    sft.main.__wrapped__(settings, Run(folder.name, folder))
    return folder


UNLESS = {"fsdp": False, "after": None, "fails_on": None}
"""What launched.py does with a run, unless it is told."""


def planned(settings: SftCommand, folder: Path, **changes: Any) -> dict[str, Any]:
    """What launched.py is told of a run."""
    student, train = settings.student, settings.train
    overrides = [
        "+exp=cot", "benchmark=micro", f"store={settings.store}", f"run={folder.name}",
        f"checkpoints={folder.parents[1]}", "workers=1",
        *(f"student.{key}={getattr(student, key)}" for key in ("name", "model", "quantization")),
        *(f"student.{key}={getattr(student, key)}" for key in ("image_size", "max_length")),
        f"student.max_new_tokens={student.max_new_tokens}",
        f"student.lora.rank={student.lora.rank}",
        *(f"train.{key}={'null' if value is None else value}"
          for key, value in asdict(train).items() if key != "report_to"),
    ]  # fmt: skip
    return {"trainer": "sft", **UNLESS, "overrides": overrides, "folder": folder, **changes}


def ranking(settings: ContrastiveCommand, folder: Path) -> dict[str, Any]:
    """What launched.py is told of a retriever's run."""
    retriever = settings.retriever
    late, sizes = retriever.late, retriever.architecture
    built = (
        [f"retriever.architecture.{key}={value}" for key, value in asdict(sizes).items()]
        if sizes
        else [
            f"retriever.model={retriever.model}",
            "retriever.architecture=null",
            f"retriever.lora.rank={retriever.lora.rank}",
        ]
    )
    overrides = [
        *(["+exp=late_interaction", f"retriever.late.width={late.width}"] if late else []),
        "retriever=tiny", "benchmark=micro", f"store={settings.store}", f"run={folder.name}",
        f"checkpoints={folder.parents[1]}", "workers=1",
        *built,
        f"retriever.image_size={retriever.image_size}", f"retriever.widths={retriever.widths}",
        *(f"train.{key}={'null' if value is None else value}"
          for key, value in asdict(settings.train).items() if key != "report_to"),
    ]  # fmt: skip
    return {"trainer": "contrastive", **UNLESS, "overrides": overrides, "folder": folder}


def launch(*arguments: object) -> subprocess.CompletedProcess[str]:
    """Two ranks on CPUs, whatever GPUs there are."""
    accelerate = Path(sys.executable).with_name("accelerate")
    command = [accelerate, "launch", "--num_processes=2", "--main_process_port=0", *arguments]
    environment = {**os.environ, "PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": ""}
    return subprocess.run(
        list(map(str, command)),
        cwd=ROOT, env={**environment, "OMP_NUM_THREADS": "1"}, capture_output=True, text=True,
        timeout=TIMEOUT,
    )  # fmt: skip


def same(one: Path, two: Path, step: int = -1) -> None:
    """The journals after a step, and the weights."""
    same_journals(one, two, step)
    same_weights(one, two)


def same_journals(one: Path, two: Path, step: int = -1) -> None:
    """But for shares of an epoch, which are counted in a rank's micro-batches."""
    journals = [
        [{k: v for k, v in r.items() if k != "epoch"} for r in read_journal(f) if r["step"] > step]
        for f in (one, two)
    ]
    for first, second in zip(*journals, strict=True):
        assert first == pytest.approx(second, rel=1e-5)


def same_weights(one: Path, two: Path, name: str = "student/adapter_model.safetensors") -> None:
    weights = [load_file(f / name) for f in (one, two)]
    assert weights[0].keys() == weights[1].keys()
    for name, weight in weights[0].items():
        # Ranks sum gradients in another order: fp32 rounding, after steps at a rate of 1e-3.
        torch.testing.assert_close(weight, weights[1][name], atol=5e-6, rtol=1e-5)


def errors_of(ended: subprocess.CompletedProcess[str]) -> list[str]:
    """The errors that a user is told; what a bug looks like fails."""
    assert "[rank0]: Traceback" not in ended.stderr
    assert "[rank1]: Traceback" not in ended.stderr
    return [line for line in ended.stderr.splitlines() if line.startswith("error: ")]


@pytest.mark.slow
def test_two_ranks_are_one(settings, contrastive_settings, saved_base, few, tmp_path) -> None:
    """A student's are one with twice the accumulation, a retriever's one with the whole batch; so
    are a student's where FSDP gives each a part of the weights, after a kill, and where one rank
    began and two go on, or the reverse. What goes wrong on one rank ends both with one sentence.
    """
    runs = tmp_path / "sft"
    one = alone(settings, runs / "one")
    # Unlike 4-bit weights, those of such a base are parted too.
    unquantised = replace(settings.student, quantization="none")
    best = replace(settings.train, best_metric="eval_answer_loss")
    plain = replace(settings, student=unquantised, train=best)
    alone(plain, runs / "plain")
    train = contrastive_settings.train
    many = replace(contrastive_settings.retriever, late=LateConfig(width=24))
    late = replace(contrastive_settings, retriever=many, train=replace(train, scale=1.0))
    base = {"architecture": None, "model": saved_base, "lora": LoraConfig(rank=4)}
    adapted = replace(contrastive_settings.retriever, **base)
    # Mined frames are often another query's target, which both ranks mask.
    train = replace(train, mine_every=2, reuse_features=True)
    mined = replace(contrastive_settings, retriever=adapted, train=train)
    wholes = {"plain": contrastive_settings, "mined": mined, "late": late}
    for name, alone_settings in wholes.items():
        (whole := tmp_path / "contrastive" / name).mkdir(parents=True)
        contrastive.main.__wrapped__(alone_settings, Run(name, whole))
    told = [
        planned(settings, runs / "two"),
        planned(settings, runs / "more", after=one / "checkpoint-2"),
        planned(settings, runs / "parts", fsdp=True),
        planned(settings, runs / "on", fsdp=True, after=runs / "parts" / "checkpoint-2"),
        planned(settings, runs / "done", fsdp=True, after=runs / "parts" / "checkpoint-4"),
        *(ranking(cfg, tmp_path / "contrastive" / f"{name}-two") for name, cfg in wholes.items()),
        planned(plain, runs / "plain-parts", fsdp=True),
        planned(settings, runs / "lost", fails_on=1),
    ]
    file = tmp_path / "runs.json"
    benchmark = asdict(settings.benchmark)
    file.write_text(json.dumps({"benchmark": benchmark, "runs": told}, default=str))
    ended = launch(*SHARDED, LAUNCHED, file)
    assert errors_of(ended) == ["error: this rank alone cannot go on  [user-error]"], ended.stderr
    assert ended.returncode == 1
    for name in ("two", "parts"):
        same(one, runs / name)
    same(runs / "plain", runs / "plain-parts")
    for name in wholes:
        whole = tmp_path / "contrastive" / name
        same_journals(whole, whole.with_name(f"{name}-two"))
        weights = "adapter_model" if name == "mined" else "model"
        same_weights(whole, whole.with_name(f"{name}-two"), f"retriever/{weights}.safetensors")
    same_weights(whole, whole.with_name(f"{name}-two"), "retriever/1_Dense/model.safetensors")
    for name in ("more", "on"):
        same(one, runs / name, step=2)
    same_weights(one, runs / "done")
    fewer = alone(settings, runs / "fewer", after=runs / "two" / "checkpoint-2")
    same(one, fewer, step=2)
    with raises_user_error("other-launch", contains="checkpoint-2"):
        alone(settings, runs / "mixed", after=runs / "parts" / "checkpoint-2")
    for what, folder in (("file of weights", "pytorch_model_fsdp_0"), ("optimizer", "optimizer_0")):
        parts = runs / "parts" / "checkpoint-4" / folder / ".metadata"
        listed = parts.rename(runs / "listed")
        assert find_damage(runs / "parts" / "checkpoint-4") == f"its {what} is missing"
        listed.rename(parts)
    assert find_damage(runs / "parts" / "checkpoint-4") is None
    record = json.loads((runs / "two" / "run.json").read_text())
    assert (record["ranks"], record["earlier_starts"]) == (2, [])
    assert (runs / "two" / "run.log").read_text().count("loading student") == 1
    assert json.loads((runs / "two" / "metrics.json").read_text()) == pytest.approx(
        journal.run_metrics(one), rel=1e-5
    )


@pytest.mark.slow
def test_what_is_wrong_for_all_ranks_is_said_once(tmp_path) -> None:
    overrides = ["+exp=cot", "train.batch=6", "train.micro_batch=2", f"checkpoints={tmp_path}"]
    ended = launch("--multi_gpu", "-m", "train.sft", *overrides)
    assert ended.returncode == 1
    (line,) = errors_of(ended)
    assert "train.batch=6" in line
    assert line.endswith("[uneven-batch]")


@pytest.mark.slow
def test_fsdp_that_would_be_passed_over_is_refused(settings, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("ACCELERATE_USE_FSDP", "true")
    with raises_user_error("unsupported-with-fsdp", contains="--use_fsdp"):
        alone(settings, tmp_path / "run")


@pytest.mark.parametrize("count", [1, 2, 5, 8, 11, 64])
@pytest.mark.parametrize(("micro_batch", "number"), [(1, 2), (2, 2), (4, 2), (2, 4), (1, 8)])
def test_ranks_share_the_steps_of_one(count, micro_batch, number) -> None:
    """As accelerate deals out an order: micro-batches in turn."""
    lengths = np.random.default_rng(0).integers(1, 1000, count).tolist()
    alone = list(LengthSampler(lengths, 8, 0))
    order = LengthSampler(lengths, 8, 0, micro_batch, number)
    batches = BatchSampler(order, micro_batch, drop_last=False)
    dealt = [list(BatchSamplerShard(batches, number, rank)) for rank in range(number)]
    assert len(order) == len(list(order)) == sum(len(b) for part in dealt for b in part)
    each = 8 // (micro_batch * number)
    for step in range(0, count, 8):
        first = step // 8 * each
        taken = [i for part in dealt for b in part[first : first + each] for i in b]
        supervised = sorted(i for i in taken if i >= 0)
        assert supervised == sorted(alone[step : step + 8])
        # Fillers are the shortest there is.
        assert {~i for i in taken if i < 0} <= {alone[step : step + 8][-1]}
    assert len({len(part) for part in dealt}) == 1


def test_ranks_have_as_much_to_do() -> None:
    """None gets the longer of each two neighbours."""
    lengths = np.random.default_rng(0).integers(1, 1000, 64)
    order = np.array(list(LengthSampler(lengths.tolist(), 64, 0, 1, 2))).reshape(-1, 2)
    loads = lengths[order].sum(axis=0)
    assert abs(loads[0] - loads[1]) <= lengths.max() - lengths.min()
    assert (lengths[order[::2, 0]] >= lengths[order[::2, 1]]).all()
    assert (lengths[order[1::2, 0]] <= lengths[order[1::2, 1]]).all()


def test_a_filler_changes_no_loss(micro_store, frames, student_cfg, processor, model) -> None:
    items = micro_store.selection("train")[:2]
    made = StudentDataset(
        [
            LazySample("", 0, partial(shown, item, frames, student_cfg, text))
            for item, text in zip(items, ("Answer: A", "near the top\nAnswer: B"), strict=True)
        ]
    )
    collate = Collator(processor, 1500)
    plain = collate([made[0], made[1]])
    filled = collate([made[0], made[1], made[~0]])
    count = int((plain["labels"] != IGNORED).sum())
    assert int((filled["labels"] != IGNORED).sum()) == count
    losses = []
    for batch in (plain, filled, collate([made[~1]])):
        labels = batch.pop("labels")
        logits = model(**batch, use_cache=False).logits
        losses.append(token_mean(SimpleNamespace(logits=logits), labels, count))
        each = token_losses(logits, labels)
        torch.testing.assert_close(each[:, 0].sum() / count, losses[-1])
    torch.testing.assert_close(losses[0], losses[1])
    assert losses[2] == 0
    losses[2].backward()
    assert all((p.grad == 0).all() for p in model.parameters() if p.grad is not None)


def shown(item, frames, cfg, text, epoch):
    return selection_sample(item, "answer", "cot", frames, cfg.frames, text)


def test_a_step_is_split_over_micro_batches_and_ranks(monkeypatch) -> None:
    assert distributed.accumulation_steps(16, 2) == 8
    monkeypatch.setenv("LOCAL_RANK", "1")
    monkeypatch.setenv("RANK", "1")
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert distributed.accumulation_steps(16, 2) == 2
    with raises_user_error("uneven-batch", contains=("train.batch=16", "32")):
        distributed.accumulation_steps(16, 8)
