"""The structured record that a model is asked for, and how what it says is read.

Only the record's forced choice is scored. The other fields let a refusal, a hedge or a tie be seen
that a bare letter would hide.
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cache
from typing import Any

from jsonschema import Draft202012Validator

from data.records import LETTERS
from models.student.answer_parser import parse_choice

AMBIGUITY = ("none", "some", "high")
"""How hard the candidates are to tell apart."""
SHORT, LONG = 200, 400
"""Characters that the schema gives a candidate's rationale and the justification, so that a record
ends within the 512 tokens of an answer."""
FIELDS = {
    "forced_choice": "the letter of the one candidate that you choose, however unsure you are",
    "confidence": "how sure you are that it is right, a number from 0 to 1",
    "distribution": "an object that gives each of the letters A, B, C and D its probability",
    "second_choice": "the letter of the candidate that you would choose next",
    "ambiguity": f"how hard the candidates are to tell apart, one of {', '.join(AMBIGUITY)}",
    "rationales": "an object that gives each of the letters one short sentence for or against it",
    "justification": "one or two sentences on why you choose as you do",
}
"""What is asked for, in the order in which it is to be written."""


@dataclass(frozen=True)
class Record:
    """A valid record. `confidence` and the probabilities lie between 0 and 1; nothing holds the
    probabilities to a sum of 1."""

    forced_choice: str
    confidence: float
    distribution: dict[str, float]
    second_choice: str
    ambiguity: str
    rationales: dict[str, str]
    justification: str


def instruction() -> str:
    """What a model is told to write."""
    fields = "\n".join(f'"{name}": {meaning}' for name, meaning in FIELDS.items())
    return (
        f"Reply with one JSON object and nothing else. It has these keys, in this order:\n{fields}"
    )


def schema(bound: bool = True) -> dict[str, Any]:
    """The record's JSON schema, its properties in the order in which they are written; `bound`
    keeps the texts short."""
    letter = {"enum": list(LETTERS)}
    share = {"type": "number", "minimum": 0, "maximum": 1}
    properties = {
        "forced_choice": letter,
        "confidence": share,
        "distribution": _object(dict.fromkeys(LETTERS, share)),
        "second_choice": letter,
        "ambiguity": {"enum": list(AMBIGUITY)},
        "rationales": _object(dict.fromkeys(LETTERS, _text(bound and SHORT))),
        "justification": _text(bound and LONG),
    }
    return _object(properties)


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "object",
        "properties": properties,
        "required": list(properties),
        "additionalProperties": False,
    }


def _text(most: int) -> dict[str, Any]:
    return {"type": "string", "maxLength": most} if most else {"type": "string"}


def read_record(raw: str) -> Record | None:
    """The record in a model's output, where it is valid: the one that holds a choice, JSON that
    has every field as the schema has it, and one letter that nothing contradicts. What stands
    around it does not count."""
    choice = parse_choice(raw)
    if choice.record is None or choice.letter is None:
        return None
    try:
        value = json.loads(choice.record, parse_constant=_no_number)
    except ValueError:
        return None
    return Record(**value) if _validator().is_valid(value) else None


def _no_number(word: str) -> float:
    """Python reads NaN and Infinity, which JSON does not have."""
    raise ValueError(f"{word} is no number")


@cache
def _validator() -> Draft202012Validator:
    # A model that is not held to the schema is told of no bound.
    return Draft202012Validator(schema(bound=False))
