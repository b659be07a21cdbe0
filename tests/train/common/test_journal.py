"""What is measured while a student is trained, and where it is recorded."""

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
from transformers import ProcessorMixin, Qwen3VLConfig
from transformers.trainer_callback import TrainerControl, TrainerState

from dynapix.conf.entry import Run
from dynapix.conf.schema import SelectCommand, SftCommand
from dynapix.evaluation.generators.generator import item_sample
from dynapix.evaluation.generators.local import LocalModel
from dynapix.evaluation.generators.response_log import ResponseLog, collect_responses
from dynapix.models import compat
from dynapix.models.student.prompts import build_sample
from dynapix.train import sft
from dynapix.train.common.callbacks import MetricsBar
from dynapix.train.common.journal import read_journal, read_lines
from dynapix.train.common.training_loop import check_trackers
from dynapix.train.student.held_out_answers import HeldOutAnswers
from dynapix.train.student.samples import LazySample, StudentDataset
from tests.user_errors import raises_user_error


@pytest.fixture(scope="module")
def settings(few_steps) -> SftCommand:
    return few_steps(validation_items=4, generated_items=2, report_to=["tensorboard"])


@pytest.fixture(scope="module")
def trained(settings, tmp_path_factory) -> tuple[Path, dict[str, float]]:
    folder = tmp_path_factory.mktemp("trained")
    return folder, sft.main.__wrapped__(settings, Run("trained", folder))


def equal_adapters(one: Path, two: Path) -> bool:
    first, second = (load_file(folder / "adapter_model.safetensors") for folder in (one, two))
    return first.keys() == second.keys() and all(torch.equal(first[k], second[k]) for k in first)


@pytest.mark.slow
def test_generated_answers_equal_those_of_evaluation_select(
    trained, settings, micro_store, frames, tmp_path
) -> None:
    folder, _ = trained
    rows = [r for r in read_lines(folder / "samples.jsonl") if r["step"] == 4]
    cfg = SelectCommand(batch=2, student=settings.student)
    student = LocalModel(cfg, folder, settings.student, "fp32")
    compat.keep_differentiable(student.loaded[0])
    by_id = {item.item_id: item for item in micro_store.selection("train")}
    for mode in ("reasoning", "answer"):
        written = {r["sample"].removesuffix(f" ({mode})"): r for r in rows if r["mode"] == mode}
        assert len(written) == 2
        items = [by_id[item_id] for item_id in written]
        log = ResponseLog(tmp_path / f"{mode}.jsonl", {mode: {}}, items)
        sample_of = partial(item_sample, "cot", frames, settings.student, None, mode)
        respond = partial(student.respond, mode, sample_of)
        for answer in collect_responses(items, mode, respond, log):
            row = written[answer.item_id]
            assert row["text"] == answer.text
            assert (row["letter"], row["reason"]) == (answer.letter, answer.reason)
            assert row["answer"] == by_id[answer.item_id].letter


@pytest.mark.slow
def test_generating_answers_and_resuming_do_not_change_a_run(trained, settings, tmp_path) -> None:
    folder, results = trained
    losses = [r["eval_answer_loss"] for r in read_journal(folder) if "eval_answer_loss" in r]
    assert (results["answer_loss_at_start"], results["answer_loss"]) == (losses[0], losses[-1])
    plain = replace(settings, train=replace(settings.train, generated_items=0, report_to=[]))
    unmeasured = tmp_path / "unmeasured"
    unmeasured.mkdir()
    sft.main.__wrapped__(plain, Run("unmeasured", unmeasured))
    common = [{k: v for k, v in r.items() if "_generated_" not in k} for r in read_journal(folder)]
    assert read_journal(unmeasured) == common
    assert equal_adapters(folder / "student", unmeasured / "student")
    assert not (unmeasured / "samples.jsonl").exists()

    # The first time, the run resumes from a checkpoint that is older than the last lines of its
    # journal; the second time, its last step is done.
    resumed = tmp_path / "resumed"
    shutil.copytree(folder / "checkpoint-2", resumed / "checkpoint-2")
    for name in ("metrics.jsonl", "samples.jsonl"):
        shutil.copy(folder / name, resumed)
    for _ in range(2):
        shutil.rmtree(resumed / "student", ignore_errors=True)
        assert sft.main.__wrapped__(settings, Run("resumed", resumed)) == pytest.approx(results)
        assert equal_adapters(folder / "student", resumed / "student")
        for name in ("metrics.jsonl", "samples.jsonl"):
            assert read_lines(resumed / name) == read_lines(folder / name)


