"""The structured record: its parser, its instruction and its JSON schema."""

import json

import pytest
from jsonschema import Draft202012Validator

from dynapix.evaluation.generators.response_schema import (
    FIELDS,
    build_record_schema,
    is_valid_record,
    write_record_instruction,
)
from dynapix.models.student.answer_parser import parse_choice

RECORD = {
    "forced_choice": "C",
    "confidence": 0.55,
    "distribution": {"A": 0.1, "B": 0.3, "C": 0.55, "D": 0.05},
    "second_choice": "B",
    "ambiguity": "some",
    "rationales": {"A": "Early.", "B": 'It is "B".', "C": "Answer: it fits.", "D": "{À\u2028中}\t"},
    "justification": "The red cube has come to rest; Option A has it moving.",
}
FULL = json.dumps(RECORD)


def test_the_choice_of_a_record_is_parsed():
    for indent in (None, 1, 4):
        raw = json.dumps(RECORD, indent=indent)
        assert parse_choice(raw).letter == "C"
        assert {parse_choice(raw[:stop]).letter for stop in range(len(raw))} == {"C", None}


def test_a_record_is_valid_exactly_if_its_schema_accepts_it():
    """Checked on many records that differ from a valid record in one field."""
    validator = Draft202012Validator(build_record_schema(bound=False))
    Draft202012Validator.check_schema(build_record_schema())
    values = [None, True, -0.1, 1.1, 0, 1, "", "A", "e", "none", "N", {}, [], {"A": 1}, "0.5"]
    changed = [{**RECORD, name: value} for name in RECORD for value in values]
    changed += [{k: v for k, v in RECORD.items() if k != name} for name in RECORD]
    changed += [{**RECORD, "note": ""}, {**RECORD, "distribution": {"A": 1, "B": 0, "C": 0}}]
    valid = [is_valid_record(json.dumps(value)) for value in (RECORD, *changed)]
    assert valid == [True, *map(validator.is_valid, changed)]
    assert not all(valid)


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
    assert not is_valid_record(raw)


def test_prompt_and_schema_have_the_same_fields_in_the_same_order():
    names, schema = list(RECORD), build_record_schema()
    assert list(FIELDS) == list(schema["properties"]) == schema["required"] == names
    positions = [write_record_instruction().index(f'"{name}"') for name in names]
    assert positions == sorted(positions)
