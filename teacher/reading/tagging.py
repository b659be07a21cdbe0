"""Split a section of a rationale into tags: pieces of text with a name that says what they are.

The names are "object" ("the red cube"), "region" ("near the left"; "into", "from" or "toward" after
these prepositions), "relation" ("left of the red cube"), "candidate" (a letter), "comma",
"semicolon", "stop", "word" (a word without a meaning here), and the names in phrases.yaml.
"""

from __future__ import annotations

import re
from collections import defaultdict
from collections.abc import Iterable
from importlib.resources import files
from typing import NamedTuple

import yaml

from dynapix.data.records import COLORS, LETTERS, MATERIALS, SHAPES
from dynapix.teacher.predicates.facts import COMPASS, REGIONS
from dynapix.teacher.predicates.relations import KINDS
from dynapix.teacher.reading.claims import COARSE

WORD = re.compile(r"[^\W\d_]+(?:['’][^\W\d_]+)?|[.,;:!?()—–]")
ARTICLES = {"the", "a", "an", "its", "their", "that", "this"}
STILL_WORDS = {"stationary", "still", "resting", "motionless", "static", "unmoving"}
QUALITIES = STILL_WORDS | {"moving", "same", "only"}
"""Adjectives that may precede the color of an object, as in "the stationary red cube"."""
CANDIDATES = frozenset(LETTERS)
AFTER_ARTICLE = {
    *("pair", "collision", "contact", "course", "slight", "short", "layout", "scene", "motion"),
}
"""Words that follow the article "A", besides adjectives of objects; else "A" is a candidate."""
LABELS = {"candidate", "candidates", "image", "images", "option", "options"}
"""Nouns for a candidate, which have no tag. An "A" after one of them is a candidate's letter."""
PUNCTUATION = {
    **dict.fromkeys(".!?", "stop"),
    **dict.fromkeys(",()—–", "comma"),
    **dict.fromkeys(";:", "semicolon"),
}

# Words of noun phrases and regions.
COLOR_WORDS = {**{c: c for c in COLORS}, "grey": "gray"}
MATERIAL_WORDS = {**{m: m for m in MATERIALS}, "metallic": "metal", "rubbery": "rubber"}
SHAPE_WORDS = {**{s: s for s in SHAPES}, "ball": "sphere", "block": "cube"}
SINGULARS = SHAPE_WORDS | dict.fromkeys(("object", "one", "body", "item", "thing", "solid"), "")
"""The shape that each noun in the singular states; "" if it states none."""
PLURALS = {**{f"{word}s": shape for word, shape in SHAPE_WORDS.items()}, "objects": ""}
ROWS = {"top": 0, "upper": 0, "bottom": 2, "lower": 2}
COLUMNS = {"left": 0, "right": 2}
"""The row and column of `REGIONS` for each word; without such a word, it is 1."""
MIDDLE = {"center", "centre", "middle", "central"}
PLACE_NOUNS = {"corner", "area", "region", "part", "portion", "zone", "section"}
"""Nouns that may end a region, as in "the top-left corner"."""
SIDE_NOUNS = {"side", "edge", "border", "boundary"}
"""Nouns that make a region coarse: "the left side" consists of three regions."""
NOT_RIGHT_SIDE = {
    *("place", "places", "spot", "spots", "position", "positions", "location", "locations"),
    *("object", "objects", "layout", "candidate", "answer", "choice", "way", "order", "time"),
}
"""Nouns before which "right" means "correct", as in "in the right place"."""
PREPOSITIONS = {
    *("near", "at", "in", "on", "along", "by", "around", "within", "inside", "toward", "towards"),
    *("to", "into", "from", "onto"),
}
"""Prepositions that may begin a region."""
REGION_TAGS = {"to": "into", "towards": "toward"} | {w: w for w in ("into", "from", "toward")}
"""The tag of a region after these prepositions; after others, the tag is "region"."""
PRONOUNS = {"it", "itself", "them"}
"""Pronouns for the other object of a relation."""
PLACED = {
    *("is", "are", "be", "was", "were", "been", "will", "not", "as"),
    *("stays", "remains", "lies", "sits", "rests", "stands"),
    *("stay", "remain", "lie", "sit", "rest", "stand"),
}
"""Words before an ambiguous phrase that make it a relation."""
AMBIGUOUS = {"between", "in", "comes", "come", "coming", "moves", "against"}
"""First words of phrases that state a relation only after an object or a verb of `PLACED`."""
JOINTS = {
    "between": ("and",),
    "arrival": ("and",),
    "nearer": ("than to", "than", "as to", "as", "and to", "and"),
}
"""Words between the two other objects of a relation. Other kinds have one object or none."""
ALONE = {"extreme", "edge"}
"""Kinds of relations without other objects."""
IMAGE_NOUNS = {"view", "scene", "image", "frame", "picture", "screen", "field"}
REGION_FILLERS = {"the", "its", "very", "far", "area", "region", "near", "same", "around", "of"}
REGION_STARTS = {*PREPOSITIONS, *ROWS, *COLUMNS, *MIDDLE, "the", "close", "very"}
LOOKS = {*COLOR_WORDS, *MATERIAL_WORDS, *SHAPE_WORDS, *PLURALS}
NOUN_STARTS = ARTICLES | QUALITIES | LOOKS
ADJECTIVES = LOOKS | QUALITIES - {"still", "only", "same"}


