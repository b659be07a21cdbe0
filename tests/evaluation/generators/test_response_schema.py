"""The structured record: its parser, its instruction and its JSON schema."""

import json
from dataclasses import asdict, fields

import pytest
from jsonschema import Draft202012Validator

from dynapix.evaluation.generators.response_schema import (
    FIELDS,
    Record,
    build_record_schema,
    read_record,
    write_record_instruction,
)
from dynapix.models.student.answer_parser import parse_choice

RECORD = Record(
    "C",
    0.55,
    {"A": 0.1, "B": 0.3, "C": 0.55, "D": 0.05},
    "B",
    "some",
    {"A": "Too early.", "B": 'It is "B", nearly.', "C": "Answer: it fits.", "D": "{À\u2028中}\t"},
    "The red cube has come to rest; Option A has it moving.",
)
FULL = json.dumps(asdict(RECORD))


def test_the_choice_of_a_record_is_parsed():
    for indent in (None, 1, 4):
        raw = json.dumps(asdict(RECORD), indent=indent)
        assert parse_choice(raw).letter == "C"
        assert read_record(raw) == RECORD
        assert {parse_choice(raw[:stop]).letter for stop in range(len(raw))} == {"C", None}


def test_a_record_is_valid_exactly_if_its_schema_accepts_it():
    """Checked on many records that differ from a valid record in one field."""
    validator = Draft202012Validator(build_record_schema(bound=False))
    Draft202012Validator.check_schema(build_record_schema())
    values = [None, True, -0.1, 1.1, 0, 1, "", "A", "e", "none", "N", {}, [], {"A": 1}, "0.5"]
    record = asdict(RECORD)
    changed = [{**record, name: value} for name in record for value in values]
    changed += [{k: v for k, v in record.items() if k != name} for name in record]
    changed += [{**record, "note": ""}, {**record, "distribution": {"A": 1, "B": 0, "C": 0}}]
    found = [read_record(json.dumps(value)) for value in changed]
    assert [each is not None for each in found] == [validator.is_valid(value) for value in changed]
    assert 0 < found.count(None) < len(changed)


@pytest.mark.parametrize(
    "raw",
    [
        FULL.replace("0.55", "NaN", 1),
        FULL.replace("0.55", "1e999", 1),
        FULL[:-1],
        FULL + FULL,
        f"<think>{FULL}",
        '{"forced_choice": "C", "confidence": ' + "[" * 100_000,
    ],
)
def test_a_response_without_exactly_one_json_record_is_invalid(raw):
    assert read_record(raw) is None


def test_prompt_and_schema_have_the_fields_of_the_record_in_its_order():
    names, schema = [f.name for f in fields(Record)], build_record_schema()
    assert list(FIELDS) == list(schema["properties"]) == schema["required"] == names
    positions = [write_record_instruction().index(f'"{name}"') for name in names]
    assert positions == sorted(positions)
