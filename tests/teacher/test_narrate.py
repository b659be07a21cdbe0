"""Narration of a benchmark in memory: resuming, damaged files, and faulty servers."""

import threading
from dataclasses import replace

import numpy as np
import pyarrow.parquet as pq
import pytest

from dynapix.conf.schema import TeacherConfig
from dynapix.data.records import Rationale
from dynapix.teacher.journal import Journal, read_rationales
from dynapix.teacher.narrate import ensure_rationales, narrate_store
from dynapix.teacher.narrator import NARRATOR_VERSION
from dynapix.teacher.predicates.vocabulary import name_vocabulary
from dynapix.teacher.sections import GRAMMAR, GRAMMAR_VERSION
from tests.teacher import synthetic
from tests.teacher.faulty_server import teacher_at
from tests.teacher.memory_store import make_store
from tests.user_errors import raises_user_error
from tests.waiting import wait_until

TEMPLATE = TeacherConfig(name="template")
NARRATED = [f"item-{k}" for k in range(13) if k != 5]


def journal_path(store):
    return store.folder / "rationales.jsonl"


def test_narrator_writes_all_training_items_except_those_with_too_short_a_prefix(store):
    narration = narrate_store(store, TEMPLATE)
    assert [r.item_id for r in narration.rationales] == NARRATED
    figures = narration.figures
    assert (figures["too_short"], figures["set_aside"], figures["rejected"]) == (1, 0, {})
    before = journal_path(store).read_bytes()
    assert ensure_rationales(store, TEMPLATE) == narration.rationales
    assert journal_path(store).read_bytes() == before


@pytest.mark.parametrize("kept", [0, 10, 0.3, 0.5, -1])
def test_killed_run_resumes_to_the_same_bytes(store, kept):
    """`kept` is the share (between 0 and 1) or the number of bytes left of the journal."""
    narrate_store(store, TEMPLATE)
    complete = journal_path(store).read_bytes()
    stop = int(kept * len(complete)) if 0 < kept < 1 else kept
    journal_path(store).write_bytes(complete[:stop])
    narrate_store(store, TEMPLATE)
    assert journal_path(store).read_bytes() == complete


@pytest.mark.parametrize(
    "spoil",
    [
        lambda line: b'{"item_id": "item-2"}\n',
        lambda line: line.replace(b"Scene parse: ", b"Scene parse: There are 3 cubes. "),
    ],
)
def test_damaged_or_edited_line_is_reported(store, spoil):
    narrate_store(store, TEMPLATE)
    lines = journal_path(store).read_bytes().splitlines(keepends=True)
    lines[2] = spoil(lines[2])
    journal_path(store).write_bytes(b"".join(lines))
    with raises_user_error("damaged-file", contains=("rationales.jsonl", "line 3")):
        narrate_store(store, TEMPLATE)


def test_journal_of_another_benchmark_is_refused(store):
    narrate_store(store, TEMPLATE)
    store.items[0] = synthetic.item((60, 80, 100, 120), item_id="other", scene_id="s0")
    with raises_user_error("other-data", contains="item-0"):
        narrate_store(store, TEMPLATE)


def test_items_are_set_aside_only_under_the_settings_that_reject_their_responses(store):
    first = narrate_store(store, TEMPLATE)
    strict = narrate_store(store, replace(TEMPLATE, min_words=240, attempts=2))
    assert strict.rationales == []
    assert (strict.figures["set_aside"], strict.figures["rejected"]) == (12, {"too short": 24})
    assert [r.attempt for r in read_rationales(journal_path(store))[12:16]] == [0, 1, 0, 1]
    before = journal_path(store).read_bytes()
    assert narrate_store(store, TEMPLATE).rationales == first.rationales
    assert journal_path(store).read_bytes() == before


def test_second_writer_waits_for_the_journal(store, caplog):
    """Jobs of a sweep that start together may narrate the same benchmark."""
    caplog.set_level("INFO")
    narrations = []
    other = threading.Thread(
        target=lambda: narrations.append(narrate_store(store, TEMPLATE)), daemon=True
    )
    with Journal(journal_path(store)):
        other.start()
        wait_until(lambda: "another process is writing" in caplog.text)
    other.join(timeout=120)
    assert narrations[0].rationales == narrate_store(store, TEMPLATE).rationales


