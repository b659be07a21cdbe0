"""On-policy distillation: the loss is the divergence on the student's own tokens."""

from __future__ import annotations

import json
import pickle
import shutil
from dataclasses import asdict, replace
from pathlib import Path

import pytest
import torch

from dynapix.conf.compose import compose
from dynapix.conf.entry import Run
from dynapix.conf.runs import open_run
from dynapix.conf.schema import (
    DistillCommand,
    DistillTrainConfig,
    ExportModelCommand,
    ReinforceCommand,
    ReinforceTrainConfig,
    SftCommand,
)
from dynapix.data.store import Store
from dynapix.models import loading
from dynapix.models.student.answer_parser import ParsedAnswer
from dynapix.models.trained_runs import read_trained_settings
from dynapix.teacher.narrate import ensure_rationales
from dynapix.train import distill, export
from dynapix.train.common.journal import read_journal
from dynapix.train.export import find_run
from dynapix.train.on_policy import distillation, paired_prompts, sampling
from dynapix.train.on_policy.continuation import inherit_settings
from dynapix.train.on_policy.paired_prompts import PairedPrompts
from dynapix.train.on_policy.teachers import LocalTeacher, check_tokenizer
from tests.train.on_policy.conftest import finish_run
from tests.user_errors import raises_user_error

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def teacher(few_steps, tmp_path_factory) -> Path:
    return finish_run(few_steps(max_steps=2, facts=True), tmp_path_factory.mktemp("teacher"))


@pytest.fixture
def settings(student: Path, teacher: Path, micro_store: Store) -> DistillCommand:
    train = DistillTrainConfig(
        lr=1e-2, max_steps=4, batch=4, micro_batch=2, precision="fp32", evaluations=2,
        validation_items=2, generated_items=0, permute_candidates=True,
    )  # fmt: skip
    return DistillCommand(
        model=str(student), teacher_model=str(teacher), store=str(micro_store.folder.parent),
        workers=1, train=train,
    )  # fmt: skip


def run_distill(settings: DistillCommand, folder: Path) -> Path:
    folder.mkdir(exist_ok=True)
    distill.main.__wrapped__(settings, Run(folder.name, folder))
    return folder


def test_null_settings_are_those_of_the_students_training() -> None:
    trained = compose("train.sft", SftCommand, ["+exp=cot"])
    names = ("micro_batch", "gradient_checkpointing", "permute_candidates")
    inherited = inherit_settings(DistillCommand(model="run"), trained).train
    assert inherited.lr == trained.train.lr / 2
    assert all(getattr(inherited, name) == getattr(trained.train, name) for name in names)
    rewarded = inherit_settings(ReinforceCommand(model="run"), trained).train
    assert rewarded.lr == ReinforceTrainConfig.LR_SHARE * trained.train.lr
    given = DistillTrainConfig(
        lr=1, micro_batch=2, gradient_checkpointing=True, permute_candidates=False
    )
    assert inherit_settings(DistillCommand(train=given), trained).train == given


def test_responses_do_not_depend_on_how_many_are_sampled_at_once(
    settings, student, micro_store
) -> None:
    trained = read_trained_settings(student, SftCommand, "student")
    cfg = replace(trained.student, quantization="none", max_new_tokens=8)
    model, processor = loading.load_student(cfg, "fp32", list)
    rationales = ensure_rationales(micro_store, trained.teacher)
    training, _ = paired_prompts.load_datasets(settings, trained, micro_store, rationales)
    samples = [training[k].student for k in range(5)]
    prompts = [sampling.encode_prompt(s, processor, cfg.max_length) for s in samples]
    found = []
    for size in (None, 2):
        train_settings = replace(settings.train, sampling_batch=size)
        sampler = distillation.ResponseSampler(processor, cfg, train_settings)
        found.append([text.text for text in sampler.sample(model, prompts, range(5))])
        assert sampler.sample(model, [], []) == []
    assert found[0] == found[1]


def test_datasets_can_be_sent_to_worker_processes(settings, student, micro_store) -> None:
    trained = read_trained_settings(student, SftCommand, "student")
    rationales = ensure_rationales(micro_store, trained.teacher)
    training, _ = paired_prompts.load_datasets(settings, trained, micro_store, rationales)
    copy = pickle.loads(pickle.dumps(training))
    for dataset in (training, copy):
        dataset.set_epoch(1)
    ours, theirs = training[0], copy[0]
    assert (ours.seed, ours.letter) == (theirs.seed, theirs.letter)
    assert ours.student.content == theirs.student.content


LESS_MEMORY = {
    "micro_batch": 1, "sampling_batch": 3, "gradient_checkpointing": True, "workers": 1
}  # fmt: skip


def test_a_run_that_resumes_with_less_memory_samples_the_same_responses(
    settings, tmp_path, monkeypatch
) -> None:
    sampled: dict[str, list[tuple[int, ...]]] = {"whole": [], "resumed": []}
    sample = distillation.ResponseSampler.sample
    whole, resumed = tmp_path / "whole", tmp_path / "resumed"

    def recorded(self, model, prompts, seeds):
        texts = sample(self, model, prompts, seeds)
        sampled[current].extend(text.ids for text in texts)
        return texts

    monkeypatch.setattr(distillation.ResponseSampler, "sample", recorded)
    current = "whole"
    run_distill(settings, whole)
    shutil.copytree(whole / "checkpoint-2", resumed / "checkpoint-2")
    shutil.copy(whole / "metrics.jsonl", resumed)
    current = "resumed"
    run_distill(replace(settings, train=replace(settings.train, **LESS_MEMORY)), resumed)
    assert len(sampled["whole"]) == 16
    assert len(set(sampled["whole"])) > 8
    assert sampled["resumed"] == sampled["whole"][8:]
    for first, second in zip(read_journal(whole), read_journal(resumed), strict=True):
        assert first == pytest.approx(second, rel=1e-2)
    losses = [r for r in read_journal(whole) if "loss" in r]
    assert len(losses) == 4
    assert all(r["loss"] > 0 and 0 <= r["sampled_parse_rate"] <= 1 for r in losses)


