"""The parser of responses returns the chosen letter, or the reason why there is none."""

from __future__ import annotations

import json
import random
from pathlib import Path

import pytest

from dynapix.models.student.answer_parser import ParsedAnswer, Reason, parse_choice
from tests.scaling import SIZE, is_linear

NO, CUT, SEV, REF, BAD, MAL = Reason

RECORD = {
    "forced_choice": "B",
    "confidence": 0.7,
    "distribution": {"A": 0.1, "B": 0.7, "C": 0.1, "D": 0.1},
    "second_choice": "C",
    "ambiguity": "low",
    "rationales": {"A": "too early", "B": 'it\'s "right" {here}', "C": "late", "D": "other"},
    "justification": "Answer: D would be wrong.",
}
FULL = json.dumps(RECORD)
PROSE = "Scene parse. A red cube moves. Candidate analysis: Candidate A is early, D is late.\n"

CASES = [
    # lone letters
    ("B", "B", None),
    (" b \n", "B", None),
    ("(B)", "B", None),
    ("Option b", "B", None),
    ('"B"', "B", None),
    ("$\\boxed{B}$", "B", None),
    ("\\(\\boxed{\\text{B}}\\)", "B", None),
    ("\ufeffB\u200b", "B", None),
    ("B。", "B", None),
    ("Ｂ", "B", None),
    # prose with an answer line
    (PROSE + "Answer: B", "B", None),
    (PROSE + "**Answer:** B", "B", None),
    (PROSE + "Answer:\n\nB\n", "B", None),
    (PROSE + "### Final answer: D", "D", None),
    (PROSE + "The answer is C.", "C", None),
    (PROSE + "So the final answer is: A", "A", None),
    (PROSE + "### Answer\nB", "B", None),
    (PROSE + "**Final answer**\n\n$$\\boxed{\\mathbf{C}}$$", "C", None),
    ("It moves south. Answer: B", "B", None),
    ("Answer: B. The cube has turned.", "B", None),
    ("Answer: B\nAnswer: B", "B", None),
    ("Answer: <letter>\nAnswer: D", "D", None),
    ("The answer is clear.\nAnswer: A", "A", None),
    ("Answer: B\nSecond choice: C", "B", None),
    # records
    (FULL, "B", None),
    (f"```json\n{FULL}\n```", "B", None),
    (f"Here it is: {FULL} I hope this helps. Answer: B", "B", None),
    (f"Here it is: {FULL} I hope this helps. Answer: A", None, SEV),
    (FULL + FULL, "B", None),
    ('{"Forced Choice": "Option D"}', "D", None),
    ('{"choice": ["B"]}', "B", None),
    ('{"choice": "\\u0042"}', "B", None),
    ('{"choice": "B", "forced_choice": "B"}', "B", None),
    ('{"confidence": 1}\nAnswer: B', "B", None),
    ("<think>x</think><think>y</think>\nAnswer: C", "C", None),
    ("Answer: A</think>Answer: C", "C", None),
    # invalid records whose choice is complete
    (FULL[:40], "B", CUT),
    ('{"choice": "B"', "B", CUT),
    ("{'choice': 'B', 'why': \"it's so\"}", "B", MAL),
    ('{"choice": B, "confidence": 1}', "B", MAL),
    ('{"choice": "B" "confidence": 1}', "B", MAL),
    # cut off
    ("<think>Answer: B", None, CUT),
    ("Answer: A</think> so <think>Answer: B", None, CUT),
    ('{"confidence": 0.3, "forced_ch', None, CUT),
    ('{"forced_choice": "B', None, CUT),
    ('{"forced_choice": nul', None, CUT),
    ('{"rationales": {"choice": "C"', None, CUT),
    (PROSE + "Answer:", None, CUT),
    ("Answer: B? No, none of these are right.", None, REF),
    ("Answer: B\nThat is wrong.", None, REF),
    ("Answer: B\nWait, that’s wrong.", None, REF),
    ("Answer: B\n\nWait, let me check. Yes, B is right.", "B", None),
    ("Answer: B\nActually, A and D show the cube too far left, so B.", "B", None),
    ("Answer: B\n**Correction to the time:** candidate D is 1 s later.", "B", None),
    ("Answer: B\n\nCandidate A shows the cube left.\nThis is wrong, since it rolls.", "B", None),
    ("Answer: B\nCandidate A: too early\n- It is incorrect.", "B", None),
    ("Answer: B\nWe wait for A to pass; candidate C is later.", "B", None),
    ("Answer: B; it cannot be determined", None, REF),
    ("Answer: B, or none", None, REF),
    # records of real models that are not strict JSON, or not at the outermost level
    ('{"response": {"forced_choice": "B", "confidence": 0.8}}', "B", None),
    ('{"final answer": {"choice": "C"}}', "C", None),
    ("{“forced_choice”: “C”, “confidence”: 0.7}", "C", None),
    ('{forced_choice: "A", confidence: 0.9}', "A", MAL),
    ('{"forced_choice": "D", // it rolls\n "confidence": 0.5}', "D", MAL),
    ('{"forced_choice": "D", /* best */ "confidence": 0.5}', "D", MAL),
    ('{"forced_choice": "A|B|C|D"}\n{"forced_choice": "B"}', "B", None),
    ('{"forced_choice": "A"}\nWait, it moves left.\n{"forced_choice": "C"}', "C", None),
    ('{"forced_choice": "A"}\nCorrected record: {"forced_choice": "C"}', "C", None),
    (PROSE + "The answer is B. Option A shows the cube too far left.", "B", None),
    ("It rolls on.\n<answer>C</answer>", "C", None),
    ("<answer> Option C </answer>", "C", None),
    # near misses of these stay without an answer
    ('{"forced_choice": "A"}\nAlso possible: {"forced_choice": "C"}', None, SEV),
    ('{"forced_choice": "A|B|C|D"}', None, NO),
    ('{"candidates": {"choice": "B"}}', None, NO),
    ("{choice of A: maybe}", None, NO),
    ("<answer>B or C</answer>", None, SEV),
    # several letters
    ("Answer: B\nWait, actually it is C.", None, SEV),
    ("a, b", None, SEV),
    ("Answer: either B or C", None, SEV),
    ("Answer: B, possibly C", None, SEV),
    ("Answer: A\nAnswer: B", None, SEV),
    ("Answer: A|B|C|D", None, NO),
    ("Answer: E\nAnswer: B", None, SEV),
    ('{"choice": ["A", "B"]}', None, SEV),
    ('{"choice": A or B}', None, SEV),
    ('{"choice": "A"} {"choice": "B"}', None, SEV),
    ('{"forced_choice": "A", "note": {"x": 1, {"forced_choice": "B"}', None, SEV),
    ('{"choice": "AB"}', None, NO),
    # refusals
    ("I cannot determine which image is right.", None, REF),
    ("Answer: none of the candidates", None, REF),
    ("Answer: N/A", None, SEV),
    ('{"choice": "none"}', None, REF),
    # letters that are not offered
    ("E", None, BAD),
    ("Answer: 2", None, BAD),
    ('{"choice": "Image 3"}', "C", None),
    # nothing, or an echo of the template
    ("", None, NO),
    ("{}", None, NO),
    (PROSE, None, NO),
    ("A cube moves to the left and then stops near B.", None, NO),
    ("B is not right", None, NO),
    ("Answer: A cube", None, NO),
    ("Answer: not B", None, NO),
    ("Answer: <letter>", None, NO),
    ("Second choice: C", None, NO),
    ('{"choice": null}', None, REF),
    ('{"choice": "<letter>"}', None, NO),
    ('{"choice": "B" or "C"}', None, SEV),
    ('{"choice": {"letter": "B"}}', "B", None),
    ('{"second_choice": "B"}', None, NO),
    ('{\n  "answer": "B"\n}', "B", None),
    # records with a key that resembles a choice, or with errors around the choice
    ('{"forced_choice": " (a) "}', "A", None),
    (FULL.replace('"B",', '"B"', 1), "B", MAL),
    (FULL.replace("}", ",}", 1), "B", MAL),
    ("{", None, NO),
    (f"<think>One.</think>{FULL}<think>Or else", None, CUT),
    ('{"forced_choice": "A", "choice": "D"}', None, SEV),
    ('{"forced_choice": "A"}{"forced_choice": null}', None, SEV),
    ('{"forced_choice": "A: rejected"}', None, REF),
    ('{"forced_choice": "B, but impossible to determine"}', None, REF),
    ('{"forced_choice": "A, no other one fits"}', "A", None),
    ('{"forced_choice": "blue cube"}', None, NO),
    # letters that are only mentioned, and letters in words
    ("Answer: Blue", None, NO),
    ("The answer depends on A.", None, NO),
    ("Candidate A:", None, NO),
    # letters that the same line takes back, and letters with a reason that only contains a negation
    ("Answer: A? No.", None, REF),
    ("Answer: A, which is wrong", None, REF),
    ("Answer: B. I'm sorry, but I cannot determine it.", None, REF),
    ("Answer: B. No cube has moved.", "B", None),
    ("Answer: B, since the sphere cannot be seen any more.", "B", None),
    ("Answer: B. There is not enough time to reach the corner.", "B", None),
    # reasoning in the tags of other chat templates
    ("<thinking>\nAnswer: B", None, CUT),
    ("◁think▷Answer: B◁/think▷Answer: C", "C", None),
    # letters of other scripts that look like A to D
    ("Answer: В", "B", None),
    ('{"forced_choice": "С"}', "C", None),
    # damaged text in which the letter may belong to something else
    ('{"rat"ales": {"choice": "C"', None, CUT),
    ('{"ch|ce": ", {"choice": "B"}', None, CUT),
    ('{"choice": ,"A", "choice": "B"}', None, SEV),
    ('{"forced_choice": "A", "choice":C"}', None, SEV),
    ('{"choice":]"B"}', None, MAL),
    ('Answer: B{"choice": since it rolls]', None, CUT),
    ('{"forced_choice": "A: rejected"!}', None, REF),
    ("Answer: B\nThat is wrong-.", None, REF),
    ("Answer: A, n*", "A", None),
    ("Answer: A. I", "A", None),
    # other JSON
    ("null", None, REF),
    ("\x00", None, NO),
    ("</think>", None, NO),
]


