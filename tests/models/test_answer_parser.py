"""The parser of responses returns the chosen letter, or the reason why there is none."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest

from dynapix.models.student.answer_parser import ParseFailure, parse_choice
from tests.scaling import SIZE, is_linear

RECORD = {
    "forced_choice": "B",
    "confidence": 0.7,
    "distribution": {"A": 0.1, "B": 0.7, "C": 0.1, "D": 0.1},
    "second_choice": "C",
    "rationales": {"A": "too early", "B": 'it\'s "right" {here}', "C": "late", "D": "other"},
    "justification": "Answer: D would be wrong.",
}
FULL = json.dumps(RECORD)

RAW_ANSWERS = [
    json.loads(line) for line in Path(__file__).with_name("answers.jsonl").read_text().splitlines()
]


@pytest.mark.parametrize("kind", sorted({each["kind"] for each in RAW_ANSWERS}))
def test_raw_answers_of_each_kind(kind):
    """Raw answers as models write them, with the letter that a careful reader takes from them and,
    where it is known, the reason why there is none."""
    for each in (each for each in RAW_ANSWERS if each["kind"] == kind):
        answer = parse_choice(each["raw"])
        assert answer.letter == each["right"], each
        assert "reason" not in each or answer.reason == each["reason"], each
        assert parse_choice(f"\n {each['raw']} \t\n\n").letter == answer.letter, each


def test_a_response_that_is_cut_off_gives_only_a_complete_choice():
    for stop in range(len(FULL)):
        choice, is_stated = parse_choice(FULL[:stop]), stop >= FULL.index(",")
        assert choice.letter == ("B" if is_stated else None)
        reasons = (
            (ParseFailure.CUT_OFF,) if is_stated else (ParseFailure.CUT_OFF, ParseFailure.NO_ANSWER)
        )
        assert choice.reason in reasons
    for raw in ("Answer: B.", "Answer: B\nThe", FULL, FULL[:40]):
        assert parse_choice(raw, truncated=True).letter == "B"
    for raw in ("Answer: B", "B", "Option"):
        assert parse_choice(raw, truncated=True).reason is ParseFailure.CUT_OFF


def test_any_text_gives_a_letter_of_the_item_or_a_reason():
    rng = random.Random(0)
    seeds = [each["raw"] for each in RAW_ANSWERS if "reason" in each]
    tags = ["<think>", "</think>", "Answer:", '{"choice":', "B", "\x00", "\ud800"]
    for _ in range(3000):
        text = list(rng.choice(seeds))
        for _ in range(rng.randint(1, 6)):
            at = rng.randint(0, len(text))
            text[at : at + rng.randint(0, 3)] = rng.choice([*'{}[]"\\:,\n ', *tags])
        choice = parse_choice("".join(text))
        assert choice.letter in (*"ABCD", None)
        assert choice.letter or choice.reason


def test_texts_that_state_no_choice_have_no_letter():
    """Random prose and JSON mention letters and candidates, but choose none."""
    rng = random.Random(0)
    words = ["A", "B", "Candidate C", "D", "cube", "a", "the", "best", "option", "choice", "late"]
    keys = ["confidence", "second_choice", "distribution", "rationales", "about", "my choices"]
    for _ in range(1000):
        prose = " ".join(rng.choices(words, k=rng.randint(6, 30)))
        value = {k: rng.choice([prose, 0.5, "A", {"forced_choice": "B"}]) for k in keys}
        raw = rng.choice(
            [prose, json.dumps(value), f"{json.dumps(value)} {prose}", f"<think>{FULL}"]
        )
        assert parse_choice(raw).letter is None, raw


UNITS = [
    "final\n", "'choice': x ", '{"choice":"B"} ', "{'a': ", '"', "[[", "Answer:\n",
    "the answer is ", "A, ", "I cannot ", " ", "<think>", "</think>", "\\", "A", "\u200b", "{",
    '{"a":', '{"choice":', "\n", "- ",
]  # fmt: skip


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize(("before", "after"), [("", ""), ("{", "}"), ('{"choice": ', "")])
def test_time_is_linear_in_the_length_of_a_response(before, unit, after):
    def response(size):
        return f"{before}{unit * (size // len(unit))}{after}"

    assert is_linear(parse_choice, response)
    letter = parse_choice(response(SIZE)).letter
    assert letter is None or unit in ('{"choice":"B"} ', "A", "A, ")
