"""Sections of a rationale's text, and the grammar of its form for constrained decoding."""

from __future__ import annotations

import re

SECTIONS = ("Scene parse", "Motion analysis", "Prediction", "Candidate analysis", "Outcome")
"""Headings of a rationale in order; the line "Answer: X" follows them."""
HEADING = re.compile(rf"^({'|'.join(SECTIONS)}|Answer):[ \t]*", re.MULTILINE)

GRAMMAR_VERSION = "2"
GRAMMAR = r"""
root ::= scene-parse motion-analysis prediction candidate-analysis outcome answer
scene-parse ::= "Scene parse:" prose "\n"
motion-analysis ::= "Motion analysis:" prose "\n"
prediction ::= "Prediction:" prose "\n"
candidate-analysis ::= "Candidate analysis:" candidates "\n"
candidates ::= " Candidate A" prose " Candidate B" prose " Candidate C" prose " Candidate D" prose
outcome ::= "Outcome:" prose "\n"
answer ::= "Answer: " [A-D]
prose ::= (" " word [,;:.]?)* " " word "."
word ::= [A-Za-z]+ (['-] [a-z]+)*
"""
"""GBNF of texts with every section, every candidate's letter and an answer, and without digits and
markup. Length, number words and claims are left to the validator."""


def split_sections(text: str) -> list[tuple[str, int, int]]:
    """Each heading with the start and stop of the text below it, in order."""
    headings = list(HEADING.finditer(text))
    stops = [*(m.start() for m in headings[1:]), len(text)]
    return [(m[1], m.end(), stop) for m, stop in zip(headings, stops, strict=False)]


def remove_section(text: str, section: str) -> str:
    """The text without one section and its heading."""
    body = rf"^{section}:.*?(?={HEADING.pattern}|\Z)"
    return re.sub(body, "", text, count=1, flags=re.MULTILINE | re.DOTALL)