def test_accepted_rationales_are_saved_as_parquet(store, start_server):
    path = store.folder / "rationales.parquet"
    narration = narrate_store(store, teacher_at(start_server("number")))
    rows = pq.read_table(path).to_pylist()
    without_claims = [replace(r, claims={}) for r in narration.rationales]
    assert [Rationale.from_row(row) for row in rows] == without_claims
    assert len(rows) == 12
    narrate_store(store, TeacherConfig(name="template", min_words=249))
    assert pq.read_table(path).num_rows == 0


def test_server_faults_cost_no_attempt(store, start_server):
    server = start_server(503, "cut", 500, "number")
    narration = narrate_store(store, teacher_at(server, samples=1))
    assert [r.item_id for r in narration.rationales] == NARRATED
    assert narration.figures["rejected"] == {"cut off": 1, "number": 1}
    assert narration.figures["too_short"] == 1
    assert len(server.requests) == 12 + 4
    request = server.requests[0]
    assert request["chat_template_kwargs"] == {"enable_thinking": False}
    assert (request["temperature"], request["top_p"], request["top_k"]) == (0.7, 0.8, 20)
    assert not {"seed", "structured_outputs"} & set(request)


def test_grammar_is_sent_and_its_version_recorded(store, start_server):
    server = start_server()
    free, constrained = teacher_at(server), teacher_at(server, grammar=True)
    narrate_store(store, free)
    requests = len(server.requests)
    narration = narrate_store(store, constrained)
    assert len(server.requests) == 2 * requests
    assert server.requests[-1]["structured_outputs"] == {"grammar": GRAMMAR}
    assert {r.grammar for r in narration.rationales} == {GRAMMAR_VERSION}
    assert {r.grammar for r in narrate_store(store, free).rationales} == {None}


def test_several_samples_are_requested_only_after_a_rejection(store, start_server):
    server = start_server("number")
    narration = narrate_store(store, teacher_at(server, concurrency=1, samples=3))
    assert [request["n"] for request in server.requests] == [1, 3] + [1] * 11
    assert narration.rationales[0].attempt == 1
    first = [r for r in read_rationales(journal_path(store)) if r.item_id == "item-0"]
    assert [(r.attempt, r.accepted) for r in first] == [(0, False), (1, True), (2, True), (3, True)]
    # The prompt tokens of a request count once, for the first of its samples.
    assert [r.prompt_tokens for r in first] == [1000, 1000, 0, 0]
    assert first[0].completion_tokens == 101
    assert sum(r.completion_tokens for r in first[1:]) == 303


def test_samples_do_not_exceed_the_attempts(store, start_server):
    server = start_server()
    server.always["*"] = "number"
    narration = narrate_store(store, teacher_at(server, attempts=4, samples=2))
    assert narration.figures["set_aside"] == 12
    attempts = [r.attempt for r in read_rationales(journal_path(store))]
    assert sorted(attempts) == sorted([0, 1, 2, 3] * 12)
    assert sum(request["n"] for request in server.requests) == 48


@pytest.mark.parametrize(
    ("fault", "reason"),
    [("cut", "cut off"), ("empty", "empty"), ("thinking", "thinking"), ("long", "too long")],
)
def test_unusable_response_is_rejected_with_its_reason(store, start_server, fault, reason):
    narration = narrate_store(store, teacher_at(start_server(fault)))
    assert narration.figures["rejected"] == {reason: 1}
    assert len(narration.rationales) == 12
    assert all(len(r.text) <= 20_000 for r in read_rationales(journal_path(store)))


def test_lone_surrogate_in_a_response_is_replaced(store, start_server):
    assert len(narrate_store(store, teacher_at(start_server("surrogate"))).rationales) == 12
    assert len(pq.read_table(store.folder / "rationales.parquet")) == 12


@pytest.mark.parametrize(
    "fault",
    ["reset", "hang", 500, 408, b'{"choices": [{"message": {"content": "\xff\xfe"}}]}', b"<html>",
     b"{"],
)  # fmt: skip
def test_failed_request_is_repeated(store, start_server, fault):
    server = start_server(fault)
    narration = narrate_store(store, teacher_at(server))
    assert narration.figures["rejected"] == {}
    assert len(narration.rationales) == 12
    assert len(server.requests) == 13


