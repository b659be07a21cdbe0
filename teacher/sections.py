"""Split a rationale into its sections. A grammar constrains a server's decoding to this form."""

from __future__ import annotations

import re

SECTIONS = ("Scene parse", "Motion analysis", "Prediction", "Candidate analysis", "Outcome")
"""Headings of a rationale's sections in order. The line "Answer: X" follows the last section."""
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
"""GBNF grammar of a rationale. It requires all sections in order, all candidates' letters and an
answer, and excludes digits and markup. The validator checks length, number words and claims."""


def split_sections(text: str) -> list[tuple[str, int, int]]:
    """Return (heading, start, stop) for each section; `text[start:stop]` is the section's text
    without its heading. "Answer" counts as a heading."""
    headings = list(HEADING.finditer(text))
    stops = [*(m.start() for m in headings[1:]), len(text)]
    return [(m[1], m.end(), stop) for m, stop in zip(headings, stops, strict=False)]


def remove_section(text: str, section: str) -> str:
    """Return `text` without the first section that is called `section`, heading included."""
    pattern = rf"^{section}:.*?(?={HEADING.pattern}|\Z)"
    return re.sub(pattern, "", text, count=1, flags=re.MULTILINE | re.DOTALL)