@pytest.mark.slow
def test_trackers_receive_every_measure(trained) -> None:
    folder, _ = trained
    (events,) = (folder / "runs").glob("*/events*")
    tracked = EventAccumulator(str(events.parent)).Reload()
    for record in read_journal(folder):
        for key, value in record.items():
            if key.startswith("eval_"):
                scalars = tracked.Scalars(f"eval/{key.removeprefix('eval_')}")
                (found,) = [s.value for s in scalars if s.step == record["step"]]
                assert found == pytest.approx(value, rel=1e-6)


class Writer(nn.Module):
    """A model that generates given texts."""

    config = Qwen3VLConfig()
    generation_config = None

    def __init__(self, processor: ProcessorMixin, texts: list[str]) -> None:
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(1))
        self._processor, self._texts = processor, texts

    def generate(self, input_ids: torch.Tensor, **_) -> torch.Tensor:
        tokenizer = self._processor.tokenizer
        new = tokenizer(self._texts, padding=True, padding_side="right", return_tensors="pt")
        return torch.cat([input_ids, new.input_ids], dim=1)


def held_out(responses: list[str]) -> StudentDataset:
    def lazy(k: int, response: str) -> LazySample:
        return LazySample(
            response, 0, f"item-{k}", lambda _: build_sample(f"item-{k}", ["Which?"], response)
        )

    return StudentDataset([lazy(k, response) for k, response in enumerate(responses)])


def test_shares_of_parsed_and_correct_answers(few_steps, processor, tmp_path) -> None:
    samples = held_out(["Answer: A", "It falls.\nAnswer: B", "Answer: C", "Answer: D", "Answer: A"])
    texts = ["Answer: A", "It falls.\nAnswer: C", "It falls", "Answer: D"]
    settings = few_steps(generated_items=4)
    answers = HeldOutAnswers(settings.train, settings.student, processor, tmp_path)
    measures = answers.measure(Writer(processor, texts), "answer", samples, step=7)
    assert measures == {"generated_parse_rate": 3 / 4, "generated_accuracy": 2 / 4}
    rows = [json.loads(line) for line in (tmp_path / "samples.jsonl").read_text().splitlines()]
    assert [r["text"] for r in rows] == texts
    assert [r["letter"] for r in rows] == ["A", "C", None, "D"]
    assert [r["answer"] for r in rows] == ["A", "B", "C", "D"]
    assert {(r["step"], r["mode"]) for r in rows} == {(7, "answer")}


def test_the_progress_bar_shows_the_latest_measures() -> None:
    bar = MetricsBar()
    bar.training_bar = tqdm(total=9, file=io.StringIO())
    logs = {"loss": 2.0, "train_loss": 9.0, "eval_runtime": 1.0}
    logs |= {"eval_answer_loss": 1.25, "eval_answer_letter_accuracy_event": 0.25}
    bar.on_log(None, TrainerState(), TrainerControl(), logs=logs)
    assert bar.training_bar.postfix == "loss=2, answer_loss=1.25"


def test_an_unknown_or_missing_tracker_is_refused() -> None:
    check_trackers(["tensorboard"])
    with raises_user_error("unknown-tracker", contains="train.report_to=tensorbord"):
        check_trackers(["tensorbord"])
    with raises_user_error("unknown-tracker", contains="pip install dvclive"):
        check_trackers(["tensorboard", "dvclive"])
