"""The report of a narration: its figures, compared with counts by hand, and its HTML page."""

import json
import re
from dataclasses import replace

import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.data.records import Rationale
from dynapix.teacher.narrate import narrate_store
from dynapix.teacher.predicates.vocabulary import name_vocabulary
from dynapix.teacher.report import (
    describe_sufficiency,
    format_figures,
    name_teacher,
    summarize,
    write_report,
)
from tests.teacher import synthetic

ITEMS = [synthetic.item((60, 80, 100, 120), item_id=f"item-{k}") for k in range(5)]


def response(k, attempt, text="A red cube rests.", reasons=(), **fields):
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


def figures_of(*responses):
    by_item = {}
    for r in responses:
        by_item.setdefault(r.item_id, []).append(r)
    return summarize(ITEMS, by_item)


def test_figures_equal_counts_by_hand():
    figures = figures_of(
        response(0, 0, "The red metal cube rests here. The red metal cube stays."),
        response(1, 0, reasons=["number: 'two'", "number: 'half'", "too short"]),
        response(1, 1, "The blue rubber cube rests here. The blue rubber cube stays."),
        response(2, 0, reasons=["number: 'six'"]),
        response(2, 1, reasons=["wrong answer: B"]),
        response(3, 0, "The red metal cube rests here. The red metal cube stays."),
    )
    items = [figures[key] for key in ("items", "accepted", "set_aside", "too_short")]
    assert items == [5, 3, 1, 1]
    assert (figures["responses"], figures["accepted_responses"]) == ([4, 2], [2, 1])
    assert figures["rejected"] == {"number": 2, "too short": 1, "wrong answer": 1}
    assert figures["examples"]["number"] == [("item-1", "'two'"), ("item-2", "'six'")]
    assert figures["lengths"] == [11, 11, 11]
    assert figures["requests"] == 0


def test_sufficiency_is_a_mean_by_family_and_difficulty():
    kinds = [("event", None), ("window", "easy"), ("window", "hard"), ("window", "hard")]
    items = [
        replace(item, family=family, difficulty=difficulty)
        for item, (family, difficulty) in zip(ITEMS, kinds, strict=False)
    ]
    responses = [
        response(k, 0, sufficiency=value, undecided=value == 0.25)
        for k, value in enumerate((1.0, 1.0, 0.25, 0.5))
    ]
    figures = summarize(items, {r.item_id: [r] for r in responses})
    assert figures["sufficiency"] == {
        "all": [0.6875, 0.5, 4],
        "event": [1, 1, 1],
        "window": [pytest.approx(1.75 / 3), pytest.approx(1 / 3), 3],
        "window, easy": [1, 1, 1],
        "window, hard": [0.375, 0, 2],
    }
    assert figures["undecided"] == 1


def test_claims_are_summed_and_shown_as_shares():
    figures = figures_of(
        response(0, 0, claims={"direction": [3, 0, 1]}),
        response(1, 0, claims={"direction": [1, 1, 2], "speed": [2, 0, 0]}),
    )
    assert figures["claims"] == {"direction": [4, 1, 3], "speed": [2, 0, 0]}
    lines = format_figures(figures).splitlines()
    line = next(line for line in lines if line.startswith("direction"))
    assert line.split()[1:] == ["8", "50.0%", "12.5%", "37.5%"]


def test_long_pauses_between_responses_are_not_counted_as_hours():
    times = [100.0, 101.0, 103.0, 5000.0, 5001.0]
    figures = figures_of(
        *(
            # The servers count a prompt once, with the first of several responses to it.
            response(k, 0, finished=time, prompt_tokens=50 * (k % 2 == 0), completion_tokens=20)
            for k, time in enumerate(times)
        )
    )
    assert figures["hours"] * 3600 == pytest.approx(4)
    assert (figures["requests"], figures["prompt_tokens"]) == (3, 150)
    assert figures["completion_tokens"] == 100
    assert "25 tokens/s" in format_figures(figures)


def test_figures_without_responses():
    figures = figures_of()
    assert figures["accepted"] == 0
    assert describe_sufficiency(figures).startswith("sufficiency none (0 items")
    rejected = figures_of(response(0, 0, reasons=["empty"], claims={"speed": [0, 0, 0]}))
    for text in (format_figures(figures), format_figures(rejected)):
        assert not re.search(r"\bnan\b", text, re.IGNORECASE)


def test_page_shows_accepted_and_rejected_texts_beside_their_frames(micro_store, tmp_path):
    cfg = TeacherConfig(name="template & co")
    narration = narrate_store(micro_store, cfg)
    figures = narration.figures
    accepted = {r.item_id for r in narration.rationales}
    item_id = min(accepted)
    text = "The <b>cube</b> is first."
    failed = replace(
        narration.responses[item_id][0], accepted=False, text=text, reasons=("number: 'first'",)
    )
    responses = {**narration.responses, item_id: [failed, *narration.responses[item_id]]}

    def write(responses, seed):
        shown = replace(cfg, seed=seed)
        return write_report(micro_store, responses, figures, 4, shown, tmp_path).read_text()

    page = write(responses, 0)
    written = (tmp_path / "report.txt").read_text()
    teacher = "template & co (the built-in narrator)"
    head = f"teacher: {teacher}\npredicates: {name_vocabulary(cfg)}\n"
    assert written == f"{head}{format_figures(figures)}\n"
    report = json.loads((tmp_path / "report.json").read_text())
    assert (report["accepted"], report["teacher"]) == (len(accepted), teacher)
    assert "template &amp; co (the built-in narrator)" in page
    images = re.findall(r'src="(images/[^"]+\.png)"', page)
    assert len(set(images)) == 4
    assert all((tmp_path / image).read_bytes().startswith(b"\x89PNG") for image in images)
    # The only item with a rejected response is shown, after its accepted response.
    assert page.count('class="rejected"') == 1
    article = page[page.index(f'id="{item_id}"') :]
    shown = ['class="accepted"', 'class="rejected"', "number: &#39;first&#39;", "The &lt;b&gt;cube"]
    places = [article.index(part) for part in shown]
    assert places == sorted(places)
    assert places[-1] < article.index("</article>")
    assert write(responses, 1) != page
    assert "0 of" in write({}, 0)


def test_page_names_the_model_and_the_servers_of_a_teacher():
    url = ["http://a/v1", "http://b/v1"]
    cfg = TeacherConfig(name="mine", model="Qwen/Qwen3-32B", url=url)
    assert name_teacher(cfg) == "mine (Qwen/Qwen3-32B at http://a/v1, http://b/v1)"


def test_figures_name_constraints_samples_and_unanswered_items():
    responses = {f"item-{k}": [response(k, 0, grammar="2" if k else None)] for k in range(3)}
    figures = summarize(ITEMS, responses, {"item-3": "refused"}, "4 of 9 items, seed 0")
    assert figures["constraints"] == {"none": 1, "grammar 2": 2}
    assert (figures["unanswered"], figures["set_aside"], figures["too_short"]) == (1, 0, 1)
    text = format_figures(figures)
    assert "sample: 4 of 9 items, seed 0" in text
    assert "constraint: none (1 responses), grammar 2 (2 responses)" in text