RAW_ANSWERS = [
    json.loads(line) for line in Path(__file__).with_name("answers.jsonl").read_text().splitlines()
]


@pytest.mark.parametrize("kind", sorted({each["kind"] for each in RAW_ANSWERS}))
def test_raw_answers_of_each_kind(kind):
    """Raw answers as models write them, with the letter that a careful reader takes from them."""
    own = [each for each in RAW_ANSWERS if each["kind"] == kind]
    wrong = [each for each in own if parse_choice(each["raw"]).letter != each["right"]]
    assert not wrong


@pytest.mark.parametrize(("raw", "letter", "reason"), CASES)
def test_parse_choice(raw, letter, reason):
    assert parse_choice(raw) == ParsedAnswer(letter, reason)
    for padded in (f"\n{raw}", f" \t{raw}  \n\n"):
        assert parse_choice(padded).letter == letter


def test_only_letters_of_candidates_are_accepted():
    assert parse_choice("Answer: E") == ParsedAnswer(None, BAD)
    assert parse_choice("Answer: D").letter == "D"


@pytest.mark.parametrize("stop", range(len(FULL)))
def test_a_record_that_is_cut_off_gives_its_choice_or_none(stop):
    choice = parse_choice(FULL[:stop])
    complete = stop >= FULL.index(",")
    assert choice.letter == ("B" if complete else None)
    assert choice.reason in ((CUT,) if complete else (CUT, NO))


