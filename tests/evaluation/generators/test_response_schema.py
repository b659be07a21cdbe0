"""The structured record, and what hostile and ordinary outputs come to."""

import json
import random
import string
from dataclasses import asdict, fields

import pytest
from jsonschema import Draft202012Validator

from evaluation.generators.response_schema import (
    FIELDS,
    Record,
    instruction,
    read_record,
    schema,
)
from models.student.answer_parser import Reason, parse_choice

NO, CUT, SEV, REF, BAD, MAL = Reason

RECORD = Record(
    "C",
    0.55,
    {"A": 0.1, "B": 0.3, "C": 0.55, "D": 0.05},
    "B",
    "some",
    {"A": "Too early.", "B": 'It is "B", nearly.', "C": "Answer: it fits.", "D": "{late}"},
    "The red cube has come to rest; Option A has it moving.",
)
FULL = json.dumps(asdict(RECORD))
CUT_MIDWAY = FULL[: FULL.index('"rationales"')]
CANDIDATES = "Candidate A is early. Candidate B is late. Candidate C has no cube. Candidate D fits."

OUTPUTS = [
    # a record, whatever stands around it
    (FULL, "C", None),
    (json.dumps(asdict(RECORD), indent=4), "C", None),
    (f"```json\n{FULL}\n```", "C", None),
    (f"```\n{FULL}\n```\nI hope that this helps!", "C", None),
    (f"Sure! Here is the JSON object:\n\n{FULL}", "C", None),
    (f"{CANDIDATES}\n{FULL}\n{CANDIDATES}", "C", None),
    (f"{FULL}\n\nAnswer: A", "C", None),
    (f"<think>\nAnswer: A? No, B.\n</think>\n\n{FULL}", "C", None),
    (f'<think>{{"forced_choice": "A"}}</think>{FULL}', "C", None),
    (f"{FULL}\n{FULL}", "C", None),
    (json.dumps({"reply": 1, "forced_choice": "d"}), "D", None),
    (json.dumps({"forced_choice": "Candidate D"}), "D", None),
    (json.dumps({"forced_choice": " (a) "}), "A", None),
    # a choice that stands complete before a cut-off
    (CUT_MIDWAY, "C", CUT),
    (f"```json\n{CUT_MIDWAY}", "C", CUT),
    (f"<think>Hm.</think>{CUT_MIDWAY}", "C", CUT),
    ('{"forced_choice": "C"', "C", CUT),
    # broken, but the choice stands
    (FULL.replace('"B",', '"B"', 1), "C", MAL),
    (FULL.replace("}", ",}", 1), "C", MAL),
    (FULL.replace('"', "'"), "C", MAL),
    (FULL.replace('{"', '{/* the record */ "', 1).replace("{/* the record */ ", "{", 1), "C", None),
    # cut off before a choice stands
    ("{", None, NO),
    ('{"', None, CUT),
    ('{"forced_choice"', None, CUT),
    ('{"forced_choice": "', None, CUT),
    ('{"forced_choice": "C', None, CUT),
    ('{"confidence": 0.5, "distribution": {"A": 0.5', None, CUT),
    (f"<think>{FULL}", None, CUT),
    ("<think>The answer is B. Answer: B", None, CUT),
    (f"<think>One.</think>{FULL}<think>Or else", None, CUT),
    # two records, or two choices
    (FULL + FULL.replace('"forced_choice": "C"', '"forced_choice": "A"'), None, SEV),
    ('{"forced_choice": "A", "forced_choice": "D"}', None, SEV),
    ('{"forced_choice": "A", "choice": "D"}', None, SEV),
    ('{"forced_choice": ["A", "D"]}', None, SEV),
    ('{"forced_choice": "A or B"}', None, SEV),
    ('{"forced_choice": "A/B"}', None, SEV),
    ('{"forced_choice": "A|B|C|D"}', None, SEV),
    ('{"forced_choice": "A, B, C or D"}', None, SEV),
    # no choice of one of four
    ('{"forced_choice": "E"}', None, BAD),
    ('{"forced_choice": 3}', None, BAD),
    ('{"forced_choice": "none of them"}', None, REF),
    ('{"forced_choice": null, "second_choice": "B"}', None, REF),
    ('{"forced_choice": "A"}{"forced_choice": null}', None, SEV),
    ('{"forced_choice": "A"}{"forced_choice": "refuse"}', None, SEV),
    ('{"forced_choice": "A: rejected"}', None, REF),
    ('{"forced_choice": "B, but impossible to determine"}', None, REF),
    ('{"forced_choice": "A, no other one fits"}', "A", None),
    ('{"forced_choice": "<letter>"}', None, NO),
    ('{"forced_choice": true}', None, NO),
    ('{"forced_choice": "blue cube"}', None, NO),
    ('{"second_choice": "B", "confidence": 1}', None, NO),
    ('{"rationales": {"forced_choice": "B"}}', None, NO),
    (instruction(), None, NO),
    (json.dumps(schema()), None, NO),
    # our students' own form
    (f"{CANDIDATES}\nCandidate B: matches, it is near the centre.\nAnswer: B", "B", None),
    (f"{CANDIDATES}\nAnswer: b.", "B", None),
    (f"{CANDIDATES}\n\n**Answer:** D", "D", None),
    (f"{CANDIDATES}\nAnswer:", None, CUT),
    (f"{CANDIDATES}\nAnswer: A or B", None, SEV),
    (f"{CANDIDATES}\nAnswer: A\nAnswer: B", None, SEV),
    (f"{CANDIDATES}\nAnswer: I cannot tell.", None, REF),
    (f"{CANDIDATES}\nAnswer: E", None, BAD),
    # a lone letter
    ("B", "B", None),
    ("b", "B", None),
    ("(B)", "B", None),
    ("[b]", "B", None),
    ("Option b", "B", None),
    ("Candidate D.", "D", None),
    ("`A`", "A", None),
    ("A or B", None, SEV),
    ("A|B|C|D", None, SEV),
    ("ABCD", None, NO),
    ("H", None, BAD),
    ("7", None, BAD),
    # letters in passing, and inside words
    (CANDIDATES, None, NO),
    ("A", "A", None),
    ("A red cube.", None, NO),
    ("Abacus", None, NO),
    ("Bad", None, NO),
    ("The cube moves towards D.", None, NO),
    ("B is wrong", None, NO),
    ("not C", None, NO),
    ("Answer: Blue", None, NO),
    ("Answer: cube", None, NO),
    ("The answer depends on A.", None, NO),
    # refusals
    ("I'm sorry, but I can't help with that.", None, REF),
    ("I cannot determine the answer from these images.", None, REF),
    ("It is impossible to say which of the images comes next.", None, REF),
    # a letter that its own line takes back, and one that is explained by what is not there
    ("Answer: A? No.", None, REF),
    ("Answer: A, no", None, REF),
    ("Answer: A - wrong", None, REF),
    ("Answer: A: incorrect", None, REF),
    ("Answer: A, which is wrong", None, REF),
    ("Answer: A. That is not right.", None, REF),
    ("Answer: B. I'm sorry, but I cannot determine it.", None, REF),
    ("Answer: A. I refuse to answer.", None, REF),
    ("Answer: A (I cannot tell)", None, REF),
    ("Answer: B, but there is not enough information.", None, REF),
    ("Answer: B. No cube has moved.", "B", None),
    ("Answer: B, since the sphere cannot be seen any more.", "B", None),
    ("Answer: B. There is not enough time to reach the corner.", "B", None),
    ("Answer: B. It is not the first to collide.", "B", None),
    # a form that was not filled in
    ("Candidate A:", None, NO),
    ("A:", None, NO),
    # thoughts of other templates
    ("<thinking>\nAnswer: B", None, CUT),
    ("<THINK>\nAnswer: B", None, CUT),
    ("◁think▷\nAnswer: B", None, CUT),
    ("◁think▷Answer: B◁/think▷Answer: C", "C", None),
    ("<thinking>Answer: B</thinking>Answer: C", "C", None),
    # look-alikes of other scripts are other letters; forms of the same letter are not
    ("Answer: В", None, BAD),
    ("Answer: Α", None, BAD),
    ("А", None, BAD),
    ('{"forced_choice": "С"}', None, BAD),
    ("Answer: Ｂ", "B", None),
    ('{"forced_choice": "\\u0042"}', "B", None),
    # nothing
    ("", None, NO),
    ("\n\t ", None, NO),
    ("{}", None, NO),
    ("[]", None, NO),
    ("null", None, REF),
    ("\x00", None, NO),
    ("</think>", None, NO),
]


