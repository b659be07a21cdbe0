"""A served model is asked with the frames and the times that a model here is shown."""

from __future__ import annotations

import asyncio
import base64
import io
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from PIL import Image

from conf.entry import Run
from conf.schema import SelectCommand, ServerConfig, StudentConfig
from data.render.frame_cache import FrameReader
from evaluation import select
from evaluation.generators.base import item_sample, response_settings
from evaluation.generators.openai_server import (
    ServedModel,
    generate_responses,
    restore_thought,
    served_origin,
)
from evaluation.generators.response_log import ResponseLog, collect_responses, score_response
from evaluation.generators.response_schema import instruction, schema
from teacher.servers.responses import TRUNCATED, Response
from tests.evaluation.generators.test_response_schema import FULL
from tests.user_errors import raises_user_error

STUDENT = StudentConfig(name="any", model="any", image_size=96, max_length=1500, max_new_tokens=40)
THINKING = replace(STUDENT, thinking=True, temperature=0.6, top_p=0.95, top_k=20)


@pytest.fixture
def items(micro_store):
    return micro_store.selection("test")[:8]


@pytest.fixture
def frames(micro_store):
    return FrameReader(micro_store, STUDENT.image_size)


def at(*servers, **changes) -> ServerConfig:
    settings = {"concurrency": 3, "unreachable_timeout": 5.0, "timeout": 10.0, **changes}
    return ServerConfig(url=[s.url for s in servers], model="served", **settings)


def opened(tmp_path, items, **known) -> ResponseLog:
    return ResponseLog(tmp_path / "answers.jsonl", {"record": known, "answer": known}, items)


def asker(server, frames, cfg=STUDENT, mode="record", control=None, seed=0):
    sample_of = partial(item_sample, "cot", frames, cfg, control, mode)
    return lambda things, keep: asyncio.run(
        generate_responses(server, cfg, seed, mode, sample_of, things, keep)
    )


def test_the_same_frames_and_times_are_sent(items, frames, talking, tmp_path) -> None:
    server = talking(lambda _: FULL)
    log = opened(tmp_path, items)
    given = collect_responses(items, "record", asker(at(server, concurrency=1), frames), log)
    assert [a.letter for a in given] == ["C"] * 8
    assert [a.right for a in given] == [i.letter == "C" for i in items]
    assert {a.valid for a in given} == {True}
    for item, asked in zip(items, server.asked, strict=True):
        sample = item_sample("cot", frames, STUDENT, None, "record", item)
        parts = asked["messages"][0]["content"]
        video = parts[0]["video_url"]["url"].removeprefix("data:video/jpeg;base64,")
        assert np.array_equal(np.stack([*map(pixels, video.split(","))]), sample.clip.pixels)
        images = [p["image_url"]["url"].partition(",")[2] for p in parts if "image_url" in p]
        for told, image in zip(images, sample.images, strict=True):
            assert np.array_equal(pixels(told), image)
        texts = [p["text"] for p in parts if p["type"] == "text"]
        assert texts[0].startswith(item.question)
        assert texts[-1] == f"\n{instruction()}"
        clip = asked["media_io_kwargs"]["video"]
        assert clip["frames_indices"] == sample.clip.indices
        assert (clip["fps"], clip["total_num_frames"], clip["num_frames"]) == (25.0, 128, -1)
        assert asked["mm_processor_kwargs"]["videos_kwargs"]["do_sample_frames"] is False
        assert (asked["temperature"], asked["max_tokens"]) == (0, 40)
        assert "seed" not in asked
        assert "response_format" not in asked


def pixels(png: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(png))))


def test_a_model_is_held_to_the_schema_and_draws_by_seeds(items, frames, talking) -> None:
    server = talking(lambda _: FULL)
    said = []
    for seed in (0, 0, 1):
        held = asker(at(server), frames, THINKING, "constrained", seed=seed)
        held(items[:2], said.extend)
    answers = [score_response(item, "constrained", found) for item, found in said]
    assert [(a.letter, a.valid) for a in answers] == [("C", True)] * 6
    format_ = server.asked[0]["response_format"]
    assert format_["json_schema"]["schema"] == schema()
    sampling = {key: server.asked[0][key] for key in ("temperature", "top_p", "top_k")}
    assert sampling == {"temperature": 0.6, "top_p": 0.95, "top_k": 20}
    assert server.asked[0]["chat_template_kwargs"] == {"enable_thinking": True}
    seeds = [sorted(a["seed"] for a in server.asked[k : k + 2]) for k in (0, 2, 4)]
    assert seeds[0] == seeds[1] != seeds[2]
    assert len(set(seeds[0])) == 2


def test_no_bound_is_asked_for_as_such(items, frames, talking) -> None:
    server = talking(lambda _: "B")
    unbound = replace(STUDENT, temperature=0.7, top_p=1.0, top_k=0)
    asker(at(server), frames, unbound)(items[:1], lambda _: None)
    assert (server.asked[0]["top_p"], server.asked[0]["top_k"]) == (1.0, -1)


