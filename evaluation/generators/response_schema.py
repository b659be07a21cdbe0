"""The structured record of a response: its prompt, its JSON schema, and how it is read.

Only the forced choice is scored. The other fields reveal refusals, hedges and ties.
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
"""How hard the candidates are to distinguish."""
SHORT, LONG = 200, 400
"""Maximum characters of a candidate's rationale and of the justification: a record fits in the 512
new tokens of a response."""
FIELDS = {
    "forced_choice": "the letter of the one candidate that you choose, however unsure you are",
    "confidence": "how sure you are that it is right, a number from 0 to 1",
    "distribution": "an object that gives each of the letters A, B, C and D its probability",
    "second_choice": "the letter of the candidate that you would choose next",
    "ambiguity": f"how hard the candidates are to tell apart, one of {', '.join(AMBIGUITY)}",
    "rationales": "an object that gives each of the letters one short sentence for or against it",
    "justification": "one or two sentences on why you choose as you do",
}
"""Fields and their instructions, in the order of the record."""


@dataclass(frozen=True)
class Record:
    """A valid record.

    `confidence` and the probabilities are from 0 to 1; the probabilities need not sum to 1.
    """

    forced_choice: str
    confidence: float
    distribution: dict[str, float]
    second_choice: str
    ambiguity: str
    rationales: dict[str, str]
    justification: str


def instruction() -> str:
    """Return the instruction of the record modes."""
    fields = "\n".join(f'"{name}": {meaning}' for name, meaning in FIELDS.items())
    return (
        f"Reply with one JSON object and nothing else. It has these keys, in this order:\n{fields}"
    )


def schema(bound: bool = True) -> dict[str, Any]:
    """Return the record's JSON schema; `bound` limits the length of its texts."""
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
    """Return the record in a response, or None unless it is valid.

    It must be the only record with a choice, be JSON that the schema accepts, and name one letter.
    Text around it is ignored.
    """
    answer = parse_choice(raw)
    if answer.record is None or answer.letter is None:
        return None
    try:
        value = json.loads(answer.record, parse_constant=_refuse_constant)
    except ValueError:
        return None
    return Record(**value) if _validator().is_valid(value) else None


def _refuse_constant(word: str) -> float:
    """Python reads NaN and Infinity, which are not JSON."""
    raise ValueError(f"{word} is not JSON")


@cache
def _validator() -> Draft202012Validator:
    # The prompt names no length limit, so a response may exceed it.
    return Draft202012Validator(schema(bound=False))