@pytest.mark.parametrize("status", [500, 400])
def test_item_without_response_spends_no_attempt(store, start_server, caplog, status):
    server = start_server()
    prompt = next(iter(server.rationales))
    server.always[prompt] = status
    cfg = teacher_at(server, concurrency=1, attempts=1)
    narration = narrate_store(store, cfg)
    figures = narration.figures
    assert len(narration.rationales) == 11
    assert (figures["rejected"], figures["unanswered"], figures["set_aside"]) == ({}, 1, 0)
    assert figures["too_short"] == 1
    assert "1 items without a response" in str(narration)
    assert "item-0" in caplog.text
    assert f"Error code: {status} - fault" in caplog.text
    # A request is repeated if it failed, but not if it was refused.
    prompts = [request["messages"][-1]["content"] for request in server.requests]
    assert prompts.count(prompt) == (1 if status == 400 else 4)
    assert len(read_rationales(journal_path(store))) == 11
    server.always.clear()
    assert len(narrate_store(store, cfg).rationales) == 12


def test_resumed_run_requests_only_missing_items_and_finished_run_none(store, start_server):
    store.items = [item for item in store.items if item.item_id != "item-5"]
    server = start_server()
    narrate_store(store, teacher_at(server))
    lines = journal_path(store).read_bytes().splitlines(keepends=True)
    journal_path(store).write_bytes(b"".join(lines[:7]) + lines[7][:40])
    server.requests.clear()
    narration = narrate_store(store, teacher_at(server))
    assert len(server.requests) == len(lines) - 7
    assert len(narration.rationales) == 12
    server.stop()
    before = journal_path(store).read_bytes()
    again = narrate_store(store, teacher_at(server))
    assert (again.rationales, again.figures) == (narration.rationales, narration.figures)
    assert journal_path(store).read_bytes() == before


def test_unknown_model_is_reported_with_the_models_of_the_server(store, start_server):
    with raises_user_error("unknown-model", contains=("teacher.model=tiny", "other")):
        narrate_store(store, teacher_at(start_server(404), concurrency=1))


@pytest.mark.parametrize("status", [401, 400, 403, 422])
def test_server_that_refuses_every_request_is_reported(store, start_server, status):
    server = start_server()
    server.always["*"] = status
    code = "invalid-api-key" if status == 401 else "server-refuses"
    with raises_user_error(code, contains=(server.url, "fault")):
        narrate_store(store, teacher_at(server))
    assert read_rationales(journal_path(store)) == []


@pytest.mark.parametrize(
    "reply",
    [b"<html>hello</html>", b"{}", b'{"choices": []}', b"{", b"[]",
     b'{"choices": [{"message": null}]}'],
)  # fmt: skip
def test_incompatible_server_is_reported(store, start_server, reply):
    server = start_server()
    server.always["*"] = reply
    with raises_user_error("incompatible-server", contains=server.url):
        narrate_store(store, teacher_at(server))
    assert read_rationales(journal_path(store)) == []


def test_fallback_is_marked_and_optional(store, start_server, monkeypatch):
    """All responses of the server contain a number, so all items are set aside."""
    server = start_server(*["number"] * 40)
    cfg = teacher_at(server, attempts=2, samples=1, grammar=True)
    without = narrate_store(store, cfg)
    assert (without.rationales, without.figures["set_aside"]) == ([], 12)
    requests = len(server.requests)
    narration = narrate_store(store, replace(cfg, fallback=True))
    figures = narration.figures
    assert len(server.requests) == requests
    assert (len(narration.rationales), figures["fallback"], figures["set_aside"]) == (12, 12, 0)
    assert all(r.fallback and r.teacher == "served" for r in narration.rationales)
    assert {(r.prompt_version, r.grammar) for r in narration.rationales} == {
        (NARRATOR_VERSION, None)
    }
    assert figures["responses"] == without.figures["responses"]
    again = narrate_store(store, replace(cfg, fallback=True))
    assert again.rationales == narration.rationales
    assert narrate_store(store, cfg).rationales == []
    # With another prompt, the server is asked again for items with fallbacks.
    monkeypatch.setattr("dynapix.teacher.validation.grader.PROMPT_VERSION", "another")
    narrate_store(store, replace(cfg, fallback=True))
    assert len(server.requests) > requests