@pytest.mark.parametrize(("raw", "letter", "reason"), OUTPUTS)
def test_outputs(raw, letter, reason):
    found = parse_choice(raw)
    assert (found.letter, found.reason) == (letter, reason)
    assert parse_choice(raw).letter == letter


@pytest.mark.parametrize(("raw", "letter", "reason"), OUTPUTS)
def test_space_around_an_output_says_nothing(raw, letter, reason):
    for around in (f"\n{raw}", f"{raw}\n", f" \t{raw}  \n\n"):
        assert parse_choice(around).letter == letter


@pytest.mark.parametrize(
    ("raw", "letter"),
    [
        ("Answer: B", None),
        ("B", None),
        ("Option", None),
        ("Answer: B.", "B"),
        ("Answer: B\nThe", "B"),
        (FULL, "C"),
        (CUT_MIDWAY, "C"),
    ],
)
def test_the_last_word_of_what_was_stopped_is_no_choice(raw, letter):
    found = parse_choice(raw, cut=True)
    assert found.letter == letter
    assert letter or found.reason is CUT


def test_no_letter_comes_from_texts_that_state_none():
    """Prose and JSON of words that name letters, candidates and colours, but choose none."""
    rng = random.Random(0)
    words = ["A", "B", "Candidate C", "D", "cube", "a", "the", "best", "option", "choice", "late"]
    keys = ["confidence", "second_choice", "distribution", "rationales", "answer", "my choices"]
    for _ in range(1000):
        prose = " ".join(rng.choices(words, k=rng.randint(6, 30)))
        value = {k: rng.choice([prose, 0.5, "A", {"forced_choice": "B"}]) for k in keys}
        raw = rng.choice(
            [prose, json.dumps(value), f"{json.dumps(value)} {prose}", f"<think>{FULL}"]
        )
        assert parse_choice(raw).letter is None, raw


