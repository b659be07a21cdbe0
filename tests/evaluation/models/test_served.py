"""A model on a server: its requests, its responses, and the values that identify it."""

from __future__ import annotations

import base64
import io
import json
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
from PIL import Image

from dynapix.conf.entry import Run
from dynapix.conf.schema import SelectCommand, ServerConfig, StudentConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.evaluation import select
from dynapix.evaluation.generators.generator import item_sample, response_settings
from dynapix.evaluation.generators.openai_server import ServedModel, restore_thought, served_origin
from dynapix.evaluation.generators.response_log import (
    ResponseLog,
    collect_responses,
    score_response,
)
from dynapix.evaluation.generators.response_schema import (
    build_record_schema,
    write_record_instruction,
)
from dynapix.models import loading
from dynapix.models.student.collator import encode
from dynapix.teacher.servers.responses import TRUNCATED, Response
from dynapix.train.student import dataset
from tests.evaluation.generators.test_response_schema import FULL
from tests.tiny_models import SMALL
from tests.user_errors import raises_user_error

STUDENT = StudentConfig(name="any", model="any", image_size=96, max_length=1500, max_new_tokens=40)
THINKING = replace(STUDENT, thinking=True, temperature=0.6, top_p=0.95, top_k=20)


@pytest.fixture
def items(micro_store):
    return micro_store.selection("test")[:8]


@pytest.fixture
def frames(micro_store):
    return FrameReader(micro_store, STUDENT.image_size)


def config_of(*servers, **changes) -> ServerConfig:
    """The settings of a client of servers."""
    settings = {"concurrency": 3, "unreachable_timeout": 5.0, "timeout": 10.0, **changes}
    return ServerConfig(url=[s.url for s in servers], model="served", **settings)


def open_log(tmp_path, items) -> ResponseLog:
    return ResponseLog(tmp_path / "answers.jsonl", {"record": {}, "answer": {}}, items)


def responder(server, frames, cfg=STUDENT, mode="record", control=None, seed=0):
    """The function that generates the responses of a served base in a mode."""
    model = ServedModel(SelectCommand(student=cfg, server=server, seed=seed), None, cfg)
    return partial(model.respond, mode, partial(item_sample, "cot", frames, cfg, control, mode))


def test_requests_contain_the_frames_and_times_of_a_sample(
    items, frames, start_server, tmp_path
) -> None:
    server = start_server(lambda _: FULL)
    log = open_log(tmp_path, items)
    answers = collect_responses(
        items, "record", responder(config_of(server, concurrency=1), frames), log
    )
    assert [a.letter for a in answers] == ["C"] * 8
    assert [a.right for a in answers] == [i.letter == "C" for i in items]
    assert {a.valid for a in answers} == {True}
    for item, request in zip(items, server.requests, strict=True):
        sample = item_sample("cot", frames, STUDENT, None, "record", item)
        parts = request["messages"][0]["content"]
        video = parts[0]["video_url"]["url"].removeprefix("data:video/jpeg;base64,")
        assert np.array_equal(np.stack([*map(pixels, video.split(","))]), sample.clip.pixels)
        images = [p["image_url"]["url"].partition(",")[2] for p in parts if "image_url" in p]
        for png, image in zip(images, sample.images, strict=True):
            assert np.array_equal(pixels(png), image)
        texts = [p["text"] for p in parts if p["type"] == "text"]
        assert texts[0].startswith(item.question)
        assert texts[-1] == f"\n{write_record_instruction()}"
        clip = request["media_io_kwargs"]["video"]
        assert clip["frames_indices"] == sample.clip.indices
        assert (clip["fps"], clip["total_num_frames"], clip["num_frames"]) == (25.0, 128, -1)
        assert request["mm_processor_kwargs"]["videos_kwargs"]["do_sample_frames"] is False
        assert (request["temperature"], request["max_tokens"]) == (0, 40)
        # No penalty of the model's generation config applies.
        assert (request["repetition_penalty"], request["min_p"]) == (1.0, 0.0)
        assert (request["presence_penalty"], request["frequency_penalty"]) == (0.0, 0.0)
        assert "seed" not in request
        assert "response_format" not in request


