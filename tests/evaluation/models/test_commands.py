"""The evaluation commands on a small student and retriever, really asked."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from conf.entry import Run
from conf.errors import UserError
from conf.schema import (
    ArchitectureConfig,
    ContrastiveCommand,
    LoraConfig,
    MatcherConfig,
    ReportCommand,
    RetrieveCommand,
    RetrieverConfig,
    SelectCommand,
    SftCommand,
    StudentConfig,
    TeacherConfig,
)
from evaluation import report, retrieve, select
from evaluation.generators.response_log import ResponseLog
from models import loading
from models.retriever import embedder
from models.trained_runs import check_unseen, resolve_model, trained_settings
from tests.user_errors import raises_user_error
from train.student import dataset

SMALL = ArchitectureConfig(
    hidden=64, layers=1, heads=2, kv_heads=2, feed_forward=64,
    vision_hidden=64, vision_layers=1, vision_heads=2, vision_feed_forward=64,
)  # fmt: skip
RECORD = '{"started": "2026-01-01", "earlier_starts": []}'
SHARED = {
    "architecture": SMALL, "quantization": "none", "lora": LoraConfig(rank=0), "image_size": 96,
}  # fmt: skip


@pytest.fixture(scope="module")
def runs(tmp_path_factory, micro, micro_store) -> Path:
    """checkpoints/ with a finished run of each trainer, as the trainers leave them."""
    root = tmp_path_factory.mktemp("checkpoints")
    student = StudentConfig(name="small", max_length=1500, max_new_tokens=12, **SHARED)
    sft = SftCommand(benchmark=micro, teacher=TeacherConfig(name="template"), student=student)
    folder = root / "sft" / "run"
    folder.mkdir(parents=True)
    model, processor = loading.load_student(
        student, "bf16", lambda: dataset.tokenizer_corpus(micro_store, [])
    )
    loading.save_student(model, processor, folder / "student", "bf16")
    OmegaConf.save(OmegaConf.structured(sft), folder / "config.yaml")
    (folder / "metrics.json").write_text('{"answer_loss": 1.0, "answer_loss_at_start": 2.0}')
    (folder / "run.json").write_text(RECORD)

    cfg = RetrieverConfig(name="small", widths=[64, 32], **SHARED)
    folder = root / "contrastive" / "run"
    folder.mkdir(parents=True)
    texts = embedder.tokenizer_texts(micro_store.retrieval("train"), cfg)
    built = embedder.load_retriever(cfg, "fp32", texts, folder / "untrained")
    built.save_pretrained(str(folder / "retriever"), create_model_card=False)
    settings = ContrastiveCommand(benchmark=micro, retriever=cfg)
    OmegaConf.save(OmegaConf.structured(settings), folder / "config.yaml")
    (folder / "metrics.json").write_text("{}")
    (folder / "run.json").write_text(RECORD)
    return root


def run_in(root: Path, kind: str, name: str = "run") -> Run:
    folder = root / kind / name
    folder.mkdir(parents=True, exist_ok=True)
    return Run(name, folder)


def finish(run: Run, settings: object, metrics: dict) -> None:
    """Write what a command's entry does around it."""
    OmegaConf.save(OmegaConf.structured(settings), run.folder / "config.yaml")
    (run.folder / "metrics.json").write_text(json.dumps(metrics))
    (run.folder / "run.json").write_text(RECORD)


