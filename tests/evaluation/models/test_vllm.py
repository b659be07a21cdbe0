"""A real vLLM server with a small Qwen3-VL: it receives the same inputs as a local model."""

from __future__ import annotations

from dataclasses import replace

import openai
import pytest
import torch
from transformers import AutoProcessor

from dynapix.conf.files import read_json_lines
from dynapix.conf.schema import LoraConfig, SelectCommand, ServerConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.evaluation import select
from dynapix.evaluation.generators.generator import item_sample
from dynapix.models import loading
from dynapix.models.student.chat_requests import build_messages, qwen_fields, sampling_fields
from dynapix.models.student.collator import Collator, encode
from dynapix.train.student import dataset
from tests.evaluation.models.conftest import STUDENT, new_run
from tests.teacher.server_process import vllm_server
from tests.tiny_models import randomize_adapters

pytestmark = pytest.mark.slow


@pytest.fixture(scope="module")
def cfg(tmp_path_factory, micro_store):
    """Settings of a base on disk. Its processor has other image sizes than the preset and a chat
    template with vision tokens around a clip, like a released one, and normalises images
    differently from clips, like that of the tiny base."""
    folder = tmp_path_factory.mktemp("base")
    model, processor = loading.load_base(
        STUDENT, "fp32", lambda: dataset.tokenizer_corpus(micro_store, [])
    )
    processor.image_processor.image_mean = [0.4, 0.45, 0.5]
    marked = "<|vision_start|><|video_pad|><|vision_end|>"
    processor.chat_template = processor.chat_template.replace("<|video_pad|>", marked)
    loading.save_student(model, processor, folder, "fp32")
    assert marked in AutoProcessor.from_pretrained(folder).chat_template
    return replace(STUDENT, model=str(folder), architecture=None)


@pytest.fixture(scope="module")
def student(cfg, tmp_path_factory):
    """A student with adapters over that base, and the folder of the adapters. They are random, and
    large enough to change its responses."""
    folder = tmp_path_factory.mktemp("student")
    torch.manual_seed(0)
    model, processor = loading.load_student(replace(cfg, lora=LoraConfig(rank=4)), "fp32", list)
    randomize_adapters(model, 0.2)
    loading.save_student(model, processor, folder, "fp32")
    return model.eval(), processor, folder


@pytest.fixture(scope="module")
def server(cfg, student, tmp_path_factory):
    folder = tmp_path_factory.mktemp("serve")
    adapter = f"adapter={student[-1]}"
    serving = vllm_server(cfg.model, folder, "frames=true", "dtype=float32", adapter)
    serving.start()
    yield serving
    serving.stop()


def ask(server, cfg, sample, model: str = "tiny", **fields: object):
    """Request one token of a response."""
    request = sampling_fields(cfg, 1)
    extra = {"return_token_ids": True, "return_tokens_as_token_ids": True}
    request["extra_body"] |= qwen_fields(cfg, sample.clip) | extra
    request |= {"model": model, "messages": build_messages(sample), **fields}
    client = openai.OpenAI(base_url=server.url, api_key="none")
    return client.chat.completions.create(**request)


def test_requests_become_the_inputs_of_a_local_model(server, cfg, student, micro_store) -> None:
    model, processor, _ = student
    frames, items = FrameReader(micro_store, cfg.image_size), micro_store.selection("test")
    modes = {None: "record", "shuffled_prefix": "answer", "candidate_only": "record"}
    for (control, mode), item in zip(modes.items(), items, strict=False):
        sample = item_sample("cot", frames, cfg, control, mode, item)
        ids = encode(sample, processor, 1500).input_ids
        assert ask(server, cfg, sample).model_extra["prompt_token_ids"] == ids

    # A server with adapters responds as the student. Without them, the probabilities differ.
    sample = item_sample("cot", frames, cfg, None, "answer", items[0])
    response = ask(server, cfg, sample, "adapter", logprobs=True, top_logprobs=10)
    top = response.choices[0].logprobs.content[0].top_logprobs
    tokens = [int(each.token.removeprefix("token_id:")) for each in top]
    inputs = Collator(processor, cfg.max_length)([sample])
    with torch.no_grad():
        adapted = model(**inputs).logits[0, -1].log_softmax(dim=-1)[tokens]
        with model.disable_adapter():
            plain = model(**inputs).logits[0, -1].log_softmax(dim=-1)[tokens]
    served = [each.logprob for each in top]
    assert served == pytest.approx(adapted.tolist(), abs=1e-3)
    assert served != pytest.approx(plain.tolist(), abs=0.1)


def test_constrained_responses_of_a_served_model_are_records(
    server, cfg, micro, micro_store, tmp_path, caplog
) -> None:
    caplog.set_level("INFO")
    settings = SelectCommand(
        benchmark=micro, student=replace(cfg, max_new_tokens=60, temperature=0.7), limit=4,
        store=str(micro_store.folder.parent), modes=["answer", "constrained"],
        server=ServerConfig(url=server.url, model="tiny"),
    )  # fmt: skip
    run = new_run(tmp_path)
    metrics = select.main.__wrapped__(settings, run)
    assert "applies the JSON schema as response_format" in caplog.text
    # The server has the same tokens as a local model.
    assert "prompts are not compared" not in caplog.text
    assert "reads prompts differently" not in caplog.text
    # Without a constraint, random weights write no choice.
    assert metrics["constrained_parse_rate"] == 1
    asked, *rows = read_json_lines(run.folder / "answers.jsonl")
    assert asked["asked"]["model"]["root"] == cfg.model
    # Concurrent responses depend on their own seeds.
    again = new_run(tmp_path / "again")
    select.main.__wrapped__(replace(settings, modes=["answer"]), again)
    texts = {row["text"] for row in rows if row["mode"] == "answer" and "text" in row}
    assert len(texts) == 4
    _, *repeated = read_json_lines(again.folder / "answers.jsonl")
    assert {row["text"] for row in repeated} == texts
