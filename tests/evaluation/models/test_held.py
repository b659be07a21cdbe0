"""A model that is loaded here is held to the structured record."""

from __future__ import annotations

import json

import jsonschema
import pytest

from conf.entry import Run
from conf.schema import ArchitectureConfig, LoraConfig, SelectCommand, StudentConfig
from evaluation import select
from evaluation.generators.response_log import ResponseLog
from evaluation.generators.response_schema import schema
from models.student.answer_parser import parse_choice

SMALL = ArchitectureConfig(
    hidden=64, layers=1, heads=2, kv_heads=2, feed_forward=64,
    vision_hidden=64, vision_layers=1, vision_heads=2, vision_feed_forward=64,
)  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize("temperature", [0, 1])
def test_a_random_model_writes_records_and_nothing_else(
    micro, micro_store, tmp_path, temperature
) -> None:
    student = StudentConfig(
        name="small", architecture=SMALL, quantization="none", lora=LoraConfig(rank=0),
        image_size=96, max_length=1500, max_new_tokens=900, temperature=temperature,
    )  # fmt: skip
    asked = SelectCommand(
        benchmark=micro, student=student, store=str(micro_store.folder.parent), limit=4, batch=3
    )
    told = select.main.__wrapped__(asked, Run("held", tmp_path))
    assert told["constrained_parse_rate"] == 1 > told["record_parse_rate"]
    rows = [json.loads(line) for line in (tmp_path / "answers.jsonl").read_text().splitlines()]
    held = [row for row in rows if row["mode"] == "constrained" and "text" in row]
    assert len(held) == 4
    for row in held:
        assert parse_choice(row["text"]).letter == row["letter"]
        # A random model may fill the texts to their ends, and with what JSON would escape.
        if not row["cut"]:
            record = json.loads(row["text"], strict=False)
            jsonschema.validate(record, schema())
            assert list(record) == list(schema()["properties"])


def test_answers_are_only_ever_added(micro_store, tmp_path) -> None:
    """What a kill tore stays, ended; what is asked otherwise later comes after it."""
    path, items = tmp_path / "answers.jsonl", micro_store.selection("test")[:2]
    ResponseLog(path, {"answer": {"seed": 0}}, items)
    torn = path.read_bytes() + b'{"item_id": "to'
    path.write_bytes(torn)
    ResponseLog(path, {"answer": {"seed": 1}}, items)
    assert path.read_bytes().startswith(torn + b"\n{")
    whole = path.read_bytes()
    ResponseLog(path, {"answer": {"seed": 0}}, items)
    assert path.read_bytes() == whole