ENDINGS = ("", "ern", "ward", "wards", "erly", "bound", "wardly")
"""Endings of a compass direction, as in "eastward" and "eastbound"."""
Phrase = tuple[tuple[str, ...], str, str]
"""The words of a phrase, the name of its tag, and the value of the tag ("" if it has none)."""


def _read_phrases() -> dict[str, list[Phrase]]:
    source = (files("dynapix.teacher.reading") / "phrases.yaml").read_text(encoding="utf-8")
    phrases: dict[str, list[Phrase]] = defaultdict(list)
    for tag, listed in yaml.safe_load(source).items():
        values = listed if isinstance(listed, dict) else {"": listed}
        for value, text in values.items():
            for phrase in text.split(";"):
                words = tuple(phrase.split())
                phrases[words[0]].append((words, tag, value))
    for direction in COMPASS:
        # "Northeastern" may also be two words.
        for stem in {direction, re.sub("^(north|south)(?=east|west)", r"\1 ", direction)}:
            for ending in ENDINGS:
                words = tuple((stem + ending).split())
                phrases[words[0]].append((words, "direction", direction))
    return {first: sorted(found, key=lambda p: -len(p[0])) for first, found in phrases.items()}


PHRASES_BY_FIRST_WORD = _read_phrases()
"""All phrases of phrases.yaml, and the compass directions, by their first word, the longest
first."""


class Name(str):
    """Words of a text that end the name of an object whose noun is none of `SHAPES`, such as "van"
    and "red van"."""


class Noun(NamedTuple):
    """The attributes that a noun phrase states ("" if it does not state one). `still` is true for
    "the stationary red cube"."""

    color: str
    material: str
    shape: str
    plural: bool
    still: bool

    @property
    def phrase(self) -> str:
        """The stated attributes, such as "red cube" or "red object"."""
        return " ".join(filter(None, (self.color, self.material, self.shape or "object")))

    def fits(self, name: str) -> bool:
        """Return whether an object's name, such as "red metal cube", has all stated attributes."""
        stated = f"{self.color} {self.material} {self.shape}"
        return {*stated.split()} <= {*name.split()}


class RelationPhrase(NamedTuple):
    """A relation to other objects, such as "left of the red cube": its value, and the objects; None
    for a pronoun."""

    value: str
    nouns: tuple[Noun | None, ...]


class Tag(NamedTuple):
    """A piece of a sentence, text[start:stop], and its text in lower case, `words`.

    `name` says what the piece is, and selects the method of a reader that reads it. `value` is its
    meaning: for "near the top left corner", the name is "region" and the value is "near the
    top-left". It is a `Noun` if the name is "object", a `RelationPhrase` if it is "relation", and
    "" if the name says everything.
    """

    name: str
    value: str | Noun | RelationPhrase
    start: int
    stop: int
    words: str

    @property
    def last_word(self) -> str:
        return self.words.split()[-1] if self.words else ""


END = Tag("stop", "", 0, 0, "")
"""Stands for the tag after the last one of a sentence."""


def find_tags(text: str, start: int, stop: int, names: Iterable[str] = ()) -> list[Tag]:
    """Return the tags of text[start:stop] in order. Articles and `LABELS` are left out.

    Args:
        names: Names of objects. Those with a noun of `SHAPES` are known without.
    """
    words, raw, spans = _split_words(text, start, stop)
    if other := [name for name in names if name.split()[-1] not in SHAPES]:
        _join_names(words, raw, spans, other)
    found: list[Tag] = []
    i = 0
    while i < len(spans):
        name, value, end = _tag_at(words, raw, i)
        if name:
            first, last = spans[i][0], spans[end - 1][1]
            found.append(Tag(name, value, first, last, text[first:last].lower()))
        i = end
    return found


def _split_words(
    text: str, start: int, stop: int
) -> tuple[list[str], list[str], list[tuple[int, int]]]:
    """Return the words in lower case and a final "", the words as written, and their spans.
    "Doesn't" becomes "does" and "not"; other endings after an apostrophe are dropped."""
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


def _join_names(
    words: list[str], raw: list[str], spans: list[tuple[int, int]], names: Iterable[str]
) -> None:
    """Replace the words of each name, or of its end, by a `Name`; the longest one counts."""
    ends = {
        tuple(parts[k:]) for name in names if (parts := name.split()) for k in range(len(parts))
    }
    longest = sorted(ends, key=len, reverse=True)
    for i in range(len(spans)):
        size = next((len(end) for end in longest if tuple(words[i : i + len(end)]) == end), 0)
        if size:
            words[i : i + size] = [Name(" ".join(words[i : i + size]))]
            raw[i : i + size] = raw[i : i + 1]
            spans[i : i + size] = [(spans[i][0], spans[i + size - 1][1])]


