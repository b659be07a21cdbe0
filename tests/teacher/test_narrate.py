"""Runs of the command on a store in memory: resuming, damage, and what servers answer."""

import threading
import time
from dataclasses import replace

import pyarrow.parquet as pq
import pytest

from conf.errors import UserError
from conf.schema import TeacherConfig
from data.records import Rationale
from teacher.grammar import GRAMMAR_VERSION, grammar
from teacher.narrate import ensure_rationales, narrate_store
from teacher.rationale_log import Journal, read_rationales

TEMPLATE = TeacherConfig(name="template")


def lines(store):
    return (store.folder / "rationales.jsonl").read_bytes()


def test_template_narrates_every_training_item_but_short_ones(store):
    narration = narrate_store(store, TEMPLATE)
    assert [r.item_id for r in narration.rationales] == [f"item-{k}" for k in range(13) if k != 5]
    assert (
        narration.summary.too_short,
        narration.summary.set_aside,
        sum(narration.summary.rejected.values()),
    ) == (1, 0, 0)
    before = lines(store)
    assert ensure_rationales(store, TEMPLATE) == narration.rationales
    assert lines(store) == before


@pytest.mark.parametrize("kept", [0, 10, 0.3, 0.5, -1])
def test_a_killed_run_ends_with_the_same_bytes(store, kept):
    narrate_store(store, TEMPLATE)
    whole = lines(store)
    cut = int(kept * len(whole)) if isinstance(kept, float) else kept
    (store.folder / "rationales.jsonl").write_bytes(whole[:cut])
    narrate_store(store, TEMPLATE)
    assert lines(store) == whole


def test_a_damaged_line_is_named(store):
    narrate_store(store, TEMPLATE)
    damaged = lines(store).splitlines(keepends=True)
    damaged[2] = b'{"item_id": "item-2"}\n'
    (store.folder / "rationales.jsonl").write_bytes(b"".join(damaged))
    with pytest.raises(UserError, match=r"rationales\.jsonl, line 3"):
        narrate_store(store, TEMPLATE)


def test_an_edited_line_is_named(store):
    narrate_store(store, TEMPLATE)
    edited = lines(store).replace(b"Scene parse: ", b"Scene parse: There are 3 cubes. ", 1)
    (store.folder / "rationales.jsonl").write_bytes(edited)
    with pytest.raises(UserError, match=r"rationales\.jsonl, line 1: .* changed after it was"):
        narrate_store(store, TEMPLATE)


def test_answers_under_other_settings_are_not_taken(store):
    first = narrate_store(store, TEMPLATE)
    strict = TeacherConfig(name="template", min_words=240, max_words=250, attempts=1)
    assert narrate_store(store, strict).rationales == []
    before = lines(store)
    assert narrate_store(store, TEMPLATE).rationales == first.rationales
    assert lines(store) == before


def test_one_writes_and_the_others_wait(store):
    """As the jobs of a sweep do that start together."""
    narrations = []
    other = threading.Thread(
        target=lambda: narrations.append(narrate_store(store, TEMPLATE)), daemon=True
    )
    with Journal(store.folder / "rationales.jsonl"):
        other.start()
        time.sleep(0.3)
        assert other.is_alive()
    other.join(timeout=120)
    assert narrations[0].rationales == narrate_store(store, TEMPLATE).rationales


def test_rejected_answers_are_kept_and_set_aside(store):
    cfg = TeacherConfig(name="template", min_words=240, max_words=250, attempts=2)
    narration = narrate_store(store, cfg)
    kept = read_rationales(store.folder / "rationales.jsonl")
    assert narration.rationales == []
    assert (narration.summary.set_aside, narration.summary.rejected) == (12, {"too short": 24})
    assert [r.attempt for r in kept[:4]] == [0, 1, 0, 1]


def config(server, **changes):
    settings = {"concurrency": 2, "patience": 5.0, "timeout": 1.0, **changes}
    return TeacherConfig(name="served", url=server.url, model="tiny", **settings)


def told(store):
    return read_rationales(store.folder / "rationales.jsonl")


def test_the_accepted_are_a_parquet_file_too(store, odd):
    path = store.folder / "rationales.parquet"
    narration = narrate_store(store, config(odd("number")))
    rows = pq.read_table(path).to_pylist()
    unclaimed = [replace(r, claims={}) for r in narration.rationales]
    assert [Rationale.from_row(row) for row in rows] == unclaimed
    assert len(rows) == 12
    narrate_store(store, TeacherConfig(name="template", min_words=249))
    assert pq.read_table(path).num_rows == 0


def test_served_answers_are_judged_and_faults_cost_no_attempt(store, odd):
    server = odd(503, "cut", 500, "number")
    narration = narrate_store(store, config(server, samples=1))
    assert [r.item_id for r in narration.rationales] == [f"item-{k}" for k in range(13) if k != 5]
    assert narration.summary.rejected == {"cut off": 1, "number": 1}
    assert narration.summary.too_short == 1
    assert len(server.asked) == 12 + 4
    asked = server.asked[0]
    assert asked["chat_template_kwargs"] == {"enable_thinking": False}
    assert (asked["temperature"], asked["top_p"], asked["top_k"]) == (0.7, 0.8, 20)
    assert "seed" not in asked
    assert "structured_outputs" not in asked


def test_an_answer_under_the_grammar_is_another_answer(store, odd):
    server = odd()
    free, held = config(server), config(server, grammar=True)
    narrate_store(store, free)
    asked = len(server.asked)
    narration = narrate_store(store, held)
    assert len(server.asked) == 2 * asked
    assert server.asked[-1]["structured_outputs"] == {"grammar": grammar(held)}
    assert {r.grammar for r in narration.rationales} == {GRAMMAR_VERSION}
    assert {r.grammar for r in narrate_store(store, free).rationales} == {None}


