"""evaluation.select under controls and on matched-anchor pairs, with a local chat server."""

from __future__ import annotations

import json
import shutil
from dataclasses import replace
from pathlib import Path

import pytest

from dynapix.conf.entry import Run
from dynapix.conf.schema import BenchmarkConfig, SelectCommand, ServerConfig, StudentConfig
from dynapix.conf.schema.benchmark import MATCHED_ANCHOR
from dynapix.data.items.controls import pair_items
from dynapix.evaluation import select
from dynapix.evaluation.generators.response_log import score_response
from dynapix.evaluation.metrics.results import SelectionResult, from_json
from dynapix.evaluation.metrics.selection import Choices, build_selection_report
from dynapix.evaluation.select import write_report
from dynapix.models.student.responses import GeneratedText
from tests.user_errors import raises_user_error

STUDENT = StudentConfig(name="any", model="any", image_size=96, max_length=1500, max_new_tokens=40)


@pytest.fixture
def command(micro, micro_store):
    def settings(server, **changes) -> SelectCommand:
        served = ServerConfig(
            url=[server.url], model="served", unreachable_timeout=5.0, timeout=10.0
        )
        shared = {"benchmark": micro, "student": STUDENT, "modes": ["answer"], "server": served}
        return SelectCommand(store=str(micro_store.folder.parent), **{**shared, **changes})

    return settings


def parts_of(request) -> list[dict]:
    return request["messages"][0]["content"]


def test_candidate_only_is_compared_with_the_unchanged_items(
    command, micro_store, start_server, tmp_path
) -> None:
    def reply(request) -> str:
        return "Answer: C" if any(p["type"] == "video_url" for p in parts_of(request)) else "B"

    server = start_server(reply)
    cfg = command(server, control="candidate_only", limit=12)
    metrics = select.main.__wrapped__(cfg, Run("x", tmp_path))
    items = select.select_items(micro_store, None, 12, 0)
    plain, control = (sum(i.letter == x for i in items) for x in "CB")
    report = json.loads((tmp_path / "report.json").read_text())
    name = micro_store.name
    rows = from_json(list[SelectionResult], report["rows"])
    assert [(r.benchmark, r.control, r.mode) for r in rows] == [
        (name, None, "answer"), (name, "candidate_only", "answer"),
    ]  # fmt: skip
    assert metrics["answer_micro"] == rows[1].micro.value == control / 12
    overall = next(p for p in report["controls"] if p["of"] == "all")
    assert (overall["mode"], overall["left"], overall["right"]) == (
        "answer", "unchanged", "candidate_only",
    )  # fmt: skip
    assert (overall["only_left"], overall["only_right"], overall["n"]) == (plain, control, 12)
    assert overall["difference"] == pytest.approx((plain - control) / 12)
    text = (tmp_path / "report.txt").read_text()
    assert "answer: unchanged (left) minus candidate_only (right)" in text
    assert "any base (answer, candidate_only)" in text

    # The same command sends no requests when it is run again, and has the same results.
    server.requests.clear()
    assert select.main.__wrapped__(cfg, Run("x", tmp_path)) == metrics
    assert not server.requests
    assert json.loads((tmp_path / "report.json").read_text()) == report


def test_responses_of_other_runs_are_reused(command, micro_store, start_server, tmp_path) -> None:
    server = start_server(lambda _: "Answer: C")
    cfg = command(server, limit=12, checkpoints=str(tmp_path))
    select.main.__wrapped__(cfg, Run("x", folder(tmp_path, "x")))
    server.requests.clear()
    control = replace(cfg, control="candidate_only")
    metrics = select.main.__wrapped__(control, Run("y", folder(tmp_path, "y")))
    assert len(server.requests) == 12
    assert not any(
        p["type"] == "video_url" for request in server.requests for p in parts_of(request)
    )
    # The reused responses were copied into the log of the second run.
    shutil.rmtree(tmp_path / "select" / "x")
    server.requests.clear()
    assert select.main.__wrapped__(control, Run("y", folder(tmp_path, "y"))) == metrics
    assert not server.requests
    # Responses to other settings are not reused.
    other = replace(control, student=replace(STUDENT, max_new_tokens=30), modes=["record"])
    select.main.__wrapped__(other, Run("z", folder(tmp_path, "z")))
    assert len(server.requests) == 24


def folder(root: Path, name: str) -> Path:
    (made := root / "select" / name).mkdir(parents=True, exist_ok=True)
    return made


def test_the_questions_of_a_matched_pair_are_compared(benchmark_store, tmp_path) -> None:
    items = benchmark_store.selection(suite=MATCHED_ANCHOR)
    texts = {"event": "Answer: A", "time": "Answer: B"}
    answers = [score_response(i, "answer", GeneratedText(texts[i.family])) for i in items]
    choices = [
        Choices.from_answers("one", "answer", control, answers)
        for control in (None, "candidate_only")
    ]
    report = build_selection_report(choices, items, "any", "any", 0, MATCHED_ANCHOR)
    write_report(report, tmp_path, MATCHED_ANCHOR)
    _, result = report.rows
    controls = json.loads((tmp_path / "report.json").read_text())["controls"]
    letters = [by_event.letter for by_event, _ in pair_items(items)]
    matched = [p for p in controls if p["left"] == "event"]
    assert [p["mode"] for p in matched] == ["answer", "answer, candidate_only"]
    for p in matched:
        assert (p["right"], p["of"], p["n"]) == ("time", "all", len(letters))
        assert (p["only_left"], p["only_right"]) == (letters.count("A"), letters.count("B"))
        assert p["left_accuracy"] == result.families["event"].value
        assert p["right_accuracy"] == result.families["time"].value
    # Equal responses have no difference.
    assert {p["difference"] for p in controls if p["left"] != "event"} == {0}


def test_a_limit_selects_complete_pairs(benchmark_store) -> None:
    items = benchmark_store.selection(suite=MATCHED_ANCHOR)
    assert len(items) == 2 * len(pair_items(items))
    few = select.limit_items(items, 3, 0)
    [(by_event, by_time)] = pair_items(few)
    assert few == [by_event, by_time]
    assert sorted(select.limit_items(items, len(items), 0), key=items.index) == items


def test_a_limit_below_a_pair_is_refused() -> None:
    cfg = SelectCommand(
        benchmark=BenchmarkConfig(name="any"), student=STUDENT, suite=MATCHED_ANCHOR, limit=1
    )
    (problem,) = cfg.check()
    assert problem.startswith("limit=1 with suite=matched_anchor:")


@pytest.mark.parametrize(
    ("suite", "hint"), [("physion", "physion"), (MATCHED_ANCHOR, "selection.matched.test")]
)
def test_a_suite_that_a_benchmark_lacks_is_refused(micro_store, suite, hint) -> None:
    with raises_user_error("no-items", contains=(suite, hint)):
        select.select_items(micro_store, suite, None, 0)
