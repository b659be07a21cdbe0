"""evaluation.select on a small student, and which models the evaluation commands accept."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace

import jsonschema
import pytest
from omegaconf import OmegaConf

from dynapix.conf.files import read_json_lines
from dynapix.conf.schema import (
    ContrastiveCommand,
    EmbedderConfig,
    ReportCommand,
    SelectCommand,
    SftCommand,
    StudentConfig,
)
from dynapix.evaluation import report, select
from dynapix.evaluation.generators.response_log import ResponseLog
from dynapix.evaluation.generators.response_schema import build_record_schema
from dynapix.models.student.answer_parser import parse_choice
from dynapix.models.trained_runs import check_unseen, read_trained_settings, resolve_model
from tests.evaluation.models.conftest import (
    STUDENT,
    check_resumed,
    new_run,
    tear,
)
from tests.evaluation.reporting.measured import finish
from tests.user_errors import raises_user_error


@pytest.mark.slow
def test_a_student_is_measured_resumed_and_reported(
    trained_student, micro, micro_store, tmp_path
) -> None:
    store = str(micro_store.folder.parent)
    cfg = SelectCommand(
        benchmark=micro, student=StudentConfig(name="unused", model="unused"), store=store,
        model=str(trained_student), batch=4, limit=8,
    )  # fmt: skip
    run = new_run(tmp_path / "select" / "run")
    metrics = select.main.__wrapped__(cfg, run)
    finish(run.folder, cfg, metrics=metrics)
    first = (run.folder / "report.json").read_text()
    (reasoning, answer) = json.loads(first)["rows"]
    assert (reasoning["n"], answer["n"]) == (8, 8)
    assert set(answer["families"]) == {"event", "time", "window"}
    assert "paper" in (run.folder / "report.txt").read_text()

    # A killed run generates only the missing responses, and its results are the same.
    log = run.folder / "answers.jsonl"
    complete, torn = tear(log)
    headers = [json.loads(line) for line in complete.splitlines()[:2]]
    settings = {header["mode"]: header["asked"] for header in headers}
    items = micro_store.selection("test")
    assert 0 < len(ResponseLog(log, settings, items).responses) < 16
    select.main.__wrapped__(cfg, run)
    assert (run.folder / "report.json").read_text() == first
    check_resumed(log, complete, torn)

    # Responses are scored again when they are read, and a damaged line counts as missing.
    edited = complete.replace('"right": false', '"right": true').splitlines()
    log.write_text("\n".join([*edited[:4], "{", *edited[5:]]) + "\n")
    responses = ResponseLog(log, settings, items).responses
    assert len(responses) == 15
    letters = {i.item_id: i.letter for i in items}
    assert all(a.right == (a.letter == letters[a.item_id]) for a in responses.values())
    log.write_text(complete)
    # Responses of other weights are not reused.
    other_model = {mode: {**values, "model": "another"} for mode, values in settings.items()}
    assert not ResponseLog(log, other_model, items).responses

    shutil.copytree(trained_student, tmp_path / "sft" / "run")
    page = new_run(tmp_path / "report" / "run")
    report.main.__wrapped__(ReportCommand(checkpoints=str(tmp_path), store=store), page)
    html = (page.folder / "report.html").read_text()
    assert all(f'"id": "{item.item_id}"' in html for item in select.limit_items(items, 8, 0))


@pytest.mark.slow
def test_sampled_records_of_a_base_are_the_same_after_a_kill(
    trained_student, micro, micro_store, tmp_path
) -> None:
    student = replace(
        STUDENT, model=str(trained_student / "student"), architecture=None, temperature=1.0,
        top_k=50,
    )  # fmt: skip
    cfg = SelectCommand(
        benchmark=micro, student=student, store=str(micro_store.folder.parent), modes=["record"],
        batch=3, seed=5, limit=8,
    )  # fmt: skip
    run = new_run(tmp_path / "sampled")
    assert set(select.main.__wrapped__(cfg, run)) >= {"record_micro", "record_parse_rate"}
    log = run.folder / "answers.jsonl"
    complete, torn = tear(log)
    select.main.__wrapped__(replace(cfg, batch=2), run)
    check_resumed(log, complete, torn)
    assert len({json.loads(line)["text"] for line in complete.splitlines()[1:]}) == 8


@pytest.mark.slow
def test_constrained_decoding_yields_records_only(micro, micro_store, tmp_path) -> None:
    student = replace(STUDENT, max_new_tokens=900, temperature=1)
    cfg = SelectCommand(
        benchmark=micro, student=student, store=str(micro_store.folder.parent), limit=4, batch=3
    )
    metrics = select.main.__wrapped__(cfg, new_run(tmp_path))
    assert metrics["constrained_parse_rate"] == 1 > metrics["record_parse_rate"]
    rows = list(read_json_lines(tmp_path / "answers.jsonl"))
    constrained = [row for row in rows if row["mode"] == "constrained" and "text" in row]
    assert len(constrained) == 4
    for row in constrained:
        assert parse_choice(row["text"]).letter == row["letter"]
        # A model with random weights may write texts up to the token limit, which cuts the record,
        # and control characters, which `strict` would refuse.
        if not row["truncated"]:
            record = json.loads(row["text"], strict=False)
            jsonschema.validate(record, build_record_schema())
            assert list(record) == list(build_record_schema()["properties"])


def test_the_log_is_append_only(micro_store, tmp_path) -> None:
    path, items = tmp_path / "answers.jsonl", micro_store.selection("test")[:2]
    ResponseLog(path, {"answer": {"seed": 0}}, items)
    torn = path.read_bytes() + b'{"item_id": "to'
    path.write_bytes(torn)
    ResponseLog(path, {"answer": {"seed": 1}}, items)
    assert path.read_bytes().startswith(torn + b"\n{")
    before = path.read_bytes()
    ResponseLog(path, {"answer": {"seed": 0}}, items)
    assert path.read_bytes() == before


@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (shutil.rmtree, "missing-run"),
        (lambda run: (run / "metrics.json").unlink(), "unfinished-run"),
        (lambda run: (run / "config.yaml").write_text("student: [1"), "damaged-file"),
        (lambda run: (run / "config.yaml").write_text(""), "missing-run"),
        (lambda run: (run / "config.yaml").write_text("student: {rank: 1}"), "damaged-file"),
        (lambda run: (run / "config.yaml").write_text("retriever: {}"), "missing-run"),
    ],
)
def test_a_run_that_cannot_be_measured_is_refused(trained_student, tmp_path, damage, code) -> None:
    shutil.copytree(trained_student, tmp_path / "run")
    damage(tmp_path / "run")
    with raises_user_error(code):
        read_trained_settings(tmp_path / "run", SftCommand, "student")


def test_other_folders_than_runs_are_named(trained_student, tmp_path) -> None:
    run, base = tmp_path / "run", tmp_path / "base"
    shutil.copytree(trained_student, run)
    with raises_user_error("missing-run", contains=f"model={run / 'student'}"):
        read_trained_settings(run / "student", SftCommand, "student")
    shutil.copytree(run / "student", base)
    (base / "config.json").write_text("{}")
    with raises_user_error("missing-run", contains=f"student.model={base}"):
        read_trained_settings(base, SftCommand, "student")
    (run / "run.json").write_text('{"command": "evaluation.select"}')
    with raises_user_error("missing-run", contains="no run that trained a student"):
        read_trained_settings(run, SftCommand, "student")


def test_a_model_is_not_tested_on_its_training_scenes(trained_student, micro) -> None:
    cfg = SelectCommand(model=str(trained_student))
    other_scenes = {"seed": 1, "test_share": 0.9}
    for allowed in ({}, other_scenes, {"scenes": 99}, {"test_share": 0.01}):
        benchmark = replace(micro, **allowed)
        assert resolve_model(cfg, benchmark, SftCommand, "student")[0] == trained_student
    with raises_user_error("training-scenes-tested", contains="test_share=0.9"):
        resolve_model(cfg, replace(micro, test_share=0.9), SftCommand, "student")
    release = replace(micro, simulator="clevrer", folder="/release")
    check_unseen("model", release, replace(release, folder="/other", seed=1))
    # With another seed, the same release is split differently.
    with raises_user_error("training-scenes-tested", contains="seed=1"):
        check_unseen("model", release, replace(release, seed=1))


def test_a_base_is_not_tested_on_its_training_scenes(micro, tmp_path) -> None:
    trained = OmegaConf.structured(replace(micro, test_share=0.01))
    OmegaConf.save({"benchmark": trained}, tmp_path / "config.yaml")
    cfg = SelectCommand(student=StudentConfig(name="x", model=str(tmp_path)))
    resolve_model(cfg, replace(micro, seed=1), SftCommand, "student")
    with raises_user_error("training-scenes-tested", contains=str(tmp_path)):
        resolve_model(cfg, micro, SftCommand, "student")
    (tmp_path / "config.yaml").write_text("benchmark: {scenes: [")
    with raises_user_error("damaged-file", contains=str(tmp_path)):
        resolve_model(cfg, micro, SftCommand, "student")
    # A file of another project.
    (tmp_path / "config.yaml").write_text("hidden: 64")
    resolve_model(cfg, micro, SftCommand, "student")


def test_settings_that_a_trained_model_cannot_use_are_refused(
    trained_student, trained_retriever, micro
) -> None:
    cfg = SelectCommand(
        model=str(trained_student), student=StudentConfig(name="x", temperature=0.7, frames=2)
    )
    overrides = ("modes=[answer]", "student.temperature=0.7")
    _, settings = resolve_model(cfg, micro, SftCommand, "student", overrides)
    assert settings.student.temperature == 0.7
    # Settings without an override come from the run.
    assert settings.student.frames == STUDENT.frames != 2
    for refused in ("student=qwen3_vl_8b", "student.lora.rank=8", "++train.regime=cot"):
        with raises_user_error("unused-setting", contains="student.temperature"):
            resolve_model(cfg, micro, SftCommand, "student", (*overrides, refused))
    matcher = EmbedderConfig(model=str(trained_retriever))
    arguments = (matcher, micro, ContrastiveCommand, "retriever")
    resolve_model(*arguments, ("student.frames=2", "matcher.model=RUN"), "matcher.model")
    for refused in ("matcher=clip", "matcher.retriever.image_size=64"):
        with raises_user_error("unused-setting", contains="matcher.train"):
            resolve_model(*arguments, (refused,), "matcher.model")


def test_a_limit_spreads_over_the_families(micro_store) -> None:
    items = micro_store.selection()
    few = select.limit_items(items, 6, seed=0)
    assert sorted(i.family for i in few) == ["event"] * 2 + ["time"] * 2 + ["window"] * 2
    assert select.limit_items(items, 6, seed=0) == few
    assert select.limit_items(items, None, seed=0) == items
