"""Splits a section of a rationale into tags: noun phrases, regions and phrases of the
vocabulary."""

from __future__ import annotations

import re
from typing import NamedTuple

from data.records import LETTERS
from teacher.predicates import REGIONS
from teacher.reading import nouns, phrases

WORD = re.compile(r"[^\W\d_]+(?:['’][^\W\d_]+)?|[.,;:!?()—–]")
ARTICLES = {"the", "a", "an", "its", "their", "that", "this", "some", "any", "another", "such"}
STILL_WORDS = {"stationary", "still", "resting", "motionless", "static", "unmoving"}
QUALITIES = STILL_WORDS | {
    *(
        "moving",
        "fast",
        "slow",
        "quick",
        "nearby",
        "rolling",
        "same",
        "struck",
        "hidden",
        "visible",
    ),
    *("incoming", "approaching", "lone", "only", "distant", "colliding", "remaining", "other"),
}
"""Adjectives allowed before an object's colour."""
CANDIDATES = frozenset(LETTERS)
EVENTS = {"pair", "collision", "contact", "course", "slight", "short", "layout", "scene", "motion"}
STOPS = {".", "!", "?"}
LISTED = {"candidate", "candidates", "image", "images", "option", "options", "layout", "answer"}
PUNCTUATION = {
    **dict.fromkeys(STOPS, "stop"),
    **dict.fromkeys(",()—–", "comma"),
    ";": "semicolon",
    ":": "semicolon",
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


class Tag(NamedTuple):
    """A piece of a sentence: its tag, value and position in the text."""

    tag: str
    value: str | Noun
    start: int
    stop: int


def tags(text: str, start: int, stop: int) -> list[Tag]:
    """The tags of text[start:stop] in order. Words outside the vocabulary are tagged "word"."""
    words, raw, spans = _words(text, start, stop)
    found: list[Tag] = []
    i, count = 0, len(words)
    while i < count:
        tag, value, end = _at(words, raw, i)
        if tag:
            found.append(Tag(tag, value, spans[i][0], spans[end - 1][1]))
        i = end
    return found


def _words(text: str, start: int, stop: int) -> tuple[list[str], list[str], list[tuple[int, int]]]:
    words, raw, spans = [], [], []
    for match in WORD.finditer(text, start, stop):
        whole = match[0]
        word = whole.lower()
        if "'" in word or "’" in word:
            word = word.replace("’", "'")
            if word.endswith("n't"):
                words.append({"ca": "can", "wo": "will"}.get(word[:-3], word[:-3]))
                raw.append(whole)
                spans.append(match.span())
                word = "not"
            else:
                word, whole = word.split("'")[0], whole[0] if whole[0] in CANDIDATES else whole
        words.append(word)
        raw.append(whole)
        spans.append(match.span())
    return words, raw, spans


def _at(words: list[str], raw: list[str], i: int) -> tuple[str, str | Noun, int]:
    """The tag at word i, its value, and the word after it."""
    word = words[i]
    if word in PUNCTUATION:
        return PUNCTUATION[word], word, i + 1
    if raw[i] in CANDIDATES and not _is_article(words, raw[i], i):
        return "candidate", raw[i], i + 1
    if word in NOUN_STARTS:
        noun, end = _noun(words, i)
        if noun:
            return "object", noun, end
    if word in REGION_STARTS:
        tag, region, end = _region(words, i)
        if tag:
            return tag, region, end
    for phrase, tag, value in phrases.PHRASES.get(word, ()):
        if len(phrase) == 1 or tuple(words[i : i + len(phrase)]) == phrase:
            return tag, value, i + len(phrase)
    if word in ARTICLES or word in LISTED:
        return "", "", i + 1
    return "word", word, i + 1


def _is_article(words: list[str], letter: str, i: int) -> bool:
    """Whether an "A" is an article. In doubt it is a candidate, unlike in
    `teacher.candidate_letters`: a letter taken for an article would assign the following claims to
    another candidate."""
    following = words[i + 1] if i + 1 < len(words) else "."
    described = following in ADJECTIVES or following in EVENTS
    return letter == "A" and described and not (i > 0 and words[i - 1] in LISTED)


def _noun(words: list[str], i: int) -> tuple[Noun | None, int]:
    still = others = False
    count = len(words)
    while i < count and (words[i] in ARTICLES or words[i] in QUALITIES or words[i] == "the"):
        still |= words[i] in STILL_WORDS
        others |= words[i] in ("other", "another", "remaining")
        i += 1
    if i < count and words[i] in ("two", "both"):
        i += 1
    color = nouns.COLOR_WORDS.get(words[i], "") if i < count else ""
    i += bool(color)
    material = nouns.MATERIAL_WORDS.get(words[i], "") if i < count else ""
    i += bool(material)
    if i >= count:
        return None, i
    word = words[i]
    if word in nouns.SHAPE_WORDS:
        return Noun(color, material, nouns.SHAPE_WORDS[word], False, still, others), i + 1
    if word in nouns.PLURALS and (color or material or nouns.PLURALS[word]):
        return Noun(color, material, nouns.PLURALS[word], True, still, others), i + 1
    if word in nouns.ANY_SHAPE and (color or material):
        return Noun(color, material, "", False, still, others), i + 1
    return None, i


def _region(words: list[str], i: int) -> tuple[str, str, int]:
    """A region from word i on as a tag, a value and the index after it: "near the top-left", "to
    the upper left corner", "the center"."""
    count, way = len(words), ""
    prepared = False
    while i < count and words[i] in nouns.AT:
        way = nouns.WAYS.get(words[i], way)
        prepared = True
        i += 1
    article = False
    while i < count and words[i] in REGION_FILLERS:
        article |= words[i] in ("the", "its")
        i += 1
    row, column, middle, begin = None, None, False, i
    while i < count:
        word = words[i]
        if word in nouns.ROWS and row is None:
            row = nouns.ROWS[word]
        elif word in nouns.COLUMNS and column is None:
            column = nouns.COLUMNS[word]
        elif word in nouns.MIDDLE and not middle:
            middle = True
        else:
            break
        i += 1
    corner = row is not None and column is not None
    noun = words[i] if i < count else ""
    named = noun in nouns.PLACES or noun in nouns.SIDES
    if words[i - 1] == "right" and noun in nouns.RIGHT_ONES:
        # "In the right place" is not a region.
        return "", "", i
    if i == begin or not (named or corner or (prepared and (article or middle))):
        return "", "", i
    i += named
    if words[i : i + 1] == ["of"]:
        end = i + 2 if words[i + 1 : i + 2] == ["the"] else i + 1
        if words[end : end + 1] and words[end] in nouns.IMAGE:
            i = end + 1
        elif not named:
            # "to the left of the cube" is not a region.
            return "", "", i
    region = REGIONS[1 if row is None else row][1 if column is None else column]
    coarse = noun in nouns.SIDES and not corner
    return way or "region", (phrases.COARSE if coarse else "") + region, i


REGION_FILLERS = {"the", "its", "very", "far", "area", "region", "near", "same", "around", "of"}
REGION_STARTS = {
    *nouns.AT,
    *nouns.ROWS,
    *nouns.COLUMNS,
    *nouns.MIDDLE,
    "the",
}
LOOKS = {
    *nouns.COLOR_WORDS,
    *nouns.MATERIAL_WORDS,
    *nouns.SHAPE_WORDS,
    *nouns.PLURALS,
}
NOUN_STARTS = ARTICLES | QUALITIES | LOOKS
ADJECTIVES = LOOKS | QUALITIES - {"still", "only", "same"}