def still_store(folder):
    """A store whose first item has candidates that look alike, since nothing moves. In the others,
    an object crosses the image."""
    store = make_store(folder, 4)
    start, stop = (synthetic.on_ground(pixel)[:2] for pixel in ((60, 60), (420, 260)))
    for k, velocity in enumerate([np.zeros(2), *[(stop - start) / 127 * synthetic.FPS] * 2]):
        scene = synthetic.scene([start, (0.5, -0.5)], [velocity, (0, 0)], scene_id=f"s{k}")
        store.scenes[f"s{k}"] = scene
    return store


def test_undecided_item_is_narrated_marked_and_counted(tmp_path):
    narration = narrate_store(still_store(tmp_path), replace(TEMPLATE, predicates="relational"))
    by_item = {r.item_id: r for r in narration.rationales}
    assert by_item["item-0"].undecided
    assert by_item["item-0"].sufficiency == 0.25
    assert not by_item["item-1"].undecided
    assert by_item["item-1"].sufficiency == 1
    assert narration.figures["undecided"] == 1
    assert "1 items that no statement decides" in str(narration)


def test_insufficient_rationales_are_set_aside_with_the_reason(tmp_path):
    store = still_store(tmp_path)
    narration = narrate_store(store, replace(TEMPLATE, predicates="relational", sufficient=True))
    assert {r.item_id for r in narration.rationales} == {"item-1", "item-2"}
    rejected = [r for r in read_rationales(tmp_path / "rationales.jsonl") if not r.accepted]
    assert {(r.item_id, r.reasons) for r in rejected} == {("item-0", ("undecided",))}
    assert narration.figures["set_aside"] == 1


def test_rationales_of_another_vocabulary_are_named_and_not_used(tmp_path, caplog):
    store = make_store(tmp_path, 4)
    relational = replace(TEMPLATE, predicates="relational")
    first = narrate_store(store, TEMPLATE)
    path = tmp_path / "rationales.jsonl"
    kept = path.read_bytes()
    with caplog.at_level("INFO"):
        second = narrate_store(store, relational)
    paper = name_vocabulary(TEMPLATE)
    assert f"3 responses of the vocabulary {paper}; they are not used" in caplog.text
    assert path.read_bytes().startswith(kept)
    assert {r.predicates for r in second.rationales} == {name_vocabulary(relational)}
    assert narrate_store(store, TEMPLATE).rationales == first.rationales
    with Journal(path) as journal:
        journal.append([replace(second.rationales[0], predicates="relational 0")])
    caplog.clear()
    with caplog.at_level("INFO"):
        assert narrate_store(store, relational).rationales == second.rationales
    assert "1 responses of the vocabulary relational 0" in caplog.text


@pytest.mark.parametrize("served", [False, True])
def test_sample_is_narrated_and_the_full_narration_goes_on_from_it(
    tmp_path, start_server, caplog, served
):
    caplog.set_level("INFO")
    stores = [make_store(tmp_path / name, 14) for name in ("sampled", "whole")]
    server = start_server()
    cfg = teacher_at(server) if served else TEMPLATE
    for store in stores:
        store.folder.mkdir()
    sampled, whole = stores
    narration = narrate_store(sampled, cfg, limit=5)
    assert "narrating a sample: 5 of 13 items, seed 0" in caplog.text
    assert narration.figures["items"] == 5 == len(narration.responses)
    assert narration.figures["accepted"] + narration.figures["too_short"] == 5
    assert {r.sample for r in narration.rationales} == {"5 of 13 items, seed 0"}
    before = journal_path(sampled).read_bytes()
    assert narrate_store(sampled, cfg, limit=5).rationales == narration.rationales
    assert journal_path(sampled).read_bytes() == before
    # A larger sample contains a smaller one.
    larger = narrate_store(sampled, cfg, limit=8)
    assert set(narration.responses) < set(larger.responses)
    requests = len(server.requests)

    full, expected = narrate_store(sampled, cfg), narrate_store(whole, cfg)
    assert journal_path(sampled).read_bytes().startswith(before)
    texts = [[(r.item_id, r.attempt, r.text) for r in n.rationales] for n in (full, expected)]
    assert texts[0] == texts[1]
    if served:
        assert len(server.requests) == 12 + 12
        assert requests < 9
    else:
        tables = [(store.folder / "rationales.parquet").read_bytes() for store in stores]
        assert tables[0] == tables[1]
    # A sample does not take rationales out of the table.
    narrate_store(sampled, cfg, limit=2)
    assert pq.read_table(sampled.folder / "rationales.parquet").num_rows == 12
