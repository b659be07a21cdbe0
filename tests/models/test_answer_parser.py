import json
import random

import pytest

from models.student.answer_parser import ParsedAnswer, Reason, parse_choice

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
    ("option (C).", "C", None),
    ("**D**", "D", None),
    ("Image A", "A", None),
    ('"B"', "B", None),
    ("B.", "B", None),
    ("\\boxed{B}", "B", None),
    ("$\\boxed{B}$", "B", None),
    ("\\(\\boxed{\\text{B}}\\)", "B", None),
    ("\ufeffB\u200b", "B", None),
    ("B。", "B", None),
    ("Ｂ", "B", None),
    ("The correct option is C.", "C", None),
    # prose with an answer line
    (PROSE + "Answer: B", "B", None),
    (PROSE + "Answer: B.", "B", None),
    (PROSE + "**Answer:** B", "B", None),
    (PROSE + "**Answer: (B)**", "B", None),
    (PROSE + "ANSWER: b", "B", None),
    (PROSE + "Answer:\n\nB\n", "B", None),
    (PROSE + "Answer: Option C", "C", None),
    (PROSE + "### Final answer: D", "D", None),
    (PROSE + "The answer is C.", "C", None),
    (PROSE + "So the final answer is: A", "A", None),
    (PROSE + "### Answer\nB", "B", None),
    (PROSE + "**Final answer**\n\n$$\\boxed{\\mathbf{C}}$$", "C", None),
    ("It moves south. Answer: B", "B", None),
    ("Answer: B. The cube has turned.", "B", None),
    ("Answer: B because the cube has turned", "B", None),
    ("Answer: B\nAnswer: B", "B", None),
    ("Answer: <letter>\nAnswer: D", "D", None),
    ("The answer is clear.\nAnswer: A", "A", None),
    ("Answer: B\nSecond choice: C", "B", None),
    # records
    (FULL, "B", None),
    (json.dumps(RECORD, indent=2), "B", None),
    (f"```json\n{FULL}\n```", "B", None),
    (f"Here it is: {FULL} I hope this helps. Answer: A", "B", None),
    (FULL + FULL, "B", None),
    ('{"choice": "c"}', "C", None),
    ('{"Forced Choice": "Option D"}', "D", None),
    ('{"choice": ["B"]}', "B", None),
    ('{"choice": "\\u0042"}', "B", None),
    ('{"choice": "B", "forced_choice": "B"}', "B", None),
    ('{"confidence": 1}\nAnswer: B', "B", None),
    ("<think>Answer: A</think>" + FULL, "B", None),
    ("<think>x</think><think>y</think>\nAnswer: C", "C", None),
    ("Answer: A</think>Answer: C", "C", None),
    # records that are invalid, with a choice that stands
    (FULL[:40], "B", CUT),
    (FULL[:-1], "B", CUT),
    ('{"choice": "B"', "B", CUT),
    ('{"choice": "B",}', "B", MAL),
    ("{'choice': 'B', 'why': \"it's so\"}", "B", MAL),
    ('{"choice": B, "confidence": 1}', "B", MAL),
    ('{"choice": "B" "confidence": 1}', "B", MAL),
    # cut off
    ("<think>Answer: B", None, CUT),
    ("Answer: A</think> so <think>Answer: B", None, CUT),
    ('{"confidence": 0.3, "forced_ch', None, CUT),
    ('{"forced_choice": ', None, CUT),
    ('{"forced_choice": "B', None, CUT),
    ('{"forced_choice": nul', None, CUT),
    ('{"rationales": {"choice": "C"', None, CUT),
    (PROSE + "Answer:", None, CUT),
    ("Answer: B? No, none of these are right.", None, REF),
    ("Answer: B. Wait, that is wrong.", None, REF),
    ("Answer: B\nThat is wrong.", None, REF),
    ("Answer: B\nNo, wait.", None, REF),
    ("Answer: B\nWait, that’s wrong.", None, REF),
    ("Answer: B\n\nWait, let me check. Yes, B is right.", "B", None),
    ("Answer: B\nIt is not right of the sphere but left of it.", "B", None),
    ("Answer: B\nActually, A and D show the cube too far left, so B.", "B", None),
    ("Answer: B\n**Correction to the time:** candidate D is 1 s later.", "B", None),
    ("Answer: B\n\nCandidate A shows the cube left.\nThis is wrong, since it rolls.", "B", None),
    ("Answer: B\nCandidate A: too early\n- It is incorrect.", "B", None),
    ("Answer: B\nActually, the cube stops near the left.", "B", None),
    ("Answer: B\nWe wait for A to pass; candidate C is later.", "B", None),
    ("Answer: B; it cannot be determined", None, REF),
    ("Answer: B, or none", None, REF),
    # several
    ("Answer: b, possibly also c", None, Reason.SEVERAL),
    ("Answer: B\nWait, actually it is C.", None, SEV),
    ("**Answer:** B\n\nActually, C.", None, SEV),
    ("Answer: B\nHmm, no, on second thought D.", None, SEV),
    ("Answer: B\nSorry, I meant C.", None, SEV),
    ("Answer: B\nNo. C.", None, SEV),
    ("B or C", None, SEV),
    ("a, b", None, SEV),
    ("Answer: A and D", None, SEV),
    ("Answer: either B or C", None, SEV),
    ("Answer: B, possibly C", None, SEV),
    ("Answer: b, but maybe c", None, SEV),
    ("Answer: A\nAnswer: B", None, SEV),
    ("Answer: A|B|C|D", None, SEV),
    ("Answer: E\nAnswer: B", None, SEV),
    ('{"choice": "A|B|C|D"}', None, SEV),
    ('{"choice": ["A", "B"]}', None, SEV),
    ('{"choice": A or B}', None, SEV),
    ('{"choice": "A", "choice": "B"}', None, SEV),
    ('{"choice": "A"} {"choice": "B"}', None, SEV),
    ('{"forced_choice": "A", "note": {"x": 1, {"forced_choice": "B"}', None, SEV),
    ('{"choice": "AB"}', None, NO),
    # refusals
    ("I cannot determine which image is right.", None, REF),
    ("I'm sorry, I can't help with that.", None, REF),
    ("Answer: none of the candidates", None, REF),
    ("Answer: N/A", None, REF),
    ('{"choice": "none"}', None, REF),
    ('{"choice": "unable to decide"}', None, REF),
    # other letters
    ("E", None, BAD),
    ("Answer: F", None, BAD),
    ("Answer: 2", None, BAD),
    ('{"choice": "Image 3"}', None, BAD),
    ('{"choice": 2}', None, BAD),
    # nothing, or an echo of the template
    ("", None, NO),
    ("   \n", None, NO),
    ("{}", None, NO),
    (PROSE, None, NO),
    ("A cube moves", None, NO),
    ("A cube moves to the left and then stops near B.", None, NO),
    ("B is not right", None, NO),
    ("Answer: A cube", None, NO),
    ("Answer: not B", None, NO),
    ("Answer: <letter>", None, NO),
    ("Second choice: C", None, NO),
    ('{"choice": null}', None, REF),
    ('{"choice": ""}', None, NO),
    ('{"choice": "<letter>"}', None, NO),
    ('{"choice": "framed"}', None, NO),
    ('{"choice": "B" or "C"}', None, NO),
    ('{"choice": {"letter": "B"}}', None, NO),
    ('{"second_choice": "B"}', None, NO),
    ('{"rationales": {"choice": "C"}}', None, NO),
    ('{\n  "answer": "B"\n}', None, NO),
]


@pytest.mark.parametrize(("raw", "letter", "reason"), CASES)
def test_outputs(raw, letter, reason):
    assert parse_choice(raw) == ParsedAnswer(letter, reason)
    assert parse_choice(raw).letter == letter


def test_only_offered_letters_count():
    assert parse_choice("Answer: D", letters="ABC") == ParsedAnswer(None, BAD)
    assert parse_choice("Answer: C", letters="ABC").letter == "C"


@pytest.mark.parametrize("stop", range(len(FULL)))
def test_a_record_cut_anywhere_gives_its_choice_or_none(stop):
    choice = parse_choice(FULL[:stop])
    stands = stop >= FULL.index(",")
    assert choice.letter == ("B" if stands else None)
    assert choice.reason in ((CUT,) if stands else (CUT, NO))


def test_no_output_raises_or_leaves_the_letters():
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
    "unit", ["{", '{"a":', '{"choice":', "\n", "[", '"', "Answer:", "best ", "- "]
)
def test_long_output_is_read_in_linear_time(unit):
    assert parse_choice(unit * 20_000).letter is None