def test_a_control_hides_the_clip(items, frames, talking) -> None:
    server = talking(lambda _: "B")
    asker(at(server), frames, control="candidate_only")(items[:1], lambda _: None)
    kinds = [p["type"] for p in server.asked[0]["messages"][0]["content"]]
    assert "video_url" not in kinds
    assert kinds.count("image_url") == 4
    assert "media_io_kwargs" not in server.asked[0]


@pytest.mark.parametrize(
    ("reply", "thinking", "text"),
    [
        (Response("Answer: B"), False, "Answer: B"),
        (Response("B? Yes.</think>Answer: C"), True, "<think>B? Yes.</think>Answer: C"),
        (Response("<think>B?</think>C"), True, "<think>B?</think>C"),
        (Response("Answer: B", TRUNCATED), True, "<think>Answer: B"),
        (Response("C", "thinking", reasoning="B?"), False, "<think>B?</think>C"),
        (Response("", TRUNCATED, reasoning="Answer: B"), True, "<think>Answer: B"),
    ],
)
def test_a_thought_is_no_answer(reply, thinking, text, items) -> None:
    found = restore_thought(reply, thinking)
    assert found.text == text
    assert found.cut == (reply.flaw == TRUNCATED)
    letter = score_response(items[0], "answer", found).letter
    assert letter == (None if "</think>" not in text and thinking else text[-1])


def test_hostile_answers_are_kept_and_read(items, frames, talking, tmp_path) -> None:
    hostile = iter(
        [
            "x" * 1_000_000,
            "{" * 300_000,
            "\ud800 Answer: B",
            {"content": None},
            {"content": "Answer: B", "finish_reason": "length"},
            {"content": "", "reasoning": "Answer: C"},
            'forced_choice": "A"\u2028\x85\x00',
            FULL,
        ]
    )
    server = talking(lambda _: next(hostile))
    log = opened(tmp_path, items)
    given = collect_responses(items, "record", asker(at(server, concurrency=1), frames), log)
    assert [a.letter for a in given] == [None, None, "B", None, None, None, None, "C"]
    assert given[4].reason == "cut off"
    again = opened(tmp_path, items).answers
    assert [again[a.item_id, "record"] for a in given] == given


def test_a_server_that_dies_costs_no_answer(items, frames, talking, tmp_path) -> None:
    first = talking(lambda _: FULL if len(first.asked) < 4 else 500)
    log = opened(tmp_path, items)
    dying = asker(at(first, unreachable_timeout=0.2, concurrency=1), frames)
    with raises_user_error("no-server", contains="server.url"):
        collect_responses(items, "record", dying, log)
    kept = (tmp_path / "answers.jsonl").read_text()
    assert len(log.answers) == 3
    second = talking(lambda _: FULL)
    log = opened(tmp_path, items)
    assert len(collect_responses(items, "record", asker(at(second), frames), log)) == 8
    assert len(second.asked) == 5
    assert (tmp_path / "answers.jsonl").read_text().startswith(kept)


@pytest.mark.parametrize(
    "words",
    [
        "served is not a multimodal model",
        "At most 0 video(s) may be provided in one prompt.",
        "Per-request media_io_kwargs are disabled by default",
    ],
)
def test_a_model_that_takes_no_clip_is_told(words, items, frames, talking) -> None:
    def refuse(request):
        clip = any(p["type"] == "video_url" for p in request["messages"][0]["content"])
        return {"status": 400, "message": words} if clip else "Hello."

    server = talking(refuse)
    with raises_user_error("server-refuses", contains=(server.url, words)):
        asker(at(server), frames)(items, lambda _: None)


def test_an_item_that_alone_has_no_answer_is_told(items, frames, talking) -> None:
    # A blank canary is much shorter than any item.
    def refuse(request):
        long = len(json.dumps(request)) > 10_000
        return {"status": 400, "message": "prompt is too long"} if long else "Hello."

    server = talking(refuse)
    with raises_user_error("no-response", contains="prompt is too long"):
        asker(at(server, concurrency=1), frames)(items, lambda _: None)


def test_what_is_served_is_told_apart(talking) -> None:
    server = talking(lambda _: FULL)
    assert served_origin(at(server)) == {"root": "weights", "parent": None}
    adapter = replace(at(server), model="adapter")
    assert served_origin(adapter) == {"root": "lora", "parent": "weights"}
    with raises_user_error("unknown-model", contains=("server.model=other", "served, adapter")):
        served_origin(replace(at(server), model="other"))
    server.stop()
    with raises_user_error("no-server", contains="http://127"):
        served_origin(at(server))


def test_what_a_server_cannot_tell_of_its_weights_the_user_can(talking, caplog) -> None:
    caplog.set_level("INFO")
    cfg = SelectCommand(student=STUDENT, server=at(talking(lambda _: FULL)))
    plain, committed = (
        ServedModel(cfg, None, replace(STUDENT, revision=rev)).revision for rev in (None, "c0ffee")
    )
    assert plain != committed
    assert "student.revision=COMMIT" in caplog.text