def pixels(png: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(png))))


def test_constrained_requests_have_the_schema_and_a_seed_per_item(
    items, frames, start_server
) -> None:
    server = start_server(lambda _: FULL)
    responses = []
    for seed in (0, 0, 1):
        respond = responder(config_of(server), frames, THINKING, "constrained", seed=seed)
        respond(items[:2], responses.extend)
    answers = [score_response(item, "constrained", text) for item, text in responses]
    assert [(a.letter, a.valid) for a in answers] == [("C", True)] * 6
    response_format = server.requests[0]["response_format"]
    assert response_format["json_schema"]["schema"] == build_record_schema()
    sampling = {key: server.requests[0][key] for key in ("temperature", "top_p", "top_k")}
    assert sampling == {"temperature": 0.6, "top_p": 0.95, "top_k": 20}
    assert server.requests[0]["chat_template_kwargs"] == {"enable_thinking": True}
    seeds = [sorted(r["seed"] for r in server.requests[k : k + 2]) for k in (0, 2, 4)]
    assert seeds[0] == seeds[1] != seeds[2]
    assert len(set(seeds[0])) == 2

    # The schema allows no thought, but a reasoning parser may take the record for one.
    for reply, letter in (
        ({"content": None, "reasoning": FULL}, "C"),
        ({"content": "", "reasoning": FULL[:60], "finish_reason": "length"}, None),
    ):
        misfiled = start_server(lambda _, reply=reply: reply)
        respond = responder(config_of(misfiled), frames, THINKING, "constrained")
        respond(items[:1], (kept := []).extend)
        assert [score_response(item, "constrained", text).letter for item, text in kept] == [letter]


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
def test_a_thought_is_not_parsed_as_the_answer(reply, thinking, text, items) -> None:
    generated = restore_thought(reply, thinking)
    assert generated.text == text
    assert generated.truncated == (reply.flaw == TRUNCATED)
    letter = score_response(items[0], "answer", generated).letter
    assert letter == (None if "</think>" not in text and thinking else text[-1])


