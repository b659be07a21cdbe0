"""Replace words for places and relations in the answers that train the tiny base by false ones.

A model makes mistakes in the predictions and descriptions that it writes. If it was trained only on
true texts, it relies on these mistakes when it chooses a candidate. Here, some words are replaced,
and the loss ignores them: the base learns to continue correctly after a mistake, but not to write
one.
"""

from __future__ import annotations

import re

import numpy as np

from dynapix.data.records import COLORS
from dynapix.teacher.predicates.facts import REGIONS
from dynapix.teacher.predicates.relations import VALUES
from dynapix.teacher.sections import split_sections
from dynapix.teacher.writers.relational import PHRASES

FALSIFIED_SECTIONS = ("Prediction", "Candidate analysis")
KINDS = ("side", "height", "gap", "cover", "extreme")
"""Kinds of relations whose words are replaced by another word of the kind."""


def list_alternatives() -> dict[str, list[str]]:
    """Return the words that may replace each word: for a region those beside it, and for a relation
    the others of its kind."""
    found = {
        region: [
            other
            for y, others in enumerate(REGIONS)
            for x, other in enumerate(others)
            if abs(x - column) + abs(y - row) == 1
        ]
        for row, regions in enumerate(REGIONS)
        for column, region in enumerate(regions)
    }
    for kind in KINDS:
        words = [PHRASES[value].removesuffix(" {b}") for value in VALUES[kind]]
        found |= {word: [other for other in words if other != word] for word in words}
    return found


ALTERNATIVES = list_alternatives()
WORD = re.compile(
    rf"\b(?:{'|'.join(sorted(ALTERNATIVES, key=len, reverse=True))})"
    # "near" is a relation only before an object: "near the red cube", "near it".
    rf"(?![-\w])(?:(?<!\bnear)|(?= it\b| the (?:{'|'.join(COLORS)})\b))"
)


def falsify_words(
    text: str, share: float, rng: np.random.Generator
) -> tuple[str, tuple[tuple[int, int], ...]]:
    """Replace a share of the words for places and relations in predictions and candidate analyses.

    Args:
        share: Probability that a word is replaced.
        rng: Chooses the words and their replacements.

    Returns:
        The text, and the spans that are not to be trained: each false word and the character after
        it, because "near the top" may replace "near the top-left".
    """
    parts, spans, length, end = [], [], 0, 0
    for title, start, stop in split_sections(text):
        if title not in FALSIFIED_SECTIONS:
            continue
        for match in WORD.finditer(text, start, stop):
            if rng.random() >= share:
                continue
            options = ALTERNATIVES[match.group()]
            false = options[rng.integers(len(options))]
            before = text[end : match.start()]
            parts += [before, false]
            length += len(before) + len(false)
            spans.append((length - len(false), length + 1))
            end = match.end()
    return "".join([*parts, text[end:]]), tuple(spans)
