"""Find the records in a response: JSON objects with the key `choice` or `forced_choice`.

Records of real models are often no valid JSON: they contain comments, lack quotes or commas, or are
cut off. So a record is read as a sequence of tokens.
"""

from __future__ import annotations

import json
import re
from dataclasses import dataclass

_COMMENT = re.compile(r'("(?:[^"\\\n]|\\.)*")|(?<![:\w/])//[^\n]*|/\*.{0,500}?\*/', re.DOTALL)
_RECORD_START = re.compile(r"""\{\s*(?:["']|(?:forced[ _-]?)?choice\s*:)""", re.IGNORECASE)
_STRING = r""""(?:[^"\\]|\\.)*"|'(?:[^'\\]|\\.)*'"""
_VALUE = (
    rf"""(?:{_STRING}|\[[^\[\]{{}}]*\]|[^"'\[\]{{}},\n]){{1,200}}?"""
    r"""(?=\s*(?:[,}\n]|$|["']\w+["']\s*:))"""
)
_WRAPPER = r"[a-z_ ]{0,20}(?:answer|response|result|output|record|arguments|parameters)"
_TOKEN = re.compile(
    r"""(?:(?P<quote>["'])|(?<![\w"']))(?:(?P<key>(?:forced[ _-]?)?choice)|"""
    rf"""(?P<other>(?:final_?)?(?:answer|choice)|letter)|(?P<wrapper>{_WRAPPER}))"""
    rf"""(?(quote)(?P=quote))\s*:\s*(?:(?P<nested>(?={{))|(?(wrapper)(?!))(?P<value>{_VALUE})?)"""
    rf"""|{_STRING}|[{{}}]|["']""",
    re.IGNORECASE,
)


@dataclass(frozen=True)
class AnswerRecord:
    """A record in a response.

    Attributes:
        before: The text between the record and the one before it.
        text: The text of the record, without comments.
        choices: The values of the choice; None for one that cannot be read.
        others: The values of other keys that may name the choice, such as `answer`.
        is_valid: Whether the record is valid JSON.
        is_complete: Whether it is not cut off.
    """

    before: str
    text: str
    choices: list[str | None]
    others: list[str | None]
    is_valid: bool
    is_complete: bool


def read_records(text: str) -> tuple[list[AnswerRecord], str]:
    """Return the objects in a text, also those without a choice, and the text after the last."""
    records, position = [], 0
    plain = _COMMENT.sub(lambda found: found[1] or "", text) if "{" in text else text
    if '"{\\"' in plain:  # a record within a string, as the arguments of tool calls are written
        plain = plain.replace('"{\\"', '{"').replace('}"', "}").replace('\\"', '"')
    while match := _RECORD_START.search(plain, position):
        found, end = _read_record(plain, match.start())
        before, position, stop = plain[position : match.start()], end or len(plain), end
        own = plain[match.start() : position]
        choices = [_unquote(value) for is_choice, value in found if is_choice]
        others = [_unquote(value) for is_choice, value in found if not is_choice]
        is_valid = text == plain and _is_json(own)
        records.append(AnswerRecord(before, own, choices, others, is_valid, stop is not None))
    return records, plain[position:]


def _read_record(text: str, start: int) -> tuple[list[tuple[bool, str | None]], int | None]:
    """Return the values in the record that begins at `start` with whether they are choices (None
    for an unreadable one), and the record's end (None if it is cut off).

    A record has a choice at its outermost level, or in an object that contains the record. Then
    choices at deeper levels count too: another record may begin inside one that was broken off.
    """
    found, depth, outermost, is_record = [], 0, 1, False
    for token in _TOKEN.finditer(text, start):
        if token[0] in "\"'":
            break
        value, is_key = token["value"], token["key"] is not None
        is_cut = value and token.end() == len(text) and value.strip()[-1] not in "\"']"
        if (token["wrapper"] or is_key) and token["nested"] is not None:
            outermost = max(outermost, depth + 1)
            is_record |= is_key and depth == 1
        elif not is_cut and (is_key or (token["other"] and value and depth <= outermost)):
            found.append((is_key or (depth > 1 and is_record), value))
            is_record |= is_key and depth <= outermost
        depth += (token[0] == "{") - (token[0] == "}")
        if depth == 0:
            break
    if not is_record:
        found = [each for each in found if not each[0]]
    return found, token.end() if depth == 0 else None


def _is_json(text: str) -> bool:
    try:
        json.loads(text)
    except (ValueError, RecursionError):
        return False
    return True


def _unquote(value: str | None) -> str | None:
    if value is None or not value.startswith('"'):
        return value
    try:
        return str(json.loads(value, strict=False))
    except ValueError:
        return value