def test_a_teacher_equal_to_the_student_gives_no_loss(settings, tmp_path, monkeypatch) -> None:
    """If the teacher has the student's weights and its prompt, loss and gradient are zero."""
    pair = paired_prompts.pair_prompts

    def same_prompts(*arguments):
        lazy = pair(*arguments)

        def render(epoch: int) -> PairedPrompts:
            sample = lazy.render(epoch)
            return replace(sample, teacher=sample.student)

        return replace(lazy, render=render)

    monkeypatch.setattr(paired_prompts, "pair_prompts", same_prompts)
    train = replace(settings.train, max_steps=1, evaluations=1)
    folder = run_distill(replace(settings, teacher_model=None, train=train), tmp_path / "run")
    (record,) = (r for r in read_journal(folder) if "loss" in r)
    assert record["loss"] == pytest.approx(0, abs=1e-6)
    # The student's layers use other kernels than the teacher's.
    assert record["grad_norm"] == pytest.approx(0, abs=1e-3)


def test_micro_batches_change_neither_loss_nor_gradient(settings, tmp_path) -> None:
    records = []
    for micro_batch in (4, 1):
        few = {"max_steps": 1, "evaluations": 1, "temperature": 0.7}
        train = replace(settings.train, **few, micro_batch=micro_batch)
        folder = run_distill(replace(settings, train=train), tmp_path / str(micro_batch))
        records += [r for r in read_journal(folder) if "loss" in r]
    assert records[0]["loss"] == pytest.approx(records[1]["loss"], rel=1e-4)
    assert records[0]["grad_norm"] == pytest.approx(records[1]["grad_norm"], rel=1e-3)
    # The sampler suppresses two tokens of the small vocabulary.
    assert all(0 < r["mismatch_mean"] <= r["mismatch_max"] < 0.02 for r in records)


def test_a_non_finite_divergence_stops_the_run(settings, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(
        LocalTeacher, "measure", lambda *_: torch.full((1,), torch.nan, requires_grad=True)
    )
    with raises_user_error("non-finite-loss", contains="train.lr"):
        run_distill(settings, tmp_path / "run")


def test_responses_without_answers_stop_the_run(settings, tmp_path, monkeypatch) -> None:
    monkeypatch.setattr(sampling, "MAX_UNPARSED", 8)
    monkeypatch.setattr(distillation, "parse_choice", lambda *_, **__: ParsedAnswer(None))
    with raises_user_error("nothing-parsed", contains="last 8 sampled responses"):
        run_distill(settings, tmp_path / "run")


def test_the_student_can_be_evaluated_and_exported(settings, student, tmp_path) -> None:
    run = Run("run", tmp_path / "distill" / "run")
    open_run(run, asdict(settings), "train.distill")
    metrics = distill.main.__wrapped__(settings, run)
    (run.folder / "metrics.json").write_text(json.dumps(metrics))
    # Its settings no longer depend on the run that it continues.
    source = read_trained_settings(student, SftCommand, "student")
    student.rename(tmp_path / "moved")
    name, folder, found = find_run(str(run.folder), "student", str(tmp_path))
    (tmp_path / "moved").rename(student)
    assert (name, folder) == ("distill/run", run.folder)
    assert (found.student, found.benchmark) == (source.student, source.benchmark)
    assert (found.train.regime, found.train.lr) == (source.train.regime, settings.train.lr)
    loading.load_trained(found.student, "fp32", run.folder / "student")
    cfg = ExportModelCommand(
        run=str(run.folder), checkpoints=str(tmp_path), format="fp32", store=settings.store
    )
    (tmp_path / "export").mkdir()
    export.main.__wrapped__(cfg, Run("run/fp32", tmp_path / "export"))
    record = json.loads((tmp_path / "export" / "student" / "export.json").read_text())
    assert record["run"] == "distill/run"


def test_a_teacher_with_another_tokenizer_is_refused(processor, student, tmp_path) -> None:
    folder = shutil.copytree(student / "student", tmp_path / "other")
    other = loading.AutoProcessor.from_pretrained(folder)
    other.tokenizer.add_tokens(["zebra"])
    with raises_user_error("other-tokenizer", contains="'zebra' (id None in the student"):
        tokenizer = loading.AutoProcessor.from_pretrained(folder).tokenizer
        check_tokenizer(tmp_path, tokenizer, other.tokenizer)


def test_unsuitable_runs_are_refused(settings, student, teacher, few_steps, tmp_path) -> None:
    with raises_user_error("missing-run", contains="model is missing"):
        run_distill(replace(settings, model=None), tmp_path / "a")
    with raises_user_error("facts-instead-of-frames", contains=str(teacher)):
        run_distill(replace(settings, model=str(teacher)), tmp_path / "b")
    answers = finish_run(few_steps(max_steps=1, regime="answer_only"), tmp_path / "answers")
    with raises_user_error("untrained-mode", contains="train.regime=answer_only"):
        run_distill(replace(settings, model=str(answers)), tmp_path / "c")
    with raises_user_error("other-settings", contains="train.regime=answer_only"):
        run_distill(replace(settings, teacher_model=str(answers)), tmp_path / "d")
