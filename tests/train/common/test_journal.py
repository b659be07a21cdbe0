"""What is measured while a student is trained: what it writes, shown where a researcher looks, and
by which the best checkpoint is kept."""

from __future__ import annotations

import io
import json
import shutil
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator
from torch import nn
from tqdm import tqdm
from transformers import ProcessorMixin
from transformers.trainer_callback import TrainerControl, TrainerState

from conf import trackers
from conf.entry import Run
from conf.schema import SftCommand
from evaluation.generators import local
from evaluation.generators.base import item_sample
from evaluation.generators.response_log import ResponseLog, collect_responses
from models import compat, loading
from models.student.prompts import conversation
from tests.user_errors import raises_user_error
from train import sft
from train.common.callbacks import MetricsBar
from train.common.journal import read_journal, read_lines
from train.student.held_out_answers import HeldOutAnswers
from train.student.lazy_samples import LazySample, StudentDataset


@pytest.fixture(scope="module")
def settings(few_steps) -> SftCommand:
    return few_steps(
        validation_items=4,
        generated_items=2,
        keep_checkpoints=1,
        best_metric="eval_answer_generated_parse_rate",
        report_to=["tensorboard"],
    )


@pytest.fixture(scope="module")
def watched(settings, tmp_path_factory) -> tuple[Path, dict[str, float]]:
    """A run whose best checkpoint is its first one: what was never trained to write writes nothing
    that can be read, at no step better than at another."""
    folder = tmp_path_factory.mktemp("watched")
    return folder, sft.main.__wrapped__(settings, Run("watched", folder))


def adapters(folder: Path) -> dict[str, torch.Tensor]:
    return load_file(folder / "adapter_model.safetensors")


def same(one: Path, two: Path) -> bool:
    first, second = adapters(one), adapters(two)
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)


@pytest.mark.slow
def test_the_best_checkpoint_becomes_the_student(watched) -> None:
    folder, results = watched
    assert sorted(p.name for p in folder.glob("checkpoint-*")) == ["checkpoint-2"]
    assert same(folder / "student", folder / "checkpoint-2")
    assert results["best_step"] == 2
    at_best = [r for r in read_journal(folder) if r["step"] == 2]
    for mode in ("reasoning", "answer"):
        (loss,) = [r[key] for r in at_best if (key := f"eval_{mode}_loss") in r]
        assert results[f"{mode}_loss"] == loss
        assert results[f"{mode}_generated_parse_rate"] == 0


@pytest.mark.slow
def test_what_is_written_is_what_the_evaluation_reads(
    watched, settings, micro_store, frames, tmp_path
) -> None:
    folder, _ = watched
    rows = [r for r in read_lines(folder / "samples.jsonl") if r["step"] == 2]
    model, processor = loading.load_trained(settings.student, "fp32", folder / "student")
    compat.keep_differentiable(model)
    items = {item.item_id: item for item in micro_store.selection("train")}
    for mode in ("reasoning", "answer"):
        written = {r["sample"].removesuffix(f" ({mode})"): r for r in rows if r["mode"] == mode}
        assert len(written) == 2
        asked = [items[item_id] for item_id in written]
        log = ResponseLog(tmp_path / f"{mode}.jsonl", {mode: {}}, asked)
        sample_of = partial(item_sample, "cot", frames, settings.student, None, mode)
        answer = partial(
            local.generate_responses,
            model,
            processor,
            settings.student,
            "fp32",
            2,
            0,
            mode,
            sample_of,
        )
        given = collect_responses(asked, mode, answer, log)
        for answer in given:
            row = written[answer.item_id]
            assert row["text"] == answer.text
            assert (row["letter"], row["reason"]) == (answer.letter, answer.reason)
            assert row["answer"] == items[answer.item_id].letter


@pytest.mark.slow
def test_a_run_is_the_same_unwatched_and_gone_on_with(watched, settings, tmp_path) -> None:
    folder, results = watched
    plain = replace(
        settings.train, generated_items=0, best_metric=None, report_to=[], keep_checkpoints=2
    )
    unwatched = tmp_path / "unwatched"
    unwatched.mkdir()
    sft.main.__wrapped__(replace(settings, train=plain), Run("unwatched", unwatched))
    told = [{k: v for k, v in r.items() if "_generated_" not in k} for r in read_journal(folder)]
    assert read_journal(unwatched) == told
    assert same(folder / "checkpoint-2", unwatched / "checkpoint-2")
    assert not same(unwatched / "student", unwatched / "checkpoint-2")
    assert not (unwatched / "samples.jsonl").exists()

    # Killed after the evaluation that followed its checkpoint, and again after its last step.
    again = tmp_path / "again"
    again.mkdir()
    shutil.copytree(folder / "checkpoint-2", again / "checkpoint-2")
    for name in ("metrics.jsonl", "samples.jsonl"):
        shutil.copy(folder / name, again)
    for _ in range(2):
        shutil.rmtree(again / "student", ignore_errors=True)
        assert sft.main.__wrapped__(settings, Run("again", again)) == pytest.approx(results)
        assert same(folder / "student", again / "student")
        assert read_journal(again) == read_journal(folder)
        assert read_lines(again / "samples.jsonl") == read_lines(folder / "samples.jsonl")