def test_a_server_is_given_its_key(items, frames, talking, tmp_path, monkeypatch) -> None:
    server = talking(lambda _: FULL)
    server.key = "secret"
    log = opened(tmp_path, items)
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    for ask in (
        lambda: served_origin(at(server)),
        lambda: collect_responses(items, "record", asker(at(server), frames), log),
    ):
        with raises_user_error("invalid-api-key", contains=(server.url, "OPENAI_API_KEY")):
            ask()
    monkeypatch.setenv("OPENAI_API_KEY", "secret")
    assert served_origin(at(server))["root"] == "weights"
    given = collect_responses(items, "record", asker(at(server), frames), log)
    assert [a.letter for a in given] == ["C"] * 8


def test_a_student_is_not_measured_by_its_base(talking, tmp_path) -> None:
    server = talking(lambda _: FULL)
    cfg = SelectCommand(server=replace(at(server), model=None), student=STUDENT)
    with raises_user_error("missing-server-model", contains="server.model=NAME"):
        ServedModel(cfg, tmp_path, STUDENT)
    # Nor is what it answers taken for a base's.
    adapter = replace(cfg, server=replace(at(server), model="adapter"))
    with raises_user_error("adapter-without-run", contains="model=RUN"):
        ServedModel(adapter, None, STUDENT)


def test_adapters_over_another_rounding_are_told(talking, tmp_path, caplog) -> None:
    cfg = SelectCommand(server=replace(at(talking(lambda _: FULL)), model="adapter"))
    ServedModel(cfg, tmp_path, replace(STUDENT, quantization="none"))
    assert not caplog.text
    ServedModel(cfg, tmp_path, STUDENT)
    assert "NF4" in caplog.text


def test_answers_to_other_questions_stay_and_do_not_count(items, tmp_path) -> None:
    path, [item, *_] = tmp_path / "answers.jsonl", items
    first = ResponseLog(path, {"record": {"seed": 0}}, items)
    first.append([score_response(item, "record", restore_thought(Response(FULL), False))])
    assert ResponseLog(path, {"record": {"seed": 0}}, items).answers == first.answers
    assert not ResponseLog(path, {"record": {"seed": 1}}, items).answers
    assert not ResponseLog(path, {"answer": {"seed": 0}}, items).answers
    # A line that was torn ends there, the others stay.
    path.write_text(path.read_text() + '{"item_id": "')
    assert ResponseLog(path, {"record": {"seed": 0}}, items).answers == first.answers
    assert path.read_text().endswith('{"item_id": "\n')


def test_servers_of_two_models_by_one_name_are_told(talking) -> None:
    one, same, other = (talking(lambda _: FULL) for _ in range(3))
    given = replace(at(one), url=[one.url, same.url])
    assert served_origin(given) == served_origin(at(one))
    other.root = "others"
    with raises_user_error("different-models", contains=("is weights at", "others at")):
        served_origin(replace(given, url=[one.url, same.url, other.url]))


def test_what_an_answer_depends_on_is_its_key() -> None:
    def known(
        mode="record", regime="cot", cfg=STUDENT, seed=0, rev="a", benchmark="b", control=None
    ):
        return response_settings(mode, regime, cfg, seed, {"weights": rev}, benchmark, control)

    assert known() == known(seed=1)
    other = [
        known("constrained"),
        known("reasoning"),
        known(cfg=THINKING),
        known(cfg=THINKING, seed=1),
        known(cfg=replace(STUDENT, max_new_tokens=41)),
        known(cfg=replace(STUDENT, image_size=64)),
        known(rev="c"),
        known(benchmark="c"),
        known(control="candidate_only"),
    ]
    texts = {json.dumps(k, sort_keys=True) for k in [known(), *other]}
    assert len(texts) == 1 + len(other)


@pytest.mark.slow
def test_the_command_measures_a_served_model(micro, micro_store, talking, tmp_path) -> None:
    server = talking(lambda r: FULL if "response_format" in r else "I cannot tell.")
    cfg = SelectCommand(
        benchmark=micro, student=STUDENT, server=at(server), store=str(micro_store.folder.parent),
        limit=6,
    )  # fmt: skip
    metrics = select.main.__wrapped__(cfg, Run("x", tmp_path))
    assert metrics["record_parse_rate"] == 0
    assert metrics["constrained_parse_rate"] == 1
    report = json.loads((tmp_path / "report.json").read_text())
    assert [r["mode"] for r in report["rows"]] == ["record", "constrained"]
    assert report["readings"]["record"] == {
        "with a letter": 0, "  in a valid record": 0, "without: refusal": 6,
    }  # fmt: skip
    assert report["calibration"]["constrained"]["n"] == 6
    assert report["positions"]["constrained"]["chosen"]["C"] == 6
    # All is answered: the same command asks nothing.
    server.asked.clear()
    assert select.main.__wrapped__(cfg, Run("x", tmp_path)) == metrics
    assert not server.asked
