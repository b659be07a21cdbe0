"""Teachers and samplers on servers: a real vLLM server, and servers with faults."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import asdict, replace
from pathlib import Path

import openai
import pytest
import torch
from torch.nn.functional import log_softmax
from transformers import AutoModelForImageTextToText, ProcessorMixin

from dynapix.conf.entry import Run
from dynapix.conf.runs import open_run
from dynapix.conf.schema import (
    DistillCommand,
    DistillTrainConfig,
    LoraConfig,
    SamplingServerConfig,
    SftCommand,
    TeacherServerConfig,
)
from dynapix.data.store import Store
from dynapix.models import loading
from dynapix.models.student.collator import IGNORED, Collator
from dynapix.models.student.prompts import Sample
from dynapix.models.trained_runs import read_trained_settings
from dynapix.teacher.narrate import ensure_rationales
from dynapix.train import distill
from dynapix.train.common.journal import read_journal
from dynapix.train.on_policy.paired_prompts import load_datasets
from dynapix.train.on_policy.sampling import encode_prompt
from dynapix.train.on_policy.served_sampling import build_sampler
from dynapix.train.on_policy.teachers import ServerTeacher
from tests.local import JsonHandler, LocalServer
from tests.teacher.server_process import ServerProcess, vllm_server
from tests.tiny_models import randomize_adapters
from tests.user_errors import raises_user_error

pytestmark = pytest.mark.slow


def start(model: str, folder: Path, *settings: str) -> ServerProcess:
    server = vllm_server(Path(model), folder, "dtype=float32", *settings)
    server.start()
    return server


@pytest.fixture(scope="module")
def teacher(saved_base: str, tmp_path_factory) -> Iterator[ServerProcess]:
    """The untrained base as a teacher."""
    server = start(saved_base, tmp_path_factory.mktemp("serve"))
    yield server
    server.stop()


@pytest.fixture(scope="module")
def vllm(saved_base: str, tmp_path_factory) -> Iterator[ServerProcess]:
    """The untrained base as that of a student. With adapters enabled, vLLM 0.32 on CPUs crashes
    when it computes the log-probabilities of prompts, so it cannot be the teacher too."""
    folder = tmp_path_factory.mktemp("serve")
    server = start(saved_base, folder, "frames=true", "adapter_rank=4")
    yield server
    server.stop()


@pytest.fixture
def settings(student: Path, micro_store: Store) -> DistillCommand:
    train = DistillTrainConfig(
        lr=1e-2, max_steps=2, batch=4, micro_batch=2, precision="fp32", evaluations=1,
        validation_items=2, generated_items=0,
    )  # fmt: skip
    return DistillCommand(
        model=str(student), store=str(micro_store.folder.parent), workers=1, train=train
    )


@pytest.fixture
def samples(settings, student, micro_store) -> list[Sample]:
    """The teacher's prompts about four items, with the narrator's rationales as responses."""
    trained = read_trained_settings(student, SftCommand, "student")
    rationales = ensure_rationales(micro_store, trained.teacher)
    training, _ = load_datasets(settings, trained, micro_store, rationales)
    texts = [r.text for r in rationales if r.accepted]
    return [replace(training[k].teacher, response=texts[k], supervised=k != 2) for k in range(4)]


def serve(url: str) -> TeacherServerConfig:
    return TeacherServerConfig(url=url, model="tiny", timeout=60, unreachable_timeout=60)


def test_vllm_gives_the_log_probabilities_of_the_same_model(
    teacher: ServerProcess, saved_base: str, processor: ProcessorMixin, samples: list[Sample]
) -> None:
    read = ServerTeacher(serve(teacher.url), processor).prepare([samples[:3], samples[3:]])
    batch = Collator(processor, None)(samples)
    tokens = batch.pop("labels")[:, 1:]
    model = AutoModelForImageTextToText.from_pretrained(saved_base).eval()
    with torch.no_grad():
        found = log_softmax(model(**batch).logits[:, :-1], dim=-1)
    supervised = tokens != IGNORED
    expected = found[supervised].gather(1, tokens[supervised][:, None])[:, 0]
    torch.testing.assert_close(torch.cat(read), expected, rtol=1e-3, atol=1e-3)
    assert len(read[0]) > 10 < len(read[1])


def test_a_student_is_distilled_from_a_server(teacher, settings, tmp_path) -> None:
    run = Run("run", tmp_path)
    cfg = replace(settings, teacher_server=serve(teacher.url))
    distill.main.__wrapped__(cfg, run)
    losses = [r["loss"] for r in read_journal(run.folder) if "loss" in r]
    # The teacher has another prompt than the student.
    assert len(losses) == 2
    assert all(0 < abs(loss) < 20 for loss in losses)


def distance_from_greedy(model, processor, prompts, texts) -> float:
    """Return how far a response's token is at most from the token with the largest logit."""
    answered = [replace(p.sample, response_ids=t.ids) for p, t in zip(prompts, texts, strict=True)]
    batch = Collator(processor, None)(answered)
    tokens = batch.pop("labels")[:, 1:]
    with torch.no_grad():
        logits = model(**batch).logits[:, :-1][tokens != IGNORED]
    chosen = logits.gather(1, tokens[tokens != IGNORED][:, None])[:, 0]
    return float((logits.max(dim=1).values - chosen).max())


