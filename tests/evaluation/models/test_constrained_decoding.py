"""Constrained decoding of a local model, and the log of its responses."""

from __future__ import annotations

import json
from dataclasses import replace

import jsonschema
import pytest

from dynapix.conf.entry import Run
from dynapix.conf.files import read_json_lines
from dynapix.conf.schema import SelectCommand
from dynapix.evaluation import select
from dynapix.evaluation.generators.response_log import ResponseLog
from dynapix.evaluation.generators.response_schema import build_record_schema
from dynapix.models.student.answer_parser import parse_choice
from tests.evaluation.models.conftest import STUDENT


@pytest.mark.slow
@pytest.mark.parametrize("temperature", [0, 1])
def test_constrained_decoding_yields_records_only(
    micro, micro_store, tmp_path, temperature
) -> None:
    student = replace(STUDENT, max_new_tokens=900, temperature=temperature)
    cfg = SelectCommand(
        benchmark=micro, student=student, store=str(micro_store.folder.parent), limit=4, batch=3
    )
    metrics = select.main.__wrapped__(cfg, Run("constrained", tmp_path))
    assert metrics["constrained_parse_rate"] == 1 > metrics["record_parse_rate"]
    rows = list(read_json_lines(tmp_path / "answers.jsonl"))
    constrained = [row for row in rows if row["mode"] == "constrained" and "text" in row]
    assert len(constrained) == 4
    for row in constrained:
        assert parse_choice(row["text"]).letter == row["letter"]
        # A model with random weights may write texts up to the token limit, which cuts the record,
        # and control characters, which `strict` would refuse.
        if not row["truncated"]:
            record = json.loads(row["text"], strict=False)
            jsonschema.validate(record, build_record_schema())
            assert list(record) == list(build_record_schema()["properties"])


def test_the_log_is_append_only(micro_store, tmp_path) -> None:
    path, items = tmp_path / "answers.jsonl", micro_store.selection("test")[:2]
    ResponseLog(path, {"answer": {"seed": 0}}, items)
    torn = path.read_bytes() + b'{"item_id": "to'
    path.write_bytes(torn)
    ResponseLog(path, {"answer": {"seed": 1}}, items)
    assert path.read_bytes().startswith(torn + b"\n{")
    before = path.read_bytes()
    ResponseLog(path, {"answer": {"seed": 0}}, items)
    assert path.read_bytes() == before
