"""Sections of a rationale's text."""

from __future__ import annotations

import re

SECTIONS = ("Scene parse", "Motion analysis", "Prediction", "Candidate analysis", "Outcome")
"""Headings of a rationale in order; the line "Answer: X" follows them."""
HEADING = re.compile(rf"^({'|'.join(SECTIONS)}|Answer):[ \t]*", re.MULTILINE)


def split_sections(text: str) -> list[tuple[str, int, int]]:
    """Each heading with the start and stop of the text below it, in order."""
    headings = list(HEADING.finditer(text))
    stops = [*(m.start() for m in headings[1:]), len(text)]
    return [(m[1], m.end(), stop) for m, stop in zip(headings, stops, strict=False)]


def remove_section(text: str, section: str) -> str:
    """The text without one section and its heading."""
    for heading in HEADING.finditer(text):
        if heading[1] == section:
            following = HEADING.search(text, heading.end())
            return text[: heading.start()] + (text[following.start() :] if following else "")
    return text


def text_before_sections(text: str) -> str:
    """The text before the first heading; empty without a heading."""
    first = HEADING.search(text)
    return text[: first.start()] if first else ""
