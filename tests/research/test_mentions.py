"""Where a text names objects and candidates, and which words refer to which."""

from __future__ import annotations

import re

from research.tiny_base.mentions import TokenizedText


def test_texts_speak_of_the_last_name_and_letter(processor) -> None:
    text = (
        "Prediction: The red metal cube will be left of the blue metal cube. It is so.\n"
        "Candidate analysis: Candidate B shows the red metal cube near the top."
    )
    ids = processor.tokenizer(text, add_special_tokens=False)["input_ids"]
    tokenized = TokenizedText(text, processor.tokenizer)
    mentions = [*tokenized.mentions()]
    assert len(tokenized) == len(ids)
    decode = processor.tokenizer.decode
    assert [decode(ids[m.last : m.stop]).split()[1:] for m in mentions] == [
        ["will", "be", "left", "of", "the"],
        [],
        ["near", "the", "top"],
    ]
    assert [(m.section, m.letter) for m in mentions] == [
        ("Prediction", None),
        ("Prediction", None),
        ("Candidate analysis", "B"),
    ]
    assert decode(ids[mentions[2].letter_at]).strip() == "B"
    for m in mentions:
        assert decode(ids[m.first : m.last + 1]).strip() == m.name


def test_outcomes_refer_to_the_candidates_that_agree(processor) -> None:
    text = (
        "Candidate analysis: Candidate A shows the red metal cube near the top, and agrees. "
        "Candidate B shows the red metal cube out of sight. Candidate C shows the red metal cube "
        "near the left, not near the top. Candidate D shows the red metal cube near the top, and "
        "agrees.\n"
        "Outcome: Candidates A and D agree."
    )
    ids = processor.tokenizer(text, add_special_tokens=False)["input_ids"]
    decode = processor.tokenizer.decode
    verdicts = [*TokenizedText(text, processor.tokenizer).verdicts()]
    assert [decode(ids[at]).strip() for at, _ in verdicts] == ["A", "D"]
    for (_, agrees), letter in zip(verdicts, "AD", strict=True):
        before = decode(ids[: agrees + 1])
        assert before[before.rindex("Candidate ") :].startswith(f"Candidate {letter} shows")


def test_the_closest_candidate_refers_to_what_it_shows(processor) -> None:
    text = TokenizedText(
        "Prediction: The red metal cube will be near the top.\n"
        "Candidate analysis: Candidate A shows the red metal cube near the left, far off, not near "
        "the top. Candidate B shows the red metal cube near the top and the gray metal cube near "
        "the left.\n"
        "Outcome: The red metal cube is closest to its expected place in candidate B.\nAnswer: B",
        processor.tokenizer,
    )
    closest = text.token_at(text.text.index("B.\nAnswer"))
    described = text.token_at(text.text.index("gray")) - 1
    assert [*text.choices()] == [(closest, described)]
    answer = text.token_at(len(text.text) - 1)
    assert [*text.verdicts()] == [(answer, closest)]


def test_the_match_layout_refers_to_the_last_letter_of_the_outcome(processor) -> None:
    text = TokenizedText(
        "Candidate analysis: Candidate A shows the red metal cube near the left. Candidate B shows "
        "the red metal cube near the top.\n"
        "Outcome: The red metal cube is closest to its expected place in candidate B. This layout "
        "is that of candidate B.\n"
        "Candidate A does not match.\nCandidate B matches: all is there.\nAnswer: B",
        processor.tokenizer,
    )
    lines = [text.token_at(m.end() - 1) for m in re.finditer("^Candidate .", text.text, re.M)][1:]
    outcome = text.token_at(text.text.index("B.\nCandidate A"))
    assert len(lines) == 2
    assert [*text.matches()] == [(line, outcome) for line in lines]


def test_references_are_named_before_what_is_beside_them(processor) -> None:
    text = TokenizedText(
        "Prediction: At the end, the red metal cube will have the gray metal cube left of it. The "
        "gray metal cube will be near the top.\n"
        "Candidate analysis: Candidate A shows the red metal cube near the top and with the gray "
        "metal cube above it and with the blue rubber sphere near it, and agrees. Candidate B "
        "shows the red metal cube nearer to the gray metal cube than to the blue rubber sphere.",
        processor.tokenizer,
    )
    references = [mention.reference for mention in text.mentions()]
    assert references == [None, 0, None, None, 3, 3, None, None, None]