@pytest.mark.slow
def test_students_and_retrievers_are_measured_and_reported(runs, micro, micro_store) -> None:
    store = str(micro_store.folder.parent)
    asked = SelectCommand(
        benchmark=micro, student=StudentConfig(name="unused", model="unused"), store=store,
        model=str(runs / "sft" / "run"), batch=4, limit=8,
    )  # fmt: skip
    run = run_in(runs, "select")
    metrics = select.main.__wrapped__(asked, run)
    finish(run, asked, metrics)
    told = (run.folder / "report.json").read_text()
    (reasoning, answer) = json.loads(told)["rows"]
    assert (reasoning["n"], answer["n"]) == (8, 8)
    assert set(answer["families"]) == {"event", "time", "window"}
    assert "paper" in (run.folder / "report.txt").read_text()

    # Killed in the middle of a line, it asks again only what was lost, and says the same.
    log = run.folder / "answers.jsonl"
    whole = log.read_text()
    torn = whole[: len(whole) * 2 // 3]
    log.write_text(torn)
    heads = [json.loads(line) for line in whole.splitlines()[:2]]
    known = {head["mode"]: head["asked"] for head in heads}
    assert 0 < len(ResponseLog(log, known, micro_store.selection("test")).answers) < 16
    select.main.__wrapped__(asked, run)
    assert (run.folder / "report.json").read_text() == told
    assert log.read_text().startswith(f"{torn}\n")
    lines = [*whole.splitlines(), torn.rpartition("\n")[2]]
    assert sorted(log.read_text().splitlines()) == sorted(lines)

    # What is right is judged anew, and a damaged line is asked again.
    items = micro_store.selection("test")
    edited = whole.replace('"right": false', '"right": true').splitlines()
    log.write_text("\n".join([*edited[:4], "{", *edited[5:]]) + "\n")
    kept = ResponseLog(log, known, items).answers
    assert len(kept) == 15
    rights = {i.item_id: i.letter for i in items}
    assert all(a.right == (a.letter == rights[a.item_id]) for a in kept.values())
    log.write_text(whole)

    # Answers of other weights are not taken for these.
    others = {mode: {**what, "model": "another"} for mode, what in known.items()}
    assert not ResponseLog(log, others, items).answers

    # A base is asked for the record; drawn answers are the same after a kill.
    drawn = replace(
        asked, model=None, modes=["record"], batch=3, seed=5,
        student=replace(trained_settings(runs / "sft" / "run", SftCommand, "student").student,
                        model=str(runs / "sft" / "run" / "student"), architecture=None,
                        temperature=1.0, top_k=50),
    )  # fmt: skip
    run = run_in(runs, "drawn")
    assert set(select.main.__wrapped__(drawn, run)) >= {"record_micro", "record_parse_rate"}
    log = run.folder / "answers.jsonl"
    whole = log.read_text()
    torn = whole[: len(whole) * 2 // 3]
    log.write_text(torn)
    select.main.__wrapped__(replace(drawn, batch=2), run)
    lines = [*whole.splitlines(), torn.rpartition("\n")[2]]
    assert sorted(log.read_text().splitlines()) == sorted(lines)
    texts = {json.loads(line)["text"] for line in whole.splitlines()[1:]}
    assert len(texts) == 8

    ranked = RetrieveCommand(
        benchmark=micro, retriever=RetrieverConfig(name="unused", model="unused"), store=store,
        model=str(runs / "contrastive" / "run"), batch=16,
    )  # fmt: skip
    run = run_in(runs, "retrieve")
    metrics = retrieve.main.__wrapped__(ranked, run)
    finish(run, ranked, metrics)
    rows = json.loads((run.folder / "report.json").read_text())["rows"]
    groups = 1 + len({q.builder for q in micro_store.standard_test()})
    assert [r["width"] for r in rows] == [64, 32] * 2 * groups
    # This "trained" one was saved untrained: both must rank alike.
    for trained, untrained in zip(rows[: 2 * groups], rows[2 * groups :], strict=True):
        assert trained["mrr"]["value"] == pytest.approx(untrained["mrr"]["value"], rel=0.05)
        assert trained["builder"] == untrained["builder"]
        assert trained["frames"] == len(micro_store.database())
    assert metrics["recall@10"] == rows[0]["recall_10"]["value"]
    assert set(metrics) == {"recall@1", "recall@10", "recall@50", "mrr", "median_rank"}

    page = run_in(runs, "report")
    report.main.__wrapped__(ReportCommand(checkpoints=str(runs), store=store), page)
    text = (page.folder / "report.txt").read_text()
    assert "answer loss" in text
    assert "untrained small" in text
    shown = (page.folder / "report.html").read_text()
    assert all(f'"id":"{item.item_id}"' in shown for item in select.limit_items(items, 8, 0))


def test_a_model_that_is_no_run_is_named(tmp_path) -> None:
    with raises_user_error("missing-run"):
        trained_settings(tmp_path / "nowhere", SftCommand, "student")


@pytest.mark.parametrize(
    ("damage", "code"),
    [
        (lambda run: (run / "metrics.json").unlink(), "unfinished-run"),
        (lambda run: (run / "config.yaml").write_text("student: [1"), "damaged-file"),
        (lambda run: (run / "config.yaml").write_text(""), "missing-run"),
        (lambda run: (run / "config.yaml").write_text("student: {rank: 1}"), "damaged-file"),
        (lambda run: (run / "config.yaml").write_text("retriever: {}"), "missing-run"),
    ],
)
def test_a_run_that_cannot_be_measured_is_refused(runs, tmp_path, damage, code) -> None:
    shutil.copytree(runs / "sft" / "run", tmp_path / "run")
    damage(tmp_path / "run")
    with raises_user_error(code):
        trained_settings(tmp_path / "run", SftCommand, "student")


def test_a_model_is_not_tested_on_scenes_that_it_may_have_seen(runs, micro) -> None:
    cfg = SelectCommand(model=str(runs / "sft" / "run"))
    unseen = {"seed": 1, "test_share": 0.9}
    for same in ({}, unseen, {"scenes": 99}, {"test_share": 0.01}):
        benchmark = replace(micro, **same)
        assert resolve_model(cfg, benchmark, SftCommand, "student")[0] == runs / "sft" / "run"
    with raises_user_error("training-scenes-tested", contains="test_share=0.9"):
        resolve_model(cfg, replace(micro, test_share=0.9), SftCommand, "student")
    # Another seed splits the same release anew.
    release = replace(micro, simulator="clevrer", folder="/release")
    check_unseen("model", release, replace(release, folder="/other", seed=1))
    with raises_user_error("training-scenes-tested", contains="seed=1"):
        check_unseen("model", release, replace(release, seed=1))


def test_what_a_run_is_asked_otherwise_is_taken_or_refused(runs, micro) -> None:
    model = runs / "sft" / "run"
    cfg = SelectCommand(
        model=str(model), student=StudentConfig(name="x", temperature=0.7, frames=2)
    )
    typed = ("modes=[answer]", "student.temperature=0.7")
    _, settings = resolve_model(cfg, micro, SftCommand, "student", typed)
    assert settings.student.temperature == 0.7
    # What was not typed is the preset's, and not the run's.
    assert (
        settings.student.frames
        == trained_settings(model, SftCommand, "student").student.frames
        != 2
    )
    for refused in ("student=qwen3_vl_8b", "student.lora.rank=8", "++train.regime=cot"):
        with raises_user_error("unused-setting", contains="student.temperature"):
            resolve_model(cfg, micro, SftCommand, "student", (*typed, refused))
    matcher = MatcherConfig(model=str(runs / "contrastive" / "run"))
    given = (matcher, micro, ContrastiveCommand, "retriever")
    resolve_model(*given, ("student.frames=2", "matcher.model=RUN"), "matcher.model")
    for refused in ("matcher=clip", "matcher.retriever.image_size=64"):
        with raises_user_error("unused-setting", contains="matcher.train"):
            resolve_model(*given, (refused,), "matcher.model")


def test_a_torn_model_is_named(runs, tmp_path) -> None:
    folder = tmp_path / "student"
    shutil.copytree(runs / "sft" / "run" / "student", folder)
    weights = folder / "model.safetensors"
    weights.write_bytes(weights.read_bytes()[:1000])
    cfg = StudentConfig(name="small", max_length=1500, **SHARED)
    with pytest.raises(UserError, match="cannot be loaded from that folder"):
        loading.load_trained(cfg, "bf16", folder)
    shutil.copytree(runs / "contrastive" / "run" / "retriever", tmp_path / "retriever")
    (tmp_path / "retriever" / "model.safetensors").write_bytes(b"{")
    cfg = RetrieverConfig(name="small", widths=[64, 32], **SHARED)
    with pytest.raises(UserError, match="is damaged and cannot be read"):
        embedder.load_trained(cfg, "bf16", tmp_path / "retriever")


def test_nothing_to_report_says_what_to_run_first(tmp_path) -> None:
    with pytest.raises(UserError, match=r"evaluation\.select"):
        report.main.__wrapped__(ReportCommand(checkpoints=str(tmp_path)), Run("x", tmp_path))


def test_a_report_of_another_version_is_named(tmp_path) -> None:
    run = run_in(tmp_path, "retrieve")
    finish(run, RetrieveCommand(), {})
    (run.folder / "report.json").write_text('{"rows": [{"name": "old", "mrr": 0.5}]}')
    with pytest.raises(UserError, match="damaged or of another version: delete"):
        report.main.__wrapped__(ReportCommand(checkpoints=str(tmp_path)), Run("x", tmp_path))


def test_a_limit_spreads_over_the_families(micro_store) -> None:
    items = micro_store.selection()
    few = select.limit_items(items, 6, seed=0)
    assert sorted(i.family for i in few) == ["event"] * 2 + ["time"] * 2 + ["window"] * 2
    assert select.limit_items(items, 6, seed=0) == few
    assert select.limit_items(items, None, seed=0) == items