def test_malformed_responses_are_stored_and_scored(
    items, frames, start_server, tmp_path, caplog
) -> None:
    replies = iter(
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
    server = start_server(lambda _: next(replies))
    log = open_log(tmp_path, items)
    answers = collect_responses(
        items, "record", responder(config_of(server, concurrency=1), frames), log
    )
    assert [a.letter for a in answers] == [None, None, "B", None, None, None, "A", "C"]
    assert answers[4].reason == "cut off"
    assert "1 of 8 responses in record mode are thoughts" in caplog.text
    assert "--reasoning-parser" in caplog.text
    stored = open_log(tmp_path, items).responses
    assert [stored[a.item_id, "record"] for a in answers] == answers


def test_responses_before_a_server_fails_are_kept(items, frames, start_server, tmp_path) -> None:
    first = start_server(lambda _: FULL if len(first.requests) < 4 else 500)
    log = open_log(tmp_path, items)
    dying = responder(config_of(first, unreachable_timeout=0.2, concurrency=1), frames)
    with raises_user_error("no-server", contains="server.url"):
        collect_responses(items, "record", dying, log)
    before = (tmp_path / "answers.jsonl").read_text()
    assert len(log.responses) == 3
    second = start_server(lambda _: FULL)
    log = open_log(tmp_path, items)
    assert len(collect_responses(items, "record", responder(config_of(second), frames), log)) == 8
    assert len(second.requests) == 5
    assert (tmp_path / "answers.jsonl").read_text().startswith(before)


def test_a_server_that_refuses_clips_gets_their_frames_as_images(
    items, frames, start_server, caplog
) -> None:
    """So does llama.cpp's server, which takes images only."""

    def refuse(request):
        clip = any(p["type"] == "video_url" for p in request["messages"][0]["content"])
        return {"status": 400, "message": "video input is not supported"} if clip else FULL

    server = start_server(refuse)
    # vLLM reports where weights come from.
    server.root = None
    responder(config_of(server, concurrency=1), frames)(items, lambda _: None)
    assert "the server takes no videos" in caplog.text
    requests = server.requests[-len(items) :]
    for item, request in zip(items, requests, strict=True):
        parts = request["messages"][0]["content"]
        texts = [p["text"] for p in parts if p["type"] == "text"]
        sample = item_sample("cot", frames, STUDENT, None, "record", item)
        times = [f"At {k / sample.clip.fps:.2f} s: " for k in sample.clip.indices]
        assert texts[: 2 * len(times) : 2] == times
        images = [p["image_url"]["url"].partition(",")[2] for p in parts if "image_url" in p]
        expected = [*sample.clip.pixels, *sample.images]
        assert all(map(np.array_equal, map(pixels, images), expected))
        assert len(images) == len(expected)
        assert "media_io_kwargs" not in request


def is_long(request) -> bool:
    """Whether a request is for an item: the frames of a canary are small and blank."""
    return len(json.dumps(request)) > 10_000


def has_media(request) -> bool:
    content = request["messages"][0]["content"]
    return not isinstance(content, str) and any(p["type"] != "text" for p in content)


@pytest.mark.parametrize(
    ("refuses", "constrains", "mode", "code", "contains"),
    [
        (has_media, True, "record", "server-refuses", "too much"),
        (is_long, True, "record", "no-response", "too much"),
        (lambda _: False, False, "constrained", "no-constraint", "does not apply the JSON schema"),
    ],
    ids=["images", "an item", "the schema"],
)
def test_what_a_server_refuses_is_named(
    items, frames, start_server, refuses, constrains, mode, code, contains
) -> None:
    refusal = {"status": 400, "message": "too much"}
    server = start_server(lambda request: refusal if refuses(request) else FULL)
    server.constrains = constrains
    with raises_user_error(code, contains=contains):
        responder(config_of(server, concurrency=1), frames, mode=mode)(items, lambda _: None)


@pytest.mark.slow
def test_prompts_that_a_server_reads_differently_are_named_once(
    items, frames, start_server, caplog, micro_store, tmp_path
) -> None:
    built = replace(STUDENT, architecture=SMALL, model=None)
    corpus = partial(dataset.tokenizer_corpus, micro_store, [])
    loading.save_student(*loading.load_base(built, "fp32", corpus), tmp_path, "fp32")
    student = replace(STUDENT, model=str(tmp_path))
    _, processor = loading.load_base(student, "fp32", list)
    sample = item_sample("cot", frames, student, None, "record", items[0])
    ids = encode(sample, processor, None).input_ids
    for served, warnings in ((ids, 0), ([*ids[:3], 7, *ids[3:]], 1)):
        reply = {"content": FULL, "prompt_ids": served}
        server = start_server(lambda request, r=reply: r if "return_token_ids" in request else FULL)
        responder(config_of(server, concurrency=1), frames, student)(items[:4], lambda *_, **__: 0)
        assert sum("return_token_ids" in request for request in server.requests) == 1
        assert caplog.text.count("reads prompts differently") == warnings
    token = processor.tokenizer.decode(ids[3])
    assert f"at token 3 of the first prompt, this process has {token!r}" in caplog.text


def test_a_server_reports_the_origin_of_its_models(start_server, tmp_path) -> None:
    one, same, other = (start_server(lambda _: FULL) for _ in range(3))
    cfg = config_of(one)
    assert served_origin(cfg) == {"root": "weights", "parent": None}
    assert served_origin(replace(cfg, model="adapter")) == {"root": "lora", "parent": "weights"}
    with raises_user_error("unknown-model", contains=("server.model=other", "served, adapter")):
        served_origin(replace(cfg, model="other"))
    other.root = "others"
    assert served_origin(replace(cfg, url=[one.url, same.url])) == served_origin(cfg)
    with raises_user_error("different-models", contains=(one.url, other.url)):
        served_origin(replace(cfg, url=[one.url, same.url, other.url]))
    one.stop()
    with raises_user_error("no-server", contains=("http://127", "teacher.serve")):
        served_origin(cfg)


def test_a_student_and_its_base_are_not_confused(start_server, tmp_path, caplog) -> None:
    caplog.set_level("INFO")
    cfg = SelectCommand(student=STUDENT, server=config_of(start_server(lambda _: FULL)))
    unpinned, pinned = (
        ServedModel(cfg, None, replace(STUDENT, revision=rev)).identity for rev in (None, "c0ffee")
    )
    assert unpinned != pinned
    assert "student.revision=COMMIT" in caplog.text
    with raises_user_error("missing-server-model", contains="server.model=NAME"):
        ServedModel(replace(cfg, server=replace(cfg.server, model=None)), tmp_path, STUDENT)
    adapter = replace(cfg, server=replace(cfg.server, model="adapter"))
    with raises_user_error("adapter-without-run", contains="model=RUN"):
        ServedModel(adapter, None, STUDENT)
    ServedModel(adapter, tmp_path, replace(STUDENT, quantization="none"))
    assert "NF4" not in caplog.text
    ServedModel(adapter, tmp_path, STUDENT)
    assert "NF4" in caplog.text


def test_requests_carry_the_api_key(items, frames, start_server, monkeypatch) -> None:
    server = start_server(lambda _: FULL)
    server.key = "secret"
    for key in (None, "sec\rret"):
        if key is None:
            monkeypatch.delenv("OPENAI_API_KEY", raising=False)
        else:
            monkeypatch.setenv("OPENAI_API_KEY", key)
        with raises_user_error("invalid-api-key", contains="OPENAI_API_KEY"):
            served_origin(config_of(server))
    monkeypatch.setenv("OPENAI_API_KEY", "secret\n")
    responder(config_of(server), frames)(items, (kept := []).extend)
    assert len(kept) == len(items)


def test_the_key_of_a_response_depends_on_all_of_its_inputs() -> None:
    def settings(
        mode="record", regime="cot", cfg=STUDENT, seed=0, rev="a", benchmark="b", control=None
    ):
        return response_settings(mode, regime, cfg, seed, {"weights": rev}, benchmark, control)

    # Without sampling, the seed has no effect.
    assert settings() == settings(seed=1)
    other = [
        settings("constrained"),
        settings("reasoning"),
        settings(cfg=THINKING),
        settings(cfg=THINKING, seed=1),
        settings(cfg=replace(STUDENT, max_new_tokens=41)),
        settings(cfg=replace(STUDENT, image_size=64)),
        settings(rev="c"),
        settings(benchmark="c"),
        settings(control="candidate_only"),
    ]
    texts = {json.dumps(k, sort_keys=True) for k in [settings(), *other]}
    assert len(texts) == 1 + len(other)


@pytest.mark.slow
def test_the_command_measures_a_served_model(micro, micro_store, start_server, tmp_path) -> None:
    server = start_server(lambda r: FULL if "response_format" in r else "I cannot tell.")
    cfg = SelectCommand(
        benchmark=micro, student=STUDENT, server=config_of(server),
        store=str(micro_store.folder.parent), limit=6,
    )  # fmt: skip
    metrics = select.main.__wrapped__(cfg, Run("x", tmp_path))
    assert metrics["record_parse_rate"] == 0
    assert metrics["constrained_parse_rate"] == 1
    report = json.loads((tmp_path / "report.json").read_text())
    assert [r["mode"] for r in report["rows"]] == ["record", "constrained"]
    assert report["readings"]["record"] == {
        "with a letter": 0, "  in a valid record": 0, "without: refusal": 6,
    }  # fmt: skip
