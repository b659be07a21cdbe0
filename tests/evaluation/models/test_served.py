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

from dynapix.conf.schema import SelectCommand
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.evaluation.generators.generator import item_sample, response_settings
from dynapix.evaluation.generators.openai_server import ServedModel, served_origin
from dynapix.evaluation.generators.response_log import ResponseLog, collect_responses
from dynapix.evaluation.generators.response_schema import (
    build_record_schema,
    write_record_instruction,
)
from dynapix.models import loading
from dynapix.models.student.collator import encode
from tests.evaluation.generators.test_response_schema import FULL
from tests.evaluation.models.conftest import SERVED, served_by
from tests.user_errors import raises_user_error

THINKING = replace(SERVED, thinking=True, temperature=0.6, top_p=0.95, top_k=20)


@pytest.fixture
def items(micro_store):
    return micro_store.selection("test")[:8]


@pytest.fixture
def sample_of(micro_store):
    return partial(item_sample, "cot", FrameReader(micro_store, SERVED.image_size), SERVED, None)


@pytest.fixture
def ask(items, sample_of, tmp_path):
    """A function that returns a server's responses to the items."""

    def collect(server, mode: str = "record", cfg=SERVED, seed: int = 0) -> list:
        command = SelectCommand(student=cfg, server=served_by(server, concurrency=1), seed=seed)
        respond = partial(ServedModel(command, None, cfg).respond, mode, partial(sample_of, mode))
        log = ResponseLog(tmp_path / f"{server.server_port}-{seed}.jsonl", {mode: {}}, items)
        return collect_responses(items, mode, respond, log)

    return collect


def pixels(png: str) -> np.ndarray:
    return np.asarray(Image.open(io.BytesIO(base64.b64decode(png))))


def parts_of(request, kind: str) -> list:
    """The texts, or the data of the images or the videos, in a request."""
    content = request["messages"][0]["content"]
    values = [part[kind] for part in content if part["type"] == kind]
    return values if kind == "text" else [value["url"].partition(",")[2] for value in values]


def test_requests_contain_the_frames_and_times_of_a_sample(
    ask, items, sample_of, start_server
) -> None:
    server = start_server(lambda _: FULL)
    answers = ask(server)
    assert [a.letter for a in answers] == ["C"] * 8
    assert [a.right for a in answers] == [i.letter == "C" for i in items]
    assert {a.valid for a in answers} == {True}
    for item, request in zip(items, server.requests, strict=True):
        sample = sample_of("record", item)
        [video] = parts_of(request, "video_url")
        assert np.array_equal(np.stack([*map(pixels, video.split(","))]), sample.clip.pixels)
        for png, image in zip(parts_of(request, "image_url"), sample.images, strict=True):
            assert np.array_equal(pixels(png), image)
        texts = parts_of(request, "text")
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
        assert not {"seed", "response_format"} & set(request)


def test_constrained_requests_have_the_schema_and_a_seed_per_item(ask, start_server) -> None:
    seeds = []
    for seed in (0, 0, 1):
        server = start_server(lambda _: FULL)
        answers = ask(server, "constrained", THINKING, seed)
        assert {(a.letter, a.valid) for a in answers} == {("C", True)}
        seeds.append([request["seed"] for request in server.requests])
    assert seeds[0] == seeds[1] != seeds[2]
    assert len(set(seeds[0])) == 8
    request = server.requests[0]
    assert request["response_format"]["json_schema"]["schema"] == build_record_schema()
    assert [request[key] for key in ("temperature", "top_p", "top_k")] == [0.6, 0.95, 20]
    assert request["chat_template_kwargs"] == {"enable_thinking": True}


REPLIES = [
    ("x" * 1_000_000, None),
    ("{" * 300_000, None),
    ("\ud800 Answer: B", "B"),
    ({"content": None}, None),
    ({"content": "Answer: B", "finish_reason": "length"}, None),
    ({"content": "", "reasoning": "Answer: C"}, None),
    ('forced_choice": "A"\u2028\x85\x00', "A"),
    ({"content": "C", "reasoning": "B?"}, "C"),
]
THOUGHTS = [
    ("B? Yes.</think>Answer: C", "C"),
    ("<think>B?</think>C", "C"),
    ({"content": "Answer: B", "finish_reason": "length"}, None),
    ({"content": "", "reasoning": "Answer: B", "finish_reason": "length"}, None),
] * 2


@pytest.mark.parametrize(("cfg", "replies"), [(SERVED, REPLIES), (THINKING, THOUGHTS)])
def test_malformed_responses_and_thoughts_are_scored(ask, start_server, caplog, cfg, replies):
    server = start_server(lambda _: replies[len(server.requests) - 1][0])
    answers = ask(server, cfg=cfg)
    assert [a.letter for a in answers] == [letter for _, letter in replies]
    assert {a.reason for a in answers if a.truncated} == {"cut off"}
    assert ("1 of 8 responses in record mode are thoughts" in caplog.text) == (cfg is SERVED)
    # They are stored: nothing is requested again.
    assert ask(server, cfg=cfg) == answers
    assert len(server.requests) == 8


