"""Which words of a text refer to which names and candidates."""

from __future__ import annotations

import re

from research.tiny_base.mentions import TokenizedText


def test_outcomes_refer_to_what_the_candidates_show(processor) -> None:
    """The lines of the match layout refer to the last letter of the outcome."""
    agreeing = TokenizedText(
        "Candidate analysis: Candidate A shows the red metal cube near the top, and agrees. "
        "Candidate B shows the red metal cube out of sight. Candidate D shows the red metal cube "
        "near the top, and agrees.\n"
        "Outcome: Candidates A and D agree.",
        processor.tokenizer,
    )
    agrees = [agreeing.token_at(m.end()) for m in re.finditer(", and ", agreeing.text)]
    letters = [agreeing.token_at(agreeing.text.index(f"{end} agree.")) for end in ("A and D", "D")]
    assert [*agreeing.verdicts()] == [*zip(letters, agrees, strict=True)]

    text = TokenizedText(
        "Prediction: The red metal cube will be near the top.\n"
        "Candidate analysis: Candidate A shows the red metal cube near the left, far off, not near "
        "the top. Candidate B shows the red metal cube near the top and the gray metal cube near "
        "the left.\n"
        "Outcome: The red metal cube is closest to its expected place in candidate B.\n"
        "Candidate A does not match.\nCandidate B matches: all is there.\nAnswer: B",
        processor.tokenizer,
    )
    closest = text.token_at(text.text.index("B.\nCandidate A"))
    described = text.token_at(text.text.index("gray")) - 1
    assert [*text.choices()] == [(closest, described)]
    assert [*text.verdicts()] == [(text.token_at(len(text.text) - 1), closest)]
    lines = [text.token_at(m.end() - 1) for m in re.finditer("^Candidate [AB]", text.text, re.M)]
    assert [*text.matches()] == [(line, closest) for line in lines]


def test_references_are_named_before_what_is_beside_them(processor) -> None:
    text = TokenizedText(
        "Prediction: At the end, the red metal cube will have the gray metal cube left of it. The "
        "gray metal cube will be near the top.\n"
        "Candidate analysis: Candidate A shows the red metal cube near the top and with the gray "
        "metal cube above it and with the blue rubber sphere near it, and agrees. Candidate B "
        "shows the red metal cube nearer to the gray metal cube than to the blue rubber sphere.",
        processor.tokenizer,
    )
    mentions = [*text.mentions()]
    assert [m.reference for m in mentions] == [None, 0, None, None, 3, 3, None, None, None]
    assert [(m.section, m.letter) for m in mentions] == [
        *[("Prediction", None)] * 3,
        *[("Candidate analysis", "A")] * 3,
        *[("Candidate analysis", "B")] * 3,
    ]
