"""A model on a server: its requests, its responses, and the values that identify it."""

from __future__ import annotations

import base64
import io
import json
from dataclasses import replace
from functools import partial
from http.server import BaseHTTPRequestHandler, HTTPServer
from threading import Thread

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

    # Sampling without top_p and top_k is requested explicitly.
    unlimited = replace(STUDENT, temperature=0.7, top_p=1.0, top_k=0)
    responder(config_of(server), frames, unlimited)(items[:1], lambda _: None)
    assert (server.requests[-1]["top_p"], server.requests[-1]["top_k"]) == (1.0, -1)


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


def test_a_server_that_refuses_images_is_named(items, frames, start_server) -> None:
    reason = "served is not a multimodal model"

    def refuse(request):
        content = request["messages"][0]["content"]
        texts = isinstance(content, str) or all(p["type"] == "text" for p in content)
        return "Hello." if texts else {"status": 400, "message": reason}

    server = start_server(refuse)
    with raises_user_error("server-refuses", contains=(server.url, reason)):
        responder(config_of(server), frames)(items, lambda _: None)


def test_a_server_that_refuses_an_item_is_reported(items, frames, start_server) -> None:
    # The request for an item is much longer than a canary, whose frames are small and blank.
    def refuse(request):
        long = len(json.dumps(request)) > 10_000
        return {"status": 400, "message": "prompt is too long"} if long else "Hello."

    server = start_server(refuse)
    with raises_user_error("no-response", contains="prompt is too long"):
        responder(config_of(server, concurrency=1), frames)(items, lambda _: None)


def test_a_server_that_ignores_the_schema_is_not_measured_in_constrained_mode(
    items, frames, start_server
) -> None:
    server = start_server(lambda _: FULL)
    server.constrains = False
    with raises_user_error("no-constraint", contains="does not apply the JSON schema"):
        responder(config_of(server), frames, mode="constrained")(items, lambda _: None)


def test_requests_ask_for_no_penalty(items, frames, start_server) -> None:
    server = start_server(lambda _: FULL)
    for student in (STUDENT, THINKING):
        responder(config_of(server), frames, student)(items[:1], lambda _: None)
        request = server.requests[-1]
        assert (request["repetition_penalty"], request["min_p"]) == (1.0, 0.0)
        assert (request["presence_penalty"], request["frequency_penalty"]) == (0.0, 0.0)


@pytest.fixture(scope="module")
def tiny_student(micro_store, tmp_path_factory) -> StudentConfig:
    """A student whose base is in a folder."""
    folder = tmp_path_factory.mktemp("base")
    built = replace(STUDENT, architecture=SMALL, model=None)
    corpus = partial(dataset.tokenizer_corpus, micro_store, [])
    loading.save_student(*loading.load_base(built, "fp32", corpus), folder, "fp32")
    return replace(STUDENT, model=str(folder))


@pytest.mark.slow
@pytest.mark.parametrize("is_same", [True, False])
def test_prompts_that_a_server_reads_differently_are_named_once(
    items, frames, start_server, caplog, tiny_student, is_same
) -> None:
    _, processor = loading.load_base(tiny_student, "fp32", list)
    sample = item_sample("cot", frames, tiny_student, None, "record", items[0])
    ids = encode(sample, processor, None).input_ids
    served = ids if is_same else [*ids[:3], 7, *ids[3:]]

    def reply(request):
        return {"content": FULL, "prompt_ids": served if "return_token_ids" in request else []}

    server = start_server(reply)
    responder(config_of(server, concurrency=1), frames, tiny_student)(items[:4], lambda *_, **__: 0)
    assert sum("return_token_ids" in request for request in server.requests) == 1
    assert caplog.text.count("reads prompts differently") == (not is_same)
    words = (
        f"at token 3 of the first prompt, this process has {processor.tokenizer.decode(ids[3])!r}"
    )
    assert is_same or (
        words in caplog.text and f"({len(ids)} and {len(ids) + 1} tok" in caplog.text
    )


def test_a_server_reports_the_origin_of_its_models(start_server) -> None:
    server = start_server(lambda _: FULL)
    assert served_origin(config_of(server)) == {"root": "weights", "parent": None}
    adapter = replace(config_of(server), model="adapter")
    assert served_origin(adapter) == {"root": "lora", "parent": "weights"}
    with raises_user_error("unknown-model", contains=("server.model=other", "served, adapter")):
        served_origin(replace(config_of(server), model="other"))
    server.stop()
    with raises_user_error("no-server", contains=("http://127", "teacher.serve")):
        served_origin(config_of(server))