@pytest.mark.slow
def test_trackers_are_told_all_that_is_measured(watched) -> None:
    folder, _ = watched
    (events,) = (folder / "runs").glob("*/events*")
    told = EventAccumulator(str(events.parent)).Reload()
    for record in read_journal(folder):
        for key, value in record.items():
            if key.startswith("eval_"):
                scalars = told.Scalars(f"eval/{key.removeprefix('eval_')}")
                (found,) = [s.value for s in scalars if s.step == record["step"]]
                assert found == pytest.approx(value, rel=1e-6)


@pytest.mark.slow
def test_a_measure_that_no_evaluation_takes_is_told(settings, tmp_path) -> None:
    train = replace(settings.train, best_metric="letter_accuracy", report_to=[], generated_items=0)
    with raises_user_error("unknown-option", contains="eval_answer_letter_accuracy"):
        sft.main.__wrapped__(replace(settings, train=train), Run("run", tmp_path))
    assert not list(tmp_path.glob("checkpoint-*"))
    assert not any("loss" in r for r in read_journal(tmp_path))


class Writer(nn.Module):
    """A model that writes what it is given to write."""

    def __init__(self, processor: ProcessorMixin, texts: list[str]) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))
        self._processor, self._texts = processor, texts

    def generate(self, input_ids: torch.Tensor, **_) -> torch.Tensor:
        tokenizer = self._processor.tokenizer
        new = tokenizer(self._texts, padding=True, padding_side="right", return_tensors="pt")
        return torch.cat([input_ids, new.input_ids], dim=1)


def held_out(responses: list[str]) -> StudentDataset:
    def planned(k: int, response: str) -> LazySample:
        return LazySample(response, 0, lambda _: conversation(f"item-{k}", ["Which?"], response))

    return StudentDataset([planned(k, response) for k, response in enumerate(responses)])


def test_shares_of_parsed_and_right_answers(processor, student_cfg, tmp_path) -> None:
    samples = held_out(["Answer: A", "It falls.\nAnswer: B", "Answer: C", "Answer: D", "Answer: A"])
    texts = ["Answer: A", "It falls.\nAnswer: C", "It falls", "Answer: D"]
    answers = HeldOutAnswers(
        processor,
        tmp_path,
        max_length=student_cfg.max_length,
        max_new_tokens=student_cfg.max_new_tokens,
        precision="fp32",
        count=4,
    )
    measures = answers.measure(Writer(processor, texts), "answer", samples, step=7)
    assert measures == {"generated_parse_rate": 3 / 4, "generated_accuracy": 2 / 4}
    rows = [json.loads(line) for line in (tmp_path / "samples.jsonl").read_text().splitlines()]
    assert [r["text"] for r in rows] == texts
    assert [r["letter"] for r in rows] == ["A", "C", None, "D"]
    assert [r["answer"] for r in rows] == ["A", "B", "C", "D"]
    assert {(r["step"], r["mode"]) for r in rows} == {(7, "answer")}

    # Descriptions ask for no letter.
    samples = held_out(["The cube is near the centre."] * 4)
    assert answers.measure(Writer(processor, texts), "frame", samples, step=8) == {}


def test_the_bar_has_the_latest_measures() -> None:
    bar = MetricsBar()
    bar.training_bar = tqdm(total=9, file=io.StringIO())
    state, control = TrainerState(), TrainerControl()
    bar.on_log(None, state, control, logs={"loss": 2.0, "train_loss": 9.0, "eval_runtime": 1.0})
    logs = {
        "eval_answer_loss": 1.25,
        "eval_answer_letter_accuracy": 0.5,
        "eval_answer_letter_accuracy_event": 0.25,
        "eval_answer_generated_parse_rate": 1.0,
        "eval_answer_generated_accuracy": 0.125,
    }
    bar.on_log(None, state, control, logs=logs)
    assert bar.training_bar.postfix == ("loss=2, answer loss=1.25 letter=0.5 parsed=1 right=0.125")


def test_unknown_or_missing_tracker_is_a_user_error() -> None:
    trackers.check_trackers(["tensorboard"])
    with raises_user_error("unknown-tracker", contains="train.report_to=tensorbord"):
        trackers.check_trackers(["tensorbord"])
    with raises_user_error("unknown-tracker", contains="pip install dvclive"):
        trackers.check_trackers(["tensorboard", "dvclive"])
