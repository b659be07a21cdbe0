"""The structured record of a response: its instruction, its JSON schema and its parser.

Only the forced choice is scored.
"""

from __future__ import annotations

import json
from functools import cache
from typing import Any

from jsonschema import Draft202012Validator

from dynapix.data.records import LETTERS
from dynapix.models.student.answer_parser import parse_choice

AMBIGUITY = ("none", "some", "high")
"""Values of `ambiguity`: how hard the candidates are to distinguish."""
MAX_RATIONALE, MAX_JUSTIFICATION = 200, 400
"""Maximum characters of a candidate's rationale and of the justification. A record of this length
fits in 512 tokens, the default of `student.max_new_tokens`."""
FIELDS = {
    "forced_choice": "the letter of the one candidate that you choose, however unsure you are",
    "confidence": "how sure you are that it is right, a number from 0 to 1",
    "distribution": "an object that gives each of the letters A, B, C and D its probability",
    "second_choice": "the letter of the candidate that you would choose next",
    "ambiguity": f"how hard the candidates are to tell apart, one of {', '.join(AMBIGUITY)}",
    "rationales": "an object that gives each of the letters one short sentence for or against it",
    "justification": "one or two sentences on why you choose as you do",
}
"""The fields of a record, in order, with the meaning that the instruction gives them."""


def write_record_instruction() -> str:
    """Return the instruction that requests a record."""
    fields = "\n".join(f'"{name}": {meaning}' for name, meaning in FIELDS.items())
    return (
        f"Reply with one JSON object and nothing else. It has these keys, in this order:\n{fields}"
    )


def build_record_schema(bound: bool = True) -> dict[str, Any]:
    """Return the record's JSON schema. If `bound` is true, it limits the length of the texts."""
    letter = {"enum": list(LETTERS)}
    probability = {"type": "number", "minimum": 0, "maximum": 1}
    properties = {
        "forced_choice": letter,
        "confidence": probability,
        "distribution": _object(dict.fromkeys(LETTERS, probability)),
        "second_choice": letter,
        "ambiguity": {"enum": list(AMBIGUITY)},
        "rationales": _object(dict.fromkeys(LETTERS, _text(bound and MAX_RATIONALE))),
        "justification": _text(bound and MAX_JUSTIFICATION),
    }
    return _object(properties)


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def _text(max_length: int) -> dict[str, Any]:
    return {"type": "string", "maxLength": max_length} if max_length else {"type": "string"}


def is_valid_record(raw: str) -> bool:
    """Return whether a response has a valid record: JSON that the schema accepts, with texts of any
    length. It must be the only record with a choice in the response. The text around it is ignored.
    """
    answer = parse_choice(raw)
    if answer.record is None or answer.letter is None:
        return False
    try:
        value = json.loads(answer.record, parse_constant=_refuse_constant)
    except ValueError:
        return False
    return _validator().is_valid(value)


def _refuse_constant(word: str) -> float:
    """Refuse NaN and Infinity, which Python's parser accepts although they are not JSON."""
    raise ValueError(f"{word} is not JSON")


@cache
def _validator() -> Draft202012Validator:
    # The instruction names no length limits, so a valid record may exceed them.
    return Draft202012Validator(build_record_schema(bound=False))
