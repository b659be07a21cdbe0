"""A real vLLM server with a small Qwen3-VL is asked with frames, as the model is where it is loaded
here."""

from __future__ import annotations

import json
from dataclasses import replace

import openai
import pytest
from transformers import AutoProcessor

from conf.entry import Run
from conf.schema import ArchitectureConfig, LoraConfig, SelectCommand, ServerConfig, StudentConfig
from data.frames import Frames
from evaluation import select
from evaluation.asked import shown
from evaluation.protocol import Reason, parse, schema
from evaluation.served import chat_of, request_of
from tests.teacher.serving import Serving
from train import backbone, samples
from train.collate import encode

pytestmark = pytest.mark.slow

SMALL = ArchitectureConfig(
    hidden=64, layers=2, heads=2, kv_heads=2, feed_forward=128,
    vision_hidden=64, vision_layers=2, vision_heads=2, vision_feed_forward=128,
)  # fmt: skip
STUDENT = StudentConfig(
    name="small", architecture=SMALL, quantization="none", lora=LoraConfig(rank=0), image_size=96,
    max_length=1500, max_new_tokens=600,
)  # fmt: skip


@pytest.fixture(scope="module")
def base(tmp_path_factory, micro_store):
    """A base on disk, whose processor has sizes of its own, as a released one's has."""
    folder = tmp_path_factory.mktemp("base")
    model, processor = backbone.load_base(STUDENT, "fp32", lambda: samples.corpus(micro_store, []))
    backbone.save(model, processor, folder, "fp32")
    return folder


@pytest.fixture(scope="module")
def server(base, tmp_path_factory):
    serving = Serving(base, tmp_path_factory.mktemp("serve"), "frames=true", "dtype=float32")
    serving.start()
    yield serving
    serving.stop()


@pytest.fixture
def cfg(base):
    return replace(STUDENT, model=str(base), architecture=None)


@pytest.mark.parametrize("control", [None, "shuffled_prefix", "candidate_only"])
def test_the_server_is_asked_with_the_ids_that_a_model_here_reads(
    server, cfg, base, micro_store, control
) -> None:
    frames, processor = Frames(micro_store, cfg.image_size), AutoProcessor.from_pretrained(base)
    backbone.pin_sizes(processor, cfg.image_size, cfg.frames)
    client = openai.OpenAI(base_url=server.url, api_key="none")
    for mode, item in zip(("record", "answer"), micro_store.selection("test"), strict=False):
        sample = shown("cot", frames, cfg, control, mode, item)
        request = request_of(cfg, mode, sample.clip) | {"max_tokens": 1}
        request["extra_body"]["return_token_ids"] = True
        told = client.chat.completions.create(model="tiny", messages=chat_of(sample), **request)
        assert told.model_extra["prompt_token_ids"] == encode(sample, processor, 1500).input_ids


def test_a_served_model_is_measured_by_records(server, cfg, micro, micro_store, tmp_path) -> None:
    asked = SelectCommand(
        benchmark=micro, student=cfg, store=str(micro_store.folder.parent), limit=4,
        modes=["answer", "constrained"], server=ServerConfig(url=server.url, model="tiny"),
    )  # fmt: skip
    served = select.main.__wrapped__(asked, Run("served", tmp_path))
    rows = [json.loads(line) for line in (tmp_path / "answers.jsonl").read_text().splitlines()]
    head, held = rows[0]["asked"], [r for r in rows if r.get("mode") == "constrained"][1:]
    assert head["model"]["root"] == cfg.model
    # A random model may fill the texts to their ends; what it chooses stands before.
    assert served["constrained_parse_rate"] == 1
    for row in held:
        found = parse(row["text"])
        assert found.letter == row["letter"]
        assert row["valid"] or (row["cut"] and found.reason is Reason.CUT_OFF)
        names = [f'"{name}"' for name in schema()["properties"] if f'"{name}"' in row["text"]]
        assert names == sorted(names, key=row["text"].index)