def test_a_choice_is_read_from_whatever_else_a_record_holds():
    rng = random.Random(1)
    for _ in range(300):
        record = random_record(rng)
        raw = json.dumps(asdict(record), indent=rng.choice([None, 1, 4]))
        assert parse_choice(raw).letter == record.forced_choice
        assert read_record(raw) == record
        # Dumped and read again it is the same, and so is the choice.
        assert read_record(json.dumps(asdict(read_record(raw)))) == record
        stop = rng.randrange(len(raw))
        assert parse_choice(raw[:stop]).letter in (record.forced_choice, None)


def random_record(rng: random.Random) -> Record:
    def text() -> str:
        return "".join(
            rng.choices(string.printable + "ÀВ«»中\u2028\U0001f9ca", k=rng.randint(0, 60))
        )

    return Record(
        rng.choice("ABCD"),
        rng.random(),
        {x: rng.random() for x in "ABCD"},
        rng.choice("ABCD"),
        rng.choice(["none", "some", "high"]),
        {x: text() for x in "ABCD"},
        text(),
    )


def test_a_record_is_valid_as_its_schema_says():
    """Held against what the schema says of every record with one thing changed."""
    validator = Draft202012Validator(schema(bound=False))
    Draft202012Validator.check_schema(schema())
    values = [None, True, -0.1, 1.1, 0, 1, "", "A", "e", "none", "N", {}, [], {"A": 1}, "0.5"]
    whole = asdict(RECORD)
    changed = [{**whole, name: value} for name in whole for value in values]
    changed += [{k: v for k, v in whole.items() if k != name} for name in whole]
    changed += [{**whole, "note": ""}, {**whole, "distribution": {"A": 1, "B": 0, "C": 0}}]
    valid = 0
    for value in changed:
        raw = json.dumps(value)
        found = read_record(raw)
        assert (found is not None) == validator.is_valid(value)
        assert found is None or parse_choice(raw).letter == found.forced_choice
        valid += found is not None
    assert 0 < valid < len(changed)


@pytest.mark.parametrize(
    "raw",
    [
        FULL.replace("0.55", "NaN", 1),
        FULL.replace("0.55", "Infinity", 1),
        FULL.replace("0.55", "1e999", 1),
        FULL[:-1],
        FULL + FULL,
        f"<think>{FULL}",
        "",
        '{"forced_choice": "C", "confidence": ' + "[" * 100_000,
    ],
)
def test_no_record_is_valid_that_is_not_one_record_of_json(raw):
    assert read_record(raw) is None


def test_the_prompt_the_schema_and_the_record_have_one_order():
    names = [f.name for f in fields(Record)]
    assert list(FIELDS) == list(schema()["properties"]) == schema()["required"] == names
    at = [instruction().index(f'"{name}"') for name in names]
    assert at == sorted(at)


@pytest.mark.parametrize(
    "unit",
    ["final\n", "best\n", '"choice": x ', "'choice': x ", '{"choice":"B"} ', "{'a': ", "'", '"',
     "[[", "Answer:\n", "the answer is ", "A, ", "I cannot ", " ", "\t", "<think>", "</think>",
     "\\", "A", "\u200b"],
)  # fmt: skip
@pytest.mark.parametrize("before", ["", "{", '{"choice": '])
def test_an_output_of_any_length_is_read_in_linear_time(before, unit):
    raw = f"{before}{unit * (20_000 // len(unit))}}}"
    assert parse_choice(raw).letter is None or unit in ('{"choice":"B"} ', "A", "A, ")


def test_a_megabyte_of_prose_with_one_answer_is_read():
    prose = "The red cube moves steadily toward the east, and candidate B is late. " * 15_000
    assert parse_choice(f"{prose}\nAnswer: B").letter == "B"
    assert parse_choice(f"{prose}{FULL}").letter == "C"
    assert parse_choice(prose).letter is None