@pytest.mark.parametrize(
    ("status", "body", "advice"),
    [
        (200, "<html>\nWelcome</html>", ("not a list of models", "ends with /v1")),
        (403, "{}", "OPENAI_API_KEY"),
        (404, "{}", "ends with /v1"),
        (429, "{}", "run the same command again"),
        (503, "{}", "run the same command again"),
    ],
)
def test_what_to_do_about_a_server_depends_on_its_error(status, body, advice) -> None:
    class Handler(BaseHTTPRequestHandler):
        def do_GET(self) -> None:
            self.send_response(status)
            self.send_header("Content-Length", str(len(body)))
            self.end_headers()
            self.wfile.write(body.encode())

        def log_message(self, *args: object) -> None:
            pass

    with HTTPServer(("127.0.0.1", 0), Handler) as server:
        Thread(target=server.serve_forever, daemon=True).start()
        cfg = ServerConfig(url=[f"http://127.0.0.1:{server.server_port}/v1"], model="any")
        with raises_user_error("no-server", contains=advice):
            served_origin(cfg)
        server.shutdown()


def test_a_revision_identifies_weights_that_a_server_does_not_describe(
    start_server, caplog
) -> None:
    caplog.set_level("INFO")
    cfg = SelectCommand(student=STUDENT, server=config_of(start_server(lambda _: FULL)))
    unpinned, pinned = (
        ServedModel(cfg, None, replace(STUDENT, revision=rev)).identity for rev in (None, "c0ffee")
    )
    assert unpinned != pinned
    assert "student.revision=COMMIT" in caplog.text


def test_requests_carry_the_api_key(items, frames, start_server, tmp_path, monkeypatch) -> None:
    server = start_server(lambda _: FULL)
    server.key = "secret"
    log = open_log(tmp_path, items)
    monkeypatch.delenv("OPENAI_API_KEY", raising=False)
    for request in (
        lambda: served_origin(config_of(server)),
        lambda: collect_responses(items, "record", responder(config_of(server), frames), log),
    ):
        with raises_user_error("invalid-api-key", contains=(server.url, "OPENAI_API_KEY")):
            request()
    monkeypatch.setenv("OPENAI_API_KEY", "sec\rret")
    with raises_user_error("invalid-api-key", contains="OPENAI_API_KEY"):
        served_origin(config_of(server))
    monkeypatch.setenv("OPENAI_API_KEY", "secret\n")
    assert served_origin(config_of(server))["root"] == "weights"
    answers = collect_responses(items, "record", responder(config_of(server), frames), log)
    assert [a.letter for a in answers] == ["C"] * 8


def test_a_student_and_its_base_are_not_confused(start_server, tmp_path) -> None:
    server = start_server(lambda _: FULL)
    cfg = SelectCommand(server=replace(config_of(server), model=None), student=STUDENT)
    with raises_user_error("missing-server-model", contains="server.model=NAME"):
        ServedModel(cfg, tmp_path, STUDENT)
    adapter = replace(cfg, server=replace(config_of(server), model="adapter"))
    with raises_user_error("adapter-without-run", contains="model=RUN"):
        ServedModel(adapter, None, STUDENT)


def test_adapters_over_an_unquantised_base_are_warned_of(start_server, tmp_path, caplog) -> None:
    cfg = SelectCommand(server=replace(config_of(start_server(lambda _: FULL)), model="adapter"))
    ServedModel(cfg, tmp_path, replace(STUDENT, quantization="none"))
    assert not caplog.text
    ServedModel(cfg, tmp_path, STUDENT)
    assert "NF4" in caplog.text


def test_servers_of_two_models_with_one_name_are_refused(start_server) -> None:
    one, same, other = (start_server(lambda _: FULL) for _ in range(3))
    server = replace(config_of(one), url=[one.url, same.url])
    assert served_origin(server) == served_origin(config_of(one))
    other.root = "others"
    with raises_user_error("different-models", contains=(one.url, other.url)):
        served_origin(replace(server, url=[one.url, same.url, other.url]))


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
    assert report["calibration"]["constrained"]["n"] == 6
    assert report["positions"]["constrained"]["chosen"]["C"] == 6
