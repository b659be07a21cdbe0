"""evaluation.select on a small student and on a served base, and which models are accepted."""

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
from dynapix.conf.schema.benchmark import MATCHED_ANCHOR
from dynapix.data.items.controls import pair_items
from dynapix.evaluation import report, select
from dynapix.evaluation.generators import response_schema
from dynapix.evaluation.generators.response_log import ResponseLog
from dynapix.evaluation.metrics.results import SelectionResult, from_json
from dynapix.models.student.answer_parser import parse_choice
from dynapix.models.trained_runs import check_unseen, read_trained_settings, resolve_model
from tests.evaluation.models.conftest import SERVED, STUDENT, new_run, served_by
from tests.evaluation.reporting.measured import finish
from tests.user_errors import raises_user_error


@pytest.mark.slow
def test_a_student_is_measured_resumed_and_reported(
    trained_student, micro, micro_store, tmp_path
) -> None:
    store = str(micro_store.folder.parent)
    student = StudentConfig(name="unused", model="unused", temperature=1.0, top_k=50)
    cfg = SelectCommand(
        benchmark=micro, student=student, store=store, model=str(trained_student), batch=3, limit=6
    )
    run = new_run(tmp_path / "select" / "run", "student.temperature=1.0", "student.top_k=50")
    metrics = select.main.__wrapped__(cfg, run)
    finish(run.folder, cfg, metrics=metrics)
    first = (run.folder / "report.json").read_text()
    (reasoning, answer) = json.loads(first)["rows"]
    assert (reasoning["n"], answer["n"]) == (6, 6)
    assert set(answer["families"]) == {"event", "time", "window"}

    # A run that was killed while it wrote samples only the missing responses, in batches of any
    # size, and its results are the same.
    log = run.folder / "answers.jsonl"
    complete = log.read_text()
    rows = [json.loads(line) for line in complete.splitlines()]
    assert len({row["text"] for row in rows if "text" in row}) == 12
    settings = {row["mode"]: row["asked"] for row in rows if "asked" in row}
    items = micro_store.selection("test")
    torn = complete[: len(complete) * 2 // 3]
    log.write_text(torn)
    assert 0 < len(ResponseLog(log, settings, items).responses) < 12
    log.write_text(torn)
    select.main.__wrapped__(replace(cfg, batch=2), run)
    assert (run.folder / "report.json").read_text() == first
    assert log.read_text().startswith(f"{torn}\n")
    lines = [*complete.splitlines(), torn.rpartition("\n")[2]]
    assert sorted(log.read_text().splitlines()) == sorted(lines)

    # Responses are scored again when they are read, and a damaged line counts as missing.
    edited = complete.replace('"right": false', '"right": true').splitlines()
    log.write_text("\n".join([*edited[:4], "{", *edited[5:]]) + "\n")
    responses = ResponseLog(log, settings, items).responses
    assert len(responses) == 11
    letters = {i.item_id: i.letter for i in items}
    assert all(a.right == (a.letter == letters[a.item_id]) for a in responses.values())

    log.write_text(complete)
    shutil.copytree(trained_student, tmp_path / "sft" / "run")
    page = new_run(tmp_path / "report" / "run")
    report.main.__wrapped__(ReportCommand(checkpoints=str(tmp_path), store=store), page)
    html = (page.folder / "report.html").read_text()
    assert all(f'"id": "{item.item_id}"' in html for item in select.limit_items(items, 6, 0))


@pytest.mark.slow
def test_constrained_decoding_yields_records_only(
    trained_student, micro, micro_store, tmp_path, monkeypatch
) -> None:
    # A model with random weights writes texts up to their limits, which are shorter here.
    monkeypatch.setattr(response_schema, "MAX_RATIONALE", 9)
    monkeypatch.setattr(response_schema, "MAX_JUSTIFICATION", 9)
    weights = str(trained_student / "student")
    student = replace(STUDENT, model=weights, architecture=None, max_new_tokens=300, temperature=1)
    cfg = SelectCommand(
        benchmark=micro, student=student, store=str(micro_store.folder.parent), limit=3, batch=2,
        modes=["constrained"],
    )  # fmt: skip
    assert select.main.__wrapped__(cfg, new_run(tmp_path))["constrained_parse_rate"] == 1
    _, *rows = read_json_lines(tmp_path / "answers.jsonl")
    assert len(rows) == 3
    schema = response_schema.build_record_schema()
    for row in rows:
        assert not row["truncated"]
        assert parse_choice(row["text"]).letter == row["letter"]
        # The texts may have control characters, which `strict` would refuse.
        record = json.loads(row["text"], strict=False)
        jsonschema.validate(record, schema)
        assert list(record) == list(schema["properties"])


def test_a_served_base_is_measured_with_and_without_the_prefix(
    micro, micro_store, start_server, tmp_path
) -> None:
    replies = {True: "Answer: C", False: "I cannot tell."}
    server = start_server(lambda request: replies["video_url" in str(request)])
    cfg = SelectCommand(
        benchmark=micro, student=SERVED, server=served_by(server), control="candidate_only",
        limit=12, store=str(micro_store.folder.parent), checkpoints=str(tmp_path),
    )  # fmt: skip
    run = new_run(tmp_path / "select" / "both")
    metrics = select.main.__wrapped__(cfg, run)
    items = select.select_items(micro_store, None, 12, 0)
    right, name = sum(i.letter == "C" for i in items), micro_store.name
    report = json.loads((run.folder / "report.json").read_text())
    rows = from_json(list[SelectionResult], report["rows"])
    assert [(r.benchmark, r.control, r.mode) for r in rows] == [
        (name, control, mode)
        for control in (None, "candidate_only")
        for mode in ("record", "constrained")
    ]
    assert rows[0].micro.value == right / 12
    assert metrics["record_micro"] == metrics["record_parse_rate"] == 0
    assert report["readings"]["record, candidate_only"] == {
        "with a letter": 0, "  in a valid record": 0, "without: refusal": 12,
    }  # fmt: skip
    overall = next(p for p in report["controls"] if p["of"] == "all")
    names = ("mode", "left", "right", "only_left", "only_right", "n")
    found = [overall[name] for name in names]
    assert found == ["record", "unchanged", "candidate_only", right, 0, 12]

    # The same command sends no requests when it is run again, and has the same results. Another
    # control reuses the responses to the unchanged items, and copies them into its own log.
    server.requests.clear()
    assert select.main.__wrapped__(cfg, run) == metrics
    assert not server.requests
    shuffled, other = replace(cfg, control="shuffled_prefix"), new_run(tmp_path / "select" / "x")
    metrics = select.main.__wrapped__(shuffled, other)
    assert len(server.requests) == 24
    shutil.rmtree(run.folder)
    server.requests.clear()
    assert select.main.__wrapped__(shuffled, other) == metrics
    assert not server.requests


def test_a_limit_spreads_over_the_families_or_selects_complete_pairs(benchmark_store) -> None:
    items = benchmark_store.selection()
    few = select.limit_items(items, 6, seed=0)
    assert sorted(i.family for i in few) == ["event"] * 2 + ["time"] * 2 + ["window"] * 2
    assert select.limit_items(items, 6, seed=0) == few
    items = benchmark_store.selection(suite=MATCHED_ANCHOR)
    few = select.limit_items(items, 3, 0)
    [(by_event, by_time)] = pair_items(few)
    assert few == [by_event, by_time]
    assert sorted(select.limit_items(items, len(items), 0), key=items.index) == items
    assert "limit=1" in str(SelectCommand(student=SERVED, suite=MATCHED_ANCHOR, limit=1).check())
    with raises_user_error("no-items", contains=("interventions", "tiny_interventions")):
        select.select_items(benchmark_store, "interventions", None, 0)


@pytest.mark.parametrize(
    ("name", "content", "code"),
    [
        ("metrics.json", None, "unfinished-run"),
        ("config.yaml", "student: [1", "damaged-file"),
        ("config.yaml", "student: {rank: 1}", "damaged-file"),
        ("config.yaml", "retriever: {}", "missing-run"),
        ("run.json", '{"command": "evaluation.select"}', "missing-run"),
    ],
)
def test_a_run_that_cannot_be_measured_is_refused(
    trained_student, tmp_path, name, content, code
) -> None:
    run = shutil.copytree(trained_student, tmp_path / "run")
    with raises_user_error("missing-run", contains=f"student.model={run / 'student'}"):
        read_trained_settings(run / "student", SftCommand, "student")
    (run / name).unlink()
    if content is not None:
        (run / name).write_text(content)
    with raises_user_error(code, contains=str(run)):
        read_trained_settings(run, SftCommand, "student")


def test_a_model_is_not_tested_on_its_training_scenes(trained_student, micro, tmp_path) -> None:
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

    # The folder of a base may have the settings of its training, or a file of another project.
    cfg = SelectCommand(student=StudentConfig(name="x", model=str(tmp_path)))
    trained = OmegaConf.structured(replace(micro, test_share=0.01))
    OmegaConf.save({"benchmark": trained}, tmp_path / "config.yaml")
    resolve_model(cfg, replace(micro, seed=1), SftCommand, "student")
    with raises_user_error("training-scenes-tested", contains=str(tmp_path)):
        resolve_model(cfg, micro, SftCommand, "student")
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
    with raises_user_error("unused-setting", contains="matcher.train"):
        resolve_model(*arguments, ("matcher=clip",), "matcher.model")
