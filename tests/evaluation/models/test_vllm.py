"""A real vLLM server with a small Qwen3-VL: it receives the same inputs as a local model."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import openai
import pytest
import torch
from transformers import AutoModelForImageTextToText, AutoProcessor

from dynapix.conf.entry import Run
from dynapix.conf.files import read_json_lines
from dynapix.conf.schema import LoraConfig, SelectCommand, ServerConfig, StudentConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.evaluation import select
from dynapix.evaluation.generators.generator import item_sample
from dynapix.evaluation.generators.response_schema import build_record_schema
from dynapix.models import loading
from dynapix.models.compat import write_clips_as_released
from dynapix.models.student.answer_parser import Reason, parse_choice
from dynapix.models.student.chat_requests import build_messages, qwen_fields, sampling_fields
from dynapix.models.student.collator import Collator, encode
from dynapix.train.student import dataset
from tests.teacher.server_process import vllm_server
from tests.tiny_models import SMALL, randomize_adapters

pytestmark = pytest.mark.slow

STUDENT = StudentConfig(
    name="small", architecture=SMALL, quantization="none", lora=LoraConfig(rank=0), image_size=96,
    max_length=1500, max_new_tokens=600,
)  # fmt: skip


@pytest.fixture(scope="module")
def base(tmp_path_factory, micro_store):
    """A base on disk. Its processor has other image sizes than the preset and a chat template with
    vision tokens around a clip, like a released one, and normalises images differently from clips,
    like that of the tiny base."""
    folder = tmp_path_factory.mktemp("base")
    model, processor = loading.load_base(
        STUDENT, "fp32", lambda: dataset.tokenizer_corpus(micro_store, [])
    )
    processor.image_processor.image_mean = [0.4, 0.45, 0.5]
    marked = "<|vision_start|><|video_pad|><|vision_end|>"
    processor.chat_template = processor.chat_template.replace("<|video_pad|>", marked)
    loading.save_student(model, processor, folder, "fp32")
    assert marked in AutoProcessor.from_pretrained(folder).chat_template
    return folder


def load_processor(folder, cfg):
    processor = AutoProcessor.from_pretrained(folder)
    write_clips_as_released(processor)
    loading.pin_sizes(processor, cfg.image_size, cfg.frames)
    return processor


@pytest.fixture(scope="module")
def cfg(base):
    return replace(STUDENT, model=str(base), architecture=None)


@pytest.fixture(scope="module")
def adapters(cfg, tmp_path_factory):
    """Adapters over that base, random and large enough to change its responses."""
    folder = tmp_path_factory.mktemp("student")
    torch.manual_seed(0)
    trained = replace(cfg, lora=LoraConfig(rank=4))
    model, processor = loading.load_student(trained, "fp32", list)
    randomize_adapters(model, 0.2)
    loading.save_student(model, processor, folder, "fp32")
    return folder


@pytest.fixture(scope="module")
def merged(cfg, adapters, tmp_path_factory):
    """These adapters merged into the base, as `train.export` merges them."""
    folder = tmp_path_factory.mktemp("merged")
    model, processor = loading.load_base(cfg, "fp32", list)
    loading.write_model(loading.merge_adapters(model, adapters, "none", "fp32"), processor, folder)
    return folder


@pytest.fixture(scope="module")
def server(base, adapters, tmp_path_factory):
    folder = tmp_path_factory.mktemp("serve")
    serving = vllm_server(base, folder, "frames=true", "dtype=float32", f"adapter={adapters}")
    serving.start()
    yield serving
    serving.stop()


@pytest.mark.parametrize("control", [None, "shuffled_prefix", "candidate_only"])
def test_requests_become_the_token_ids_of_a_local_model(
    server, cfg, base, micro_store, control
) -> None:
    frames, processor = FrameReader(micro_store, cfg.image_size), load_processor(base, cfg)
    client = openai.OpenAI(base_url=server.url, api_key="none")
    for mode, item in zip(("record", "answer"), micro_store.selection("test"), strict=False):
        sample = item_sample("cot", frames, cfg, control, mode, item)
        request = sampling_fields(cfg, 1)
        request["extra_body"] |= qwen_fields(cfg, sample.clip)
        request["extra_body"]["return_token_ids"] = True
        response = client.chat.completions.create(
            model="tiny", messages=build_messages(sample), **request
        )
        ids = encode(sample, processor, 1500).input_ids
        assert response.model_extra["prompt_token_ids"] == ids


def test_constrained_responses_of_a_served_model_are_records(
    server, cfg, micro, micro_store, tmp_path, caplog
) -> None:
    caplog.set_level("INFO")
    settings = SelectCommand(
        benchmark=micro, student=cfg, store=str(micro_store.folder.parent), limit=4,
        modes=["answer", "constrained"], server=ServerConfig(url=server.url, model="tiny"),
    )  # fmt: skip
    metrics = select.main.__wrapped__(settings, Run("served", tmp_path))
    assert "applies the JSON schema as response_format" in caplog.text
    # The server has the same tokens as a local model.
    assert "prompts are not compared" not in caplog.text
    assert "reads prompts differently" not in caplog.text
    rows = list(read_json_lines(tmp_path / "answers.jsonl"))
    assert rows[0]["asked"]["model"]["root"] == cfg.model
    # A model with random weights may write texts up to the token limit. The choice precedes them.
    assert metrics["constrained_parse_rate"] == 1
    for row in [r for r in rows if r.get("mode") == "constrained"][1:]:
        found = parse_choice(row["text"])
        assert found.letter == row["letter"]
        assert row["valid"] or (row["truncated"] and found.reason is Reason.CUT_OFF)
        names = [
            f'"{name}"'
            for name in build_record_schema()["properties"]
            if f'"{name}"' in row["text"]
        ]
        assert names == sorted(names, key=row["text"].index)


def test_concurrent_sampled_responses_depend_on_their_own_seeds(
    server, cfg, micro, micro_store, tmp_path
) -> None:
    sampled = replace(cfg, temperature=0.7, max_new_tokens=16)
    command = SelectCommand(
        benchmark=micro, student=sampled, store=str(micro_store.folder.parent), modes=["answer"],
        server=ServerConfig(url=server.url, model="tiny", unreachable_timeout=5),
    )  # fmt: skip

    def answers(name: str, **settings: object) -> dict[str, str]:
        folder = tmp_path / name
        folder.mkdir()
        select.main.__wrapped__(replace(command, **settings), Run(name, folder))
        rows = list(read_json_lines(folder / "answers.jsonl"))
        return {row["item_id"]: row["text"] for row in rows if "item_id" in row}

    texts = answers("first")
    # So many concurrent requests have more prompt tokens than the server processes in one step.
    assert len(texts) >= command.server.concurrency
    assert len(set(texts.values())) > len(texts) // 2
    assert answers("again") == texts
    assert answers("other", seed=1) != texts


def test_a_server_with_adapters_responds_as_the_student(
    server, cfg, base, merged, micro_store
) -> None:
    inputs = cfg, micro_store, micro_store.selection("test")[0]
    tokens, served = served_scores(server, "adapter", *inputs)
    assert served == pytest.approx(local_scores(merged, *inputs)[tokens], abs=1e-3)
    # Without the adapters the probabilities differ.
    assert served != pytest.approx(local_scores(base, *inputs)[tokens], abs=0.1)


def served_scores(server, model, cfg, store, item) -> tuple[list[int], list[float]]:
    """The most likely first tokens of an answer, and their log-probabilities."""
    sample = item_sample("cot", FrameReader(store, cfg.image_size), cfg, None, "answer", item)
    request = sampling_fields(cfg, 1)
    request["extra_body"] |= qwen_fields(cfg, sample.clip)
    request |= {"logprobs": True, "top_logprobs": 10}
    request["extra_body"]["return_tokens_as_token_ids"] = True
    client = openai.OpenAI(base_url=server.url, api_key="none")
    response = client.chat.completions.create(
        model=model, messages=build_messages(sample), **request
    )
    top_tokens = response.choices[0].logprobs.content[0].top_logprobs
    tokens = [int(top.token.removeprefix("token_id:")) for top in top_tokens]
    return tokens, [top.logprob for top in top_tokens]


def local_scores(folder, cfg, store, item) -> np.ndarray:
    """The log-probability of every first token, computed with transformers alone."""
    sample = item_sample("cot", FrameReader(store, cfg.image_size), cfg, None, "answer", item)
    processor = load_processor(folder, cfg)
    model = AutoModelForImageTextToText.from_pretrained(folder, dtype="auto").eval()
    with torch.no_grad():
        logits = model(**Collator(processor, cfg.max_length)([sample])).logits
    return logits[0, -1].log_softmax(dim=-1).numpy()