def test_vllm_samples_from_the_current_adapters(
    vllm, settings, student, micro_store, tmp_path
) -> None:
    """At a temperature near 0, the tokens have the largest logits of the model in this process."""
    trained = read_trained_settings(student, SftCommand, "student")
    cfg = replace(trained.student, quantization="none", max_new_tokens=12, max_length=4000)
    train = replace(settings.train, temperature=1e-4)
    torch.manual_seed(0)
    model, processor = loading.load_student(cfg, "fp32", list)
    model.eval()
    rationales = ensure_rationales(micro_store, trained.teacher)
    training, _ = load_datasets(settings, trained, micro_store, rationales)
    prompts = [encode_prompt(training[k].student, processor, 4000) for k in range(6)]
    servers = SamplingServerConfig(url=vllm.url, unreachable_timeout=60)
    sampler = build_sampler(processor, cfg, train, servers, tmp_path)
    found = []
    for _ in range(2):
        randomize_adapters(model, 0.6)
        texts = sampler.sample(model, prompts, range(6))
        assert all(text.truncated and len(text.ids) == 12 for text in texts)
        # The server rounds otherwise; other adapters differ by more than 0.5.
        assert distance_from_greedy(model, processor, prompts, texts) < 0.1
        found.append(texts)
    assert distance_from_greedy(model, processor, prompts, found[0]) > 0.5
    assert len(list((tmp_path / "sampled_adapters").iterdir())) == 1
    models = {m.id for m in openai.OpenAI(base_url=vllm.url, api_key="none").models.list()}
    assert len([name for name in models if name.startswith("student-")]) == 1
    sampler.close()
    models = {m.id for m in openai.OpenAI(base_url=vllm.url, api_key="none").models.list()}
    assert not any(name.startswith("student-") for name in models)
    assert not (tmp_path / "sampled_adapters").exists()

    larger = replace(cfg, lora=LoraConfig(rank=16))
    model, _ = loading.load_student(larger, "fp32", list)
    sampler = build_sampler(processor, larger, train, servers, tmp_path / "larger")
    (tmp_path / "larger").mkdir()
    with raises_user_error("no-response", contains="rank"):
        sampler.sample(model, prompts, range(6))


def test_a_student_is_distilled_from_responses_of_a_server(vllm, settings, tmp_path) -> None:
    run = Run("run", tmp_path)
    servers = SamplingServerConfig(url=vllm.url, unreachable_timeout=60)
    train = replace(settings.train, temperature=0.7)
    distill.main.__wrapped__(replace(settings, train=train, sampling_server=servers), run)
    losses = [r for r in read_journal(run.folder) if "loss" in r]
    assert len(losses) == 2
    assert all(r["loss"] > 0 and r["sampled_length"] == 8 for r in losses)
    # The server's base is not quantised. Log-probabilities before the temperature would differ by
    # 0.07 in the mean.
    assert all(0.001 < r["mismatch_mean"] < 0.03 and r["mismatch_max"] < 0.1 for r in losses)
    assert not (run.folder / "sampled_adapters").exists()


