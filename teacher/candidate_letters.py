"""Where a rationale names candidates by their letters, and the same rationale for another order."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace

from data.records import LETTERS, SelectionItem

LETTER = re.compile(rf"\b[{''.join(LETTERS)}]\b")
OPENING = re.compile(r"(?:\A|[.!?:;\n(\"“—–-])\s*\Z")
FOLLOWING = re.compile(r"[ \n]+([A-Za-z]+)")
BESIDE_VERBS = re.compile(
    "and|or|nor|alone|also|too|then|still|never|always|only|itself|again|cannot|can|will|would"
    "|should|could|must|may|might|did|had|now|likewise|here|thus|therefore|instead|however|meanwhile"
)
"""What may follow a letter that opens a sentence, beside verbs in -s and marks."""


def letters(text: str) -> list[tuple[int, int]]:
    """Spans of the letters that name candidates, in order; the article "A" is none of them."""
    return [
        m.span() for m in LETTER.finditer(text) if m[0] != "A" or not _is_article(text, *m.span())
    ]


def relabel_text(text: str, order: Sequence[int]) -> str:
    """A rationale for the same candidates in another order.

    Args:
        text: a rationale whose letters are those of the first order, as the validator lets through.
        order: for each place in the new order, the place that its candidate had in the first one.
    """
    _check(order)
    letter_of = {LETTERS[old]: LETTERS[new] for new, old in enumerate(order)}
    pieces, at = [], 0
    for start, stop in letters(text):
        pieces += [text[at:start], letter_of[text[start:stop]]]
        at = stop
    return "".join([*pieces, text[at:]])


def reorder_candidates(item: SelectionItem, order: Sequence[int]) -> SelectionItem:
    """An item with its candidates in another order; see `relabel`."""
    _check(order)
    candidates = tuple(item.candidates[old] for old in order)
    return replace(item, candidates=candidates, answer=list(order).index(item.answer))


def _check(order: Sequence[int]) -> None:
    if sorted(order) != list(range(len(LETTERS))):
        raise ValueError(f"{list(order)} is no order of {len(LETTERS)} candidates")


def _is_article(text: str, start: int, stop: int) -> bool:
    """Whether an "A" opens a sentence and a noun phrase, as in "A slowly moving cube"."""
    if not OPENING.search(text, max(0, start - 4), start):
        return False
    while following := FOLLOWING.match(text, stop):
        word = following[1].lower()
        if not word.endswith("ly"):
            ends_as_verb = word.endswith("s") and not word.endswith(("ss", "ous"))
            return not ends_as_verb and not BESIDE_VERBS.fullmatch(word)
        stop = following.end()
    return False