Found = tuple[str, str | Noun | RelationPhrase, int]
"""The name and value of a tag, and the index of the word after it."""


def _tag_at(words: list[str], raw: list[str], i: int) -> Found:
    """Return the tag that begins at word i; its name is "" if the word has no tag."""
    word = words[i]
    if word in PUNCTUATION:
        return PUNCTUATION[word], word, i + 1
    if raw[i] in CANDIDATES and not _is_article(words, raw[i], i):
        return "candidate", raw[i], i + 1
    if (word in NOUN_STARTS or isinstance(word, Name)) and (found := _find_noun(words, i)):
        return found
    if word in REGION_STARTS and (found := _find_region(words, i)):
        return found
    for phrase, name, value in PHRASES_BY_FIRST_WORD.get(word, ()):
        if tuple(words[i : i + len(phrase)]) == phrase:
            if phrase[-1] == "right" and words[i + len(phrase)] in ("of", "against"):
                # "Is right of the red cube" does not say that something is right.
                continue
            if name != "relation":
                return name, value, i + len(phrase)
            if found := _find_relation(words, i, i + len(phrase), value):
                return found
    if word in ARTICLES or word in LABELS:
        return "", "", i + 1
    return "word", word, i + 1


def _is_article(words: list[str], letter: str, i: int) -> bool:
    """Return whether an "A" is an article. In doubt it is a candidate's letter: if a letter were
    taken for an article, the claims after it would be assigned to another candidate."""
    after = words[i + 1]
    described = after in ADJECTIVES or after in AFTER_ARTICLE or isinstance(after, Name)
    return letter == "A" and described and not (i > 0 and words[i - 1] in LABELS)


def _find_noun(words: list[str], i: int) -> Found | None:
    """Return the noun phrase at word i, such as "the stationary red cube", if there is one."""
    still = False
    while words[i] in ARTICLES or words[i] in QUALITIES:
        still |= words[i] in STILL_WORDS
        i += 1
    color = COLOR_WORDS.get(words[i], "")
    i += bool(color)
    material = MATERIAL_WORDS.get(words[i], "")
    i += bool(material)
    shape = SINGULARS.get(words[i], PLURALS.get(words[i]))
    if isinstance(words[i], Name):
        shape = words[i]
    if shape is None or not (color or material or shape):
        return None
    return "object", Noun(color, material, shape, words[i] in PLURALS, still), i + 1


def _find_relation(words: list[str], begin: int, i: int, value: str) -> Found | None:
    """Return the relation at word `begin` whose objects begin at word i, if they are there."""
    kind = KINDS[value]
    is_placed = words[begin - 1] in PLACED | LOOKS or isinstance(words[begin - 1], Name)
    # "Near the center and between the cube and the sphere."
    follows_place = words[begin] == "between" and words[begin - 1] == "and" and begin > 1
    is_placed |= follows_place and words[begin - 2] in {*COLUMNS, *ROWS, *MIDDLE, *SIDE_NOUNS}
    if words[begin] in AMBIGUOUS and not is_placed:
        # "A contact between the red cube and the blue sphere" is not a relation.
        return None
    nouns: list[Noun | None] = []
    while len(nouns) < (0 if kind in ALONE else 2 if kind in JOINTS else 1):
        if nouns:
            joint = next((j for j in JOINTS[kind] if words[i:][: len(j.split())] == j.split()), "")
            if not joint:
                return None
            i += len(joint.split())
        if words[i] in PRONOUNS:
            nouns.append(None)
            i += 1
        elif found := _find_noun(words, i):
            nouns.append(found[1])
            i = found[2]
        else:
            return None
    return "relation", RelationPhrase(value, tuple(nouns)), i


def _find_region(words: list[str], i: int) -> Found | None:
    """Return the region at word i, such as "to the upper left corner", if there is one."""
    begin, name = i, "region"
    for opening in (["very", "close", "to"], ["close", "to"]):
        i += len(opening) * (words[i : i + len(opening)] == opening)
    while words[i] in PREPOSITIONS:
        name = REGION_TAGS.get(words[i], name)
        i += 1
    has_preposition = i > begin
    begin = i
    while words[i] in REGION_FILLERS:
        i += 1
    if "its" in words[begin:i] and words[i] in COLUMNS and words[i + 1] not in PLACE_NOUNS:
        # "On its right" is not a region.
        return None
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
    has_noun = noun in PLACE_NOUNS or noun in SIDE_NOUNS
    if words[i - 1] == "right" and noun in NOT_RIGHT_SIDE:
        # "In the right place" is not a region.
        return None
    if i == begin or not (has_noun or corner or (has_preposition and (definite or middle))):
        return None
    i += has_noun
    if words[i] == "of":
        end = i + 2 if words[i + 1] == "the" else i + 1
        if words[end] in IMAGE_NOUNS:
            i = end + 1
        elif not has_noun:
            # "To the left of the cube" is not a region.
            return None
    region = REGIONS[1 if row is None else row][1 if column is None else column]
    coarse = noun in SIDE_NOUNS and not corner
    return name, (COARSE if coarse else "") + region, i