def test_any_text_gives_a_letter_of_the_item_or_a_reason():
    rng = random.Random(0)
    seeds = [raw for raw, _, _ in CASES]
    pieces = [
        *'{}[]"\\:,\n ',
        "<think>",
        "</think>",
        "Answer:",
        '{"choice":',
        "B",
        "\x00",
        "\ud800",
    ]
    for _ in range(10_000):
        text = list(rng.choice(seeds))
        for _ in range(rng.randint(1, 6)):
            at = rng.randint(0, len(text))
            text[at : at + rng.randint(0, 3)] = rng.choice(pieces)
        choice = parse_choice("".join(text))
        assert choice.letter in (*"ABCD", None)
        assert choice.letter or choice.reason


@pytest.mark.parametrize(
    ("raw", "letter"),
    [("Answer: B", None), ("B", None), ("Option", None), ("Answer: B.", "B"),
     ("Answer: B\nThe", "B"), (FULL, "B"), (FULL[:40], "B")],
)  # fmt: skip
def test_an_incomplete_last_word_is_not_a_choice(raw, letter):
    answer = parse_choice(raw, truncated=True)
    assert answer.letter == letter
    assert letter or answer.reason is CUT


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
    "final\n", "best\n", '"choice": x ', "'choice': x ", '{"choice":"B"} ', "{'a': ", "'", '"',
    "[[",
    "Answer:\n", "the answer is ", "A, ", "I cannot ", " ", "\t", "<think>", "</think>", "\\", "A",
    "\u200b", "{", '{"a":', '{"choice":', "\n", "Answer:", "- ",
]  # fmt: skip


@pytest.mark.parametrize("unit", UNITS)
@pytest.mark.parametrize("before", ["", "{", '{"choice": '])
@pytest.mark.parametrize("after", ["", "}"])
def test_time_is_linear_in_the_length_of_a_response(before, unit, after):
    def response(size):
        return f"{before}{unit * (size // len(unit))}{after}"

    assert is_linear(parse_choice, response)
    letter = parse_choice(response(SIZE)).letter
    assert letter is None or unit in ('{"choice":"B"} ', "A", "A, ")