def test_more_answers_are_asked_for_only_after_a_failure(store, odd):
    server = odd("number")
    narration = narrate_store(store, config(server, concurrency=1, samples=2))
    assert [request["n"] for request in server.asked] == [1, 2] + [1] * 11
    first = [r for r in told(store) if r.item_id == narration.rationales[0].item_id]
    assert [(r.attempt, r.accepted) for r in first] == [(0, False), (1, True), (2, True)]
    assert narration.rationales[0].attempt == 1


def test_no_more_answers_are_asked_for_than_attempts(store, odd):
    server = odd()
    server.always["*"] = "number"
    narration = narrate_store(store, config(server, attempts=4, samples=2))
    assert narration.summary.set_aside == 12
    assert sorted(r.attempt for r in told(store)) == sorted([0, 1, 2, 3] * 12)
    assert sum(request["n"] for request in server.asked) == 48


def test_the_cost_of_a_request_is_that_of_its_answers(store, odd):
    narrate_store(store, config(odd("number"), concurrency=1, samples=3))
    first = [r for r in told(store) if r.item_id == "item-0"]
    assert [r.prompt_tokens for r in first] == [1000, 1000, 0, 0]
    assert first[0].completion_tokens == 101
    assert sum(r.completion_tokens for r in first[1:]) == 303


@pytest.mark.parametrize(
    ("fault", "reason"),
    [("cut", "cut off"), ("empty", "empty"), ("thinking", "thinking"), ("long", "too long")],
)
def test_an_answer_that_is_none_is_rejected_with_its_reason(store, odd, fault, reason):
    narration = narrate_store(store, config(odd(fault)))
    assert narration.summary.rejected == {reason: 1}
    assert len(narration.rationales) == 12
    assert all(len(r.text) <= 20_000 for r in told(store))


def test_half_of_a_surrogate_pair_is_no_trouble(store, odd):
    assert len(narrate_store(store, config(odd("surrogate"))).rationales) == 12
    assert len(pq.read_table(store.folder / "rationales.parquet")) == 12


@pytest.mark.parametrize(
    "fault",
    [
        "reset",
        "hang",
        500,
        408,
        b'{"choices": [{"message": {"content": "\xff\xfe"}}]}',
        b"<html>",
        b"{",
    ],
)
def test_a_request_that_fails_is_asked_again(store, odd, fault):
    server = odd(fault)
    narration = narrate_store(store, config(server))
    assert narration.summary.rejected == {}
    assert len(narration.rationales) == 12
    assert len(server.asked) == 13


def test_an_item_that_no_server_answers_is_set_aside(store, odd):
    server = odd()
    said = next(iter(server.texts))
    server.always[said] = 500
    narration = narrate_store(store, config(server, concurrency=1, attempts=2))
    assert len(narration.rationales) == 11
    assert narration.summary.rejected == {"unanswered": 2}
    assert narration.summary.set_aside == 1


def test_a_killed_served_run_asks_only_for_the_rest(store, odd):
    server = odd()
    narrate_store(store, config(server))
    whole = lines(store).splitlines(keepends=True)
    (store.folder / "rationales.jsonl").write_bytes(b"".join(whole[:7]) + whole[7][:40])
    server.asked.clear()
    narration = narrate_store(store, config(server))
    assert len(server.asked) == len(whole) - 7
    assert len(narration.rationales) == 12


def test_a_finished_served_run_needs_no_server(store, odd):
    store.items = [item for item in store.items if item.item_id != "item-5"]
    server = odd()
    narration = narrate_store(store, config(server))
    server.stop()
    before = lines(store)
    again = narrate_store(store, config(server))
    assert (again.rationales, again.summary) == (narration.rationales, narration.summary)
    assert lines(store) == before


def test_an_unknown_model_is_named_with_those_there(store, odd):
    with pytest.raises(UserError, match=r"teacher\.model=tiny; it has other"):
        narrate_store(store, config(odd(404), concurrency=1))


@pytest.mark.parametrize("status", [400, 403, 422])
def test_a_server_that_refuses_everything_is_told(store, odd, status):
    server = odd()
    server.always["*"] = status
    with pytest.raises(UserError, match=f"{server.url} refuses any request: .*fault"):
        narrate_store(store, config(server))
    assert told(store) == []


def test_an_item_that_is_refused_is_not_asked_again_and_again(store, odd):
    server = odd()
    said = next(iter(server.texts))
    server.always[said] = 400
    narration = narrate_store(store, config(server, attempts=1))
    assert narration.summary.rejected == {"unanswered": 1}
    assert len(narration.rationales) == 11
    assert [r["messages"][-1]["content"] for r in server.asked].count(said) == 1


@pytest.mark.parametrize(
    "reply",
    [b"<html>hello</html>", b"{}", b'{"choices": []}', b"{", b"[]",
     b'{"choices": [{"message": null}]}'],
)  # fmt: skip
def test_a_server_of_another_kind_is_told(store, odd, reply):
    server = odd()
    server.always["*"] = reply
    with pytest.raises(UserError, match="does not answer as an OpenAI-compatible server"):
        narrate_store(store, config(server))
    assert told(store) == []


def test_another_models_answers_are_not_taken(store, odd):
    server = odd()
    narrate_store(store, config(server))
    asked = len(server.asked)
    other = TeacherConfig(name="served", url=server.url, model="other", concurrency=2)
    narrate_store(store, other)
    assert len(server.asked) == 2 * asked


def test_patience_ends_with_the_url(store, odd):
    server = odd()
    url = server.url
    cfg = config(server, patience=0.2)
    server.stop()
    with pytest.raises(UserError, match=url):
        narrate_store(store, cfg)