def test_a_server_that_refuses_clips_gets_their_frames_as_images(
    ask, items, sample_of, start_server, caplog
) -> None:
    """So does llama.cpp's server, which takes images only."""
    refusal = {"status": 400, "message": "video input is not supported"}
    server = start_server(lambda request: refusal if parts_of(request, "video_url") else FULL)
    # vLLM reports where weights come from.
    server.root = None
    ask(server)
    assert "the server takes no videos" in caplog.text
    for item, request in zip(items, server.requests[-len(items) :], strict=True):
        sample = sample_of("record", item)
        times = [f"At {k / sample.clip.fps:.2f} s: " for k in sample.clip.indices]
        assert parts_of(request, "text")[: 2 * len(times) : 2] == times
        images, expected = parts_of(request, "image_url"), [*sample.clip.pixels, *sample.images]
        assert len(images) == len(expected)
        assert all(map(np.array_equal, map(pixels, images), expected))
        assert "media_io_kwargs" not in request


@pytest.mark.parametrize(
    ("longest", "mode", "code", "contains"),
    [
        (0, "record", "server-refuses", "too much"),
        # The frames of a canary are small and blank.
        (10_000, "record", "no-response", "too much"),
        (10**9, "constrained", "no-constraint", "does not apply the JSON schema"),
    ],
)
def test_what_a_server_refuses_is_named(ask, start_server, longest, mode, code, contains) -> None:
    refusal = {"status": 400, "message": "too much"}
    server = start_server(lambda r: refusal if len(json.dumps(r)) > longest else FULL)
    server.constrains = False
    with raises_user_error(code, contains=contains):
        ask(server, mode)


def test_prompts_that_a_server_reads_differently_are_named_once(
    ask, items, sample_of, start_server, caplog, trained_student
) -> None:
    student = replace(SERVED, model=str(trained_student / "student"))
    _, processor = loading.load_base(student, "fp32", list)
    ids = encode(sample_of("record", items[0]), processor, None).input_ids
    for served, warnings in ((ids, 0), ([*ids[:3], 7, *ids[3:]], 1)):
        reply = {"content": FULL, "prompt_ids": served}
        server = start_server(lambda request, r=reply: r if "return_token_ids" in request else FULL)
        ask(server, cfg=student)
        assert sum("return_token_ids" in request for request in server.requests) == 1
        assert caplog.text.count("reads prompts differently") == warnings
    token = processor.tokenizer.decode(ids[3])
    assert f"at token 3 of the first prompt, this process has {token!r}" in caplog.text


def test_a_server_reports_the_origin_of_its_models(start_server, monkeypatch) -> None:
    one, same, other = (start_server(lambda _: FULL) for _ in range(3))
    cfg = served_by(one)
    assert served_origin(cfg) == {"root": "weights", "parent": None}
    assert served_origin(replace(cfg, model="adapter")) == {"root": "lora", "parent": "weights"}
    with raises_user_error("unknown-model", contains=("server.model=other", "served, adapter")):
        served_origin(replace(cfg, model="other"))
    other.root = "others"
    assert served_origin(served_by(one, same)) == served_origin(cfg)
    with raises_user_error("different-models", contains=(one.url, other.url)):
        served_origin(served_by(one, same, other))
    one.key = "secret"
    for key in ("", "sec\rret"):
        monkeypatch.setenv("OPENAI_API_KEY", key)
        with raises_user_error("invalid-api-key", contains="OPENAI_API_KEY"):
            served_origin(cfg)
    monkeypatch.setenv("OPENAI_API_KEY", "secret\n")
    assert served_origin(cfg)
    one.stop()
    with raises_user_error("no-server", contains=("http://127", "teacher.serve")):
        served_origin(cfg)


def test_a_student_and_its_base_are_not_confused(start_server, tmp_path, caplog) -> None:
    caplog.set_level("INFO")
    cfg = SelectCommand(student=SERVED, server=served_by(start_server(lambda _: FULL)))
    pinned = ServedModel(cfg, None, replace(SERVED, revision="c0ffee"))
    assert ServedModel(cfg, None, SERVED).identity != pinned.identity
    assert "student.revision=COMMIT" in caplog.text
    with raises_user_error("missing-server-model", contains="server.model=NAME"):
        ServedModel(replace(cfg, server=replace(cfg.server, model=None)), tmp_path, SERVED)
    adapter = replace(cfg, server=replace(cfg.server, model="adapter"))
    with raises_user_error("adapter-without-run", contains="model=RUN"):
        ServedModel(adapter, None, SERVED)
    ServedModel(adapter, tmp_path, replace(SERVED, quantization="none"))
    assert "NF4" not in caplog.text
    ServedModel(adapter, tmp_path, SERVED)
    assert "NF4" in caplog.text


def test_the_key_of_a_response_depends_on_all_of_its_inputs() -> None:
    def settings(mode="record", cfg=SERVED, seed=0, rev="a", benchmark="b", control=None) -> str:
        found = response_settings(mode, "cot", cfg, seed, {"weights": rev}, benchmark, control)
        return json.dumps(found, sort_keys=True)

    # Without sampling, the seed has no effect.
    assert settings() == settings(seed=1)
    limit, size = replace(SERVED, max_new_tokens=41), replace(SERVED, image_size=64)
    texts = [settings(), settings("constrained"), settings("reasoning"), settings(rev="c")]
    texts += [settings(cfg=cfg) for cfg in (THINKING, limit, size)]
    texts += [settings(cfg=THINKING, seed=1), settings(benchmark="c"), settings(control="c")]
    assert len(set(texts)) == len(texts)
