"""Find the letters of candidates in a rationale, and replace them when candidates are permuted."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from itertools import pairwise
from operator import add

from dynapix.data.records import LETTERS, SelectionItem

ANALYSIS = re.compile(r"(?<=Candidate analysis:).*?(?=^\w[\w ]*:|\Z)", re.MULTILINE | re.DOTALL)
CANDIDATE = re.compile(r"(?:\A|[.!?\n])\s*(?P<start>Candidate (?P<letter>[A-Z])\b)")
"""Matches where a sentence begins to describe a candidate."""
LETTER = re.compile(rf"\b[{''.join(LETTERS)}]\b")
SENTENCE_START = re.compile(r"(?:\A|[.!?:;\n(\"“—–-])\s*\Z")
NEXT_WORD = re.compile(r"[ \n]+([A-Za-z]+)")
FOLLOWS_LETTER = re.compile(
    "and|or|nor|alone|also|too|then|still|never|always|only|itself|again|cannot|can|will|would"
    "|should|could|must|may|might|did|had|now|likewise|here|thus|therefore|instead|however|meanwhile"
)
"""Words that can follow the letter "A" but not the article. An "A" at the start of a sentence names
a candidate if one of these words, a verb that ends in "s", or punctuation follows it."""


def find_letters(text: str) -> list[tuple[int, int]]:
    """Return the spans of the letters that name candidates, in text order, without articles "A"."""
    return [
        m.span() for m in LETTER.finditer(text) if m[0] != "A" or not _is_article(text, *m.span())
    ]


def relabel_text(text: str, order: Sequence[int]) -> str:
    """Return a rationale whose letters name the same candidates after these are reordered.

    If the candidate analysis describes the candidates in alphabetical order, it is sorted again, so
    that a student always writes A, B, C and D in this order.

    Args:
        text: A rationale for the old order that the validator accepts.
        order: `order[new]` is the old position of the candidate at the position `new`.
    """
    letter_of = {LETTERS[old]: LETTERS[new] for new, old in enumerate(order)}
    pieces, end = [], 0
    for start, stop in find_letters(text):
        pieces += [text[end:start], letter_of[text[start:stop]]]
        end = stop
    analysis = ANALYSIS.search(text)
    letters = [m["letter"] for m in CANDIDATE.finditer(analysis[0])] if analysis else []
    text = "".join([*pieces, text[end:]])
    return ANALYSIS.sub(_sort_by_letter, text) if letters == list(LETTERS) else text


def _sort_by_letter(analysis: re.Match[str]) -> str:
    """Return a candidate analysis with its candidates in the order of their letters. The white
    space between them stays where it is."""
    text = analysis[0]
    starts = [m.start("start") for m in CANDIDATE.finditer(text)]
    parts = [text[a:b] for a, b in pairwise([*starts, len(text)])]
    described = sorted(part.rstrip() for part in parts)
    spaces = [part[len(part.rstrip()) :] for part in parts]
    return text[: starts[0]] + "".join(map(add, described, spaces))


def reorder_candidates(item: SelectionItem, order: Sequence[int]) -> SelectionItem:
    """Return an item with its candidates in another order; see `relabel_text`."""
    candidates = tuple(item.candidates[old] for old in order)
    return replace(item, candidates=candidates, answer=list(order).index(item.answer))


def _is_article(text: str, start: int, stop: int) -> bool:
    """Return whether an "A" is the article of a noun phrase at the start of a sentence, as in "A
    slowly moving cube". Adverbs in "-ly" are skipped: the word after them decides."""
    if not SENTENCE_START.search(text, max(0, start - 4), start):
        return False
    while following := NEXT_WORD.match(text, stop):
        word = following[1].lower()
        if not word.endswith("ly"):
            is_verb = word.endswith("s") and not word.endswith(("ss", "ous"))
            return not is_verb and not FOLLOWS_LETTER.fullmatch(word)
        stop = following.end()
    return False
