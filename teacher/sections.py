"""The sections of a rationale and where they stand in its text."""

from __future__ import annotations

import re

SECTIONS = ("Scene parse", "Motion analysis", "Prediction", "Candidate analysis", "Outcome")
"""Headings of a rationale in order; the line "Answer: X" ends it."""
HEADING = re.compile(rf"^({'|'.join(SECTIONS)}|Answer):[ \t]*", re.MULTILINE)


def split_sections(text: str) -> list[tuple[str, int, int]]:
    """Each heading of a text with the bounds of what stands below it, in order."""
    headings = list(HEADING.finditer(text))
    starts = [*(m.start() for m in headings), len(text)]
    return [(m[1], m.end(), starts[k + 1]) for k, m in enumerate(headings)]


def remove_section(text: str, section: str) -> str:
    """A text without one of its sections, heading and all."""
    for heading in HEADING.finditer(text):
        if heading[1] == section:
            following = HEADING.search(text, heading.end())
            return text[: heading.start()] + (text[following.start() :] if following else "")
    return text


def opening(text: str) -> str:
    """What stands before a text's first heading; nothing where there is none."""
    first = HEADING.search(text)
    return text[: first.start()] if first else ""
