"""Split a section of a rationale into tags: noun phrases of objects, regions, phrases of
phrases.yaml, candidates' letters and punctuation."""

from __future__ import annotations

import re
from collections.abc import Container, Iterator, Sequence
from typing import NamedTuple

from data.records import LETTERS
from teacher.predicates import REGIONS
from teacher.reading.nouns import (
    AT,
    COLOR_WORDS,
    COLUMNS,
    IMAGE,
    MATERIAL_WORDS,
    MIDDLE,
    PLACES,
    PLURALS,
    RIGHT_ONES,
    ROWS,
    SHAPE_WORDS,
    SIDES,
    SINGULARS,
    WAYS,
)
from teacher.reading.phrases import COARSE, PHRASES

WORD = re.compile(r"[^\W\d_]+(?:['’][^\W\d_]+)?|[.,;:!?()—–]")
ARTICLES = {"the", "a", "an", "its", "their", "that", "this", "some", "any", "another", "such"}
STILL_WORDS = {"stationary", "still", "resting", "motionless", "static", "unmoving"}
QUALITIES = STILL_WORDS | {
    *("moving", "rolling", "fast", "slow", "quick", "incoming", "approaching", "colliding"),
    *("struck", "hidden", "visible", "nearby", "distant", "lone", "only", "same", "remaining"),
    "other",
}
"""Adjectives allowed before an object's colour."""
CANDIDATES = frozenset(LETTERS)
EVENTS = {"pair", "collision", "contact", "course", "slight", "short", "layout", "scene", "motion"}
"""Nouns and adjectives that do not describe objects; an "A" that one of them follows is an
article."""
LISTED = {"candidate", "candidates", "image", "images", "option", "options", "layout", "answer"}
"""Words without a tag. An "A" that follows one of them is a candidate's letter."""
PUNCTUATION = {
    **dict.fromkeys(".!?", "stop"),
    **dict.fromkeys(",()—–", "comma"),
    **dict.fromkeys(";:", "semicolon"),
}


class Noun(NamedTuple):
    """A noun phrase for an object; attributes that it does not state are ""."""

    color: str
    material: str
    shape: str
    plural: bool
    still: bool
    others: bool

    @property
    def phrase(self) -> str:
        return " ".join(filter(None, (self.color, self.material, self.shape or "object")))

    def fits(self, name: str) -> bool:
        """Whether an object's name has all stated attributes."""
        return {self.color, self.material, self.shape} - {""} <= set(name.split())


class Tag(NamedTuple):
    """A piece of a sentence: its tag, value, position in the text, and its text in lower case."""

    tag: str
    value: str | Noun
    start: int
    stop: int
    words: str

    @property
    def last_word(self) -> str:
        return self.words.split()[-1] if self.words else ""


BOUNDARIES = {"comma", "semicolon", "and", "break", "stop"}
"""Tags that may end a clause."""
END = Tag("stop", "", 0, 0, "")
"""The tag at every index outside a sentence."""


class Sentence:
    """The tags of a sentence; an index outside it returns END."""

    def __init__(self, text: str, tags: Sequence[Tag]) -> None:
        """`text`: the whole text, to which the positions of the tags refer."""
        self.text = text
        self.tags = tags

    def __getitem__(self, index: int) -> Tag:
        return self.tags[index] if 0 <= index < len(self.tags) else END

    def __iter__(self) -> Iterator[Tag]:
        return iter(self.tags)

    def skip(self, index: int, skipped: Container[str], step: int = 1) -> int:
        """Return the index of the first tag that is not in `skipped`, from `index` on in the
        direction of `step`; an index outside the sentence if there is none."""
        while 0 <= index < len(self.tags) and self.tags[index].tag in skipped:
            index += step
        return index

    def find(self, index: int, wanted: Container[str], step: int = 1) -> int:
        """Return the index of the first tag that is in `wanted`, from `index` on in the direction
        of `step`; an index outside the sentence if there is none."""
        while 0 <= index < len(self.tags) and self.tags[index].tag not in wanted:
            index += step
        return index


def find_tags(text: str, start: int, stop: int) -> list[Tag]:
    """Return the tags of text[start:stop] in order. Articles and `LISTED` words are left out; other
    words without a meaning here get the tag "word"."""
    words, raw, spans = _split_words(text, start, stop)
    found: list[Tag] = []
    i = 0
    while i < len(spans):
        tag, value, end = _tag_at(words, raw, i)
        if tag:
            first, last = spans[i][0], spans[end - 1][1]
            found.append(Tag(tag, value, first, last, text[first:last].lower()))
        i = end
    return found


