"""The report on a teacher's answers: its figures by hand, and its page in files."""

import json
import os
import re
from dataclasses import replace

import pytest

from conf.schema import TeacherConfig
from data.records import Rationale
from teacher.narrate import ensure_report, narrate_store
from teacher.report.page import write_page
from teacher.report.summary import summarise
from tests.teacher import synthetic

ITEMS = [synthetic.item((60, 80, 100, 120), item_id=f"item-{k}") for k in range(5)]


def answer(k, attempt, text="A red cube rests.", reasons=(), **fields):
    return Rationale(
        item_id=f"item-{k}",
        attempt=attempt,
        accepted=not reasons,
        text=text,
        answer="A",
        teacher="made",
        prompt_version="1",
        validator_version="1",
        settings="",
        seed=0,
        reasons=tuple(reasons),
        **fields,
    )


def summary_of(answers, **changes):
    by_item = {}
    for given in answers:
        by_item.setdefault(given.item_id, []).append(given)
    return summarise(ITEMS, by_item, **{"attempts": 2, "too_short": 1, **changes})


def test_every_figure_is_counted():
    summary = summary_of(
        [
            answer(0, 0, "The red metal cube rests here. The red metal cube stays."),
            answer(1, 0, reasons=["number: 'two'", "number: 'half'", "too short"]),
            answer(1, 1, "The blue rubber cube rests here. The blue rubber cube stays."),
            answer(2, 0, reasons=["number: 'six'"]),
            answer(2, 1, reasons=["wrong answer: B"]),
            answer(3, 0, "The red metal cube rests here. The red metal cube stays."),
        ]
    )
    assert (summary.items, summary.accepted, summary.set_aside, summary.too_short) == (5, 3, 1, 1)
    assert (summary.asked, summary.accepted_at) == ((4, 2), (2, 1))
    assert summary.rejected == {"number": 2, "too short": 1, "wrong answer": 1}
    assert summary.reasons["number"].examples == (("item-1", "'two'"), ("item-2", "'six'"))
    assert summary.lengths == (11, 11, 11)
    assert (summary.vocabulary.words, summary.vocabulary.distinct) == (33, 9)
    assert summary.vocabulary.common[:2] == (("the", 6), ("cube", 6))
    assert (summary.same_text, summary.same_but_names) == (1, 2)
    assert summary.cost is None
    assert json.loads(json.dumps(summary.to_dict()))["accepted"] == 3


def test_claims_are_added_up_and_told_as_shares():
    summary = summary_of(
        [
            answer(0, 0, claims={"direction": [3, 0, 1]}),
            answer(
                1,
                0,
                reasons=["contradicts: x"],
                claims={"direction": [1, 1, 2], "speed": [2, 0, 0]},
            ),
        ]
    )
    assert summary.claims == {"direction": (4, 1, 3), "speed": (2, 0, 0)}
    line = next(line for line in summary.text().splitlines() if line.startswith("direction"))
    assert line.split()[1:] == ["8", "50.0%", "12.5%", "37.5%"]


def test_a_server_that_pauses_costs_nothing():
    times = [100.0, 101.0, 103.0, 5000.0, 5001.0]
    summary = summary_of(
        [
            answer(k, 0, finished=time, prompt_tokens=50, completion_tokens=20)
            for k, time in enumerate(times)
        ]
    )
    assert summary.cost.hours * 3600 == pytest.approx(4)
    assert (summary.cost.requests, summary.cost.prompt_tokens) == (5, 250)
    assert summary.cost.completion_tokens == 100
    assert "25 tokens a second" in summary.text()


def test_nothing_answered_is_a_report_too():
    summary = summary_of([])
    assert summary.accepted == 0
    assert "none" in summary.text()


def test_the_page_shows_rationales_beside_their_frames(micro_store, tmp_path):
    cfg = TeacherConfig(name="template & co")
    narration = narrate_store(micro_store, cfg)
    told = narration.summary.text()
    page = write_page(micro_store, narration.rationales, told, 4, 0, tmp_path).read_text()
    assert "template &amp; co" in page
    pictures = re.findall(r'src="(shown/[^"]+\.png)"', page)
    assert len(set(pictures)) == 4
    assert all((tmp_path / picture).read_bytes().startswith(b"\x89PNG") for picture in pictures)
    other = write_page(micro_store, narration.rationales, told, 4, 1, tmp_path).read_text()
    assert other != page
    assert write_page(micro_store, narration.rationales, told, 4, 0, tmp_path).read_text() == page
    nobody = write_page(micro_store, [], told, 4, 0, tmp_path).read_text()
    assert "0 of" in nobody


def test_a_report_older_than_the_last_answer_is_written_anew(micro_store, tmp_path):
    """Such a report is what a run leaves that is killed between its last answer and its report."""
    narration = narrate_store(micro_store, TeacherConfig(name="template"))
    page = tmp_path / "report.html"
    assert ensure_report(micro_store, narration, 2, tmp_path)["accepted"] > 0
    whole = page.read_bytes()
    page.write_bytes(b"kept")
    ensure_report(micro_store, narration, 2, tmp_path)
    assert page.read_bytes() == b"kept"
    answered = (micro_store.folder / "rationales.jsonl").stat().st_mtime
    os.utime(page, (answered - 1, answered - 1))
    ensure_report(micro_store, narration, 2, tmp_path)
    assert page.read_bytes() == whole


def test_a_fallback_is_marked_and_only_taken_when_asked_for(store, odd):
    """Every answer of the server is a number, so each item is set aside."""
    server = odd(*["number"] * 40)
    cfg = TeacherConfig(name="served", url=server.url, model="tiny", attempts=2, samples=1)
    aside = narrate_store(store, cfg)
    assert (aside.rationales, aside.summary.set_aside) == ([], 12)
    asked = len(server.asked)
    told = narrate_store(store, replace(cfg, fallback=True))
    assert len(server.asked) == asked
    assert (len(told.rationales), told.summary.fallback, told.summary.set_aside) == (12, 12, 0)
    assert all(r.fallback and r.teacher == "served" for r in told.rationales)
    assert told.summary.asked == aside.summary.asked
    assert "built-in narrator instead" in told.summary.text()
    assert narrate_store(store, replace(cfg, fallback=True)).rationales == told.rationales
    assert narrate_store(store, cfg).rationales == []