class FaultyHandler(JsonHandler):
    """Answers a completion with the tokens of `texts`, or without log-probabilities."""

    texts: list[str] | None = None

    def post(self, body: dict) -> None:
        count = len(body["prompt"])
        logprobs = None
        if self.texts is not None:
            values = [None, *[-1.0] * (count - 1)]
            logprobs = {"tokens": (self.texts * count)[:count], "token_logprobs": values}
        choice = {"index": 0, "text": "", "finish_reason": "length", "logprobs": logprobs}
        self.respond(200, {"id": "0", "object": "text_completion", "choices": [choice]})


@pytest.mark.parametrize(
    ("texts", "code", "message"),
    [
        (None, "no-prompt-logprobs", "returns no log-probabilities of prompts"),
        (["zebra"], "other-tokenizer", "'zebra' on the server"),
    ],
)
def test_unsuitable_servers_are_named(processor, samples, texts, code, message) -> None:
    handler = type("Handler", (FaultyHandler,), {"texts": texts})
    server = LocalServer(handler)
    with raises_user_error(code, contains=message):
        ServerTeacher(serve(server.url), processor).prepare([samples])
    server.stop()


class FixedHandler(JsonHandler):
    """A server that loads no adapters (404), whose responses have no token ids, or that has other
    token ids of the prompt. `scored` is the number of tokens with log-probabilities."""

    loads, ids, scored = True, None, 2

    def post(self, body: dict) -> None:
        if self.path.endswith("/load_lora_adapter"):
            self.respond(200 if self.loads else 404, {})
            return
        message = {"role": "assistant", "content": "Answer: A"}
        scored = [{"token": "", "logprob": -1.0, "top_logprobs": []} for _ in self.ids or ()]
        choice = {
            "index": 0, "message": message, "finish_reason": "stop", "token_ids": self.ids,
            "logprobs": {"content": scored[: self.scored]},
        }  # fmt: skip
        body = {"id": "0", "object": "chat.completion", "choices": [choice]}
        self.respond(200, {**body, "prompt_token_ids": self.ids})


@pytest.mark.parametrize(
    ("loads", "ids", "code", "message"),
    [
        (False, None, "no-adapters", "adapter_rank=RANK"),
        (True, None, "no-token-ids", "return no token ids"),
        (True, [5, 6, 7], "no-token-ids", "or not their log-probabilities"),
        (True, [5, 6], "other-prompts", "at token 0 of the first prompt, this process has"),
    ],
)
def test_servers_that_cannot_sample_are_named(
    settings, student, samples, loads, ids, code, message, tmp_path
) -> None:
    trained = read_trained_settings(student, SftCommand, "student")
    model, processor = loading.load_student(trained.student, "fp32", list)
    server = LocalServer(type("Handler", (FixedHandler,), {"loads": loads, "ids": ids}))
    servers = SamplingServerConfig(url=server.url, unreachable_timeout=5)
    sampler = build_sampler(processor, trained.student, settings.train, servers, tmp_path)
    with raises_user_error(code, contains=message):
        prompts = [encode_prompt(s, processor, 4000) for s in samples]
        sampler.sample(model, prompts, range(len(prompts)))
    server.stop()
    whole = replace(trained.student, lora=LoraConfig(rank=0))
    with raises_user_error("no-adapters", contains="student.lora.rank is 0"):
        build_sampler(processor, whole, settings.train, servers, tmp_path)


def test_two_teachers_and_other_temperatures_are_refused() -> None:
    server = serve("http://127.0.0.1:1/v1")
    problems = DistillCommand(
        teacher_model="run",
        teacher_server=server,
        train=DistillTrainConfig(temperature=0.8),
    ).check()
    assert any("are two teachers" in p for p in problems)
    assert any("train.temperature=0.8 with teacher_server.url" in p for p in problems)
    (problem,) = DistillCommand(teacher_server=replace(server, model=None)).check()
    assert "without teacher_server.model" in problem


def test_a_run_goes_on_with_a_server_at_another_address(settings, tmp_path) -> None:
    run = Run("run", tmp_path)
    open_run(run, asdict(replace(settings, teacher_server=serve("http://a/v1"))), "train.distill")
    (tmp_path / "metrics.jsonl").touch()
    open_run(run, asdict(replace(settings, teacher_server=serve("http://b/v1"))), "train.distill")
    other = replace(serve("http://b/v1"), model="other")
    with raises_user_error("other-settings", contains="teacher_server.model"):
        open_run(run, asdict(replace(settings, teacher_server=other)), "train.distill")