def _split_words(
    text: str, start: int, stop: int
) -> tuple[list[str], list[str], list[tuple[int, int]]]:
    """Return the words in lower case, followed by "", the words as written, and their spans.
    "Doesn't" becomes "does" and "not"; other suffixes after an apostrophe are dropped."""
    words, raw, spans = [], [], []
    for match in WORD.finditer(text, start, stop):
        whole = match[0]
        stem, _, ending = whole.lower().replace("’", "'").partition("'")
        if ending == "t" and stem.endswith("n"):
            parts = [{"ca": "can", "wo": "will"}.get(stem[:-1], stem[:-1]), "not"]
        else:
            parts = [stem]
            if ending and whole[0] in CANDIDATES:
                whole = whole[0]
        words += parts
        raw += [whole] * len(parts)
        spans += [match.span()] * len(parts)
    return [*words, ""], raw, spans


Found = tuple[str, str | Noun, int]
"""A tag, its value, and the index of the next word."""


def _tag_at(words: list[str], raw: list[str], i: int) -> Found:
    """Return the tag that begins at word i."""
    word = words[i]
    if word in PUNCTUATION:
        return PUNCTUATION[word], word, i + 1
    if raw[i] in CANDIDATES and not _is_article(words, raw[i], i):
        return "candidate", raw[i], i + 1
    if word in NOUN_STARTS and (found := _find_noun(words, i)):
        return found
    if word in REGION_STARTS and (found := _find_region(words, i)):
        return found
    for phrase, tag, value in PHRASES.get(word, ()):
        if tuple(words[i : i + len(phrase)]) == phrase:
            return tag, value, i + len(phrase)
    if word in ARTICLES or word in LISTED:
        return "", "", i + 1
    return "word", word, i + 1


def _is_article(words: list[str], letter: str, i: int) -> bool:
    """Return whether an "A" is an article. An unclear "A" is a candidate's letter: if a letter were
    taken for an article, the next claims would be about another candidate."""
    described = words[i + 1] in ADJECTIVES or words[i + 1] in EVENTS
    return letter == "A" and described and not (i > 0 and words[i - 1] in LISTED)


def _find_noun(words: list[str], i: int) -> Found | None:
    """Return the noun phrase for an object that begins at word i, as "the stationary red cube"."""
    still = others = False
    while words[i] in ARTICLES or words[i] in QUALITIES:
        still |= words[i] in STILL_WORDS
        others |= words[i] in ("other", "another", "remaining")
        i += 1
    if words[i] in ("two", "both"):
        i += 1
    color = COLOR_WORDS.get(words[i], "")
    i += bool(color)
    material = MATERIAL_WORDS.get(words[i], "")
    i += bool(material)
    shape = SINGULARS.get(words[i], PLURALS.get(words[i]))
    if shape is None or not (color or material or shape):
        return None
    return "object", Noun(color, material, shape, words[i] in PLURALS, still, others), i + 1


def _find_region(words: list[str], i: int) -> Found | None:
    """Return the region that begins at word i: "near the top-left", "to the upper left corner"."""
    begin, way = i, "region"
    while words[i] in AT:
        way = WAYS.get(words[i], way)
        i += 1
    has_preposition = i > begin
    begin = i
    while words[i] in REGION_FILLERS:
        i += 1
    definite = "the" in words[begin:i] or "its" in words[begin:i]
    row = column = None
    middle = False
    begin = i
    while True:
        if words[i] in ROWS and row is None:
            row = ROWS[words[i]]
        elif words[i] in COLUMNS and column is None:
            column = COLUMNS[words[i]]
        elif words[i] in MIDDLE and not middle:
            middle = True
        else:
            break
        i += 1
    corner = row is not None and column is not None
    noun = words[i]
    named = noun in PLACES or noun in SIDES
    if words[i - 1] == "right" and noun in RIGHT_ONES:
        # "In the right place" is not a region.
        return None
    if i == begin or not (named or corner or (has_preposition and (definite or middle))):
        return None
    i += named
    if words[i] == "of":
        end = i + 2 if words[i + 1] == "the" else i + 1
        if words[end] in IMAGE:
            i = end + 1
        elif not named:
            # "To the left of the cube" is not a region.
            return None
    region = REGIONS[1 if row is None else row][1 if column is None else column]
    coarse = noun in SIDES and not corner
    return way, (COARSE if coarse else "") + region, i


REGION_FILLERS = {"the", "its", "very", "far", "area", "region", "near", "same", "around", "of"}
REGION_STARTS = {*AT, *ROWS, *COLUMNS, *MIDDLE, "the"}
LOOKS = {*COLOR_WORDS, *MATERIAL_WORDS, *SHAPE_WORDS, *PLURALS}
NOUN_STARTS = ARTICLES | QUALITIES | LOOKS
ADJECTIVES = LOOKS | QUALITIES - {"still", "only", "same"}
