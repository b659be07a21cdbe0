"""Finds every number in prose: digits, number words, and disguised spellings of both.

Counts, ordinals, fractions, multiples, quantities, measured times and lengths in terms of objects
are numbers. "First," at the start of a sentence, "both", "pair", "one another", "the other one",
"once struck", "no one" and "one side" are not. docs/teacher.md has the whole policy.

The text is normalized (see `normalization`) and split into words. Most words are never numbers. For
each other word, a rule reads the words around it and returns the span of a number, if there is one.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Collection
from functools import lru_cache
from itertools import accumulate

from teacher.numbers.lengths import LENGTH
from teacher.numbers.normalization import (
    LEXICON,
    Spans,
    fold_character,
    normalize,
    normalize_word,
)

Rule = Callable[["Prose", int], "tuple[int, int] | None"]
"""Takes a text and a word's index; returns the first and last word of a number there, or None."""

_any_of = "|".join
ENGLISH = {
    *("one", "first", *LEXICON.cardinals, *LEXICON.ordinals, *LEXICON.quantities, *LEXICON.times)
}
WORDS = {normalize_word(w) for w in (*ENGLISH, *LEXICON.misspelt, *LEXICON.foreign)} - {
    "one",
    "first",
}
PIECED = {w for w in ENGLISH if len(w) > 2}
"""Words that are also detected when spaced ("t w o"), split ("th ree") or stretched ("twooo")."""
PREFIXES = {word[:k] for word in PIECED for k in range(1, len(word) + 1)}
_scene = _any_of(sorted(LEXICON.scene, key=len, reverse=True))
_count = _any_of(sorted((*LEXICON.cardinals, *LEXICON.ordinals), key=len, reverse=True))
GLUED = re.compile(
    rf"(?:{_scene})*(?:one)?(?:{_count})(?:and|one|{_count})*"
    rf"(?:{_any_of(LEXICON.suffixes)}|(?:{_scene})+)?"
    rf"|(?:one|first|twice|half|double|single|triple)(?:{_scene})+"
    r"|(?:twent|thirt|fort|fift|sixt|sevent|eight|ninet)ies|one(?:fold|time|x)"
    rf"|(?:{_any_of(LEXICON.scales)})s?fold|half(?:ed|th|s)"
)
ARABIC_PREFIXES = "(?:[وفبلك]|ال|لل)+"
"""Articles and prepositions that Arabic joins to the next word."""
ARABIC = re.compile(
    normalize_word(ARABIC_PREFIXES) + rf"(?:{_any_of(w for w in WORDS if '؀' <= w[0] <= 'ۿ')})"
)
UNSPACED = re.compile(_any_of(map(normalize_word, LEXICON.unspaced)))
MAX_LETTERS = 60
"""Number of letters of a word that the rules read; the rest is ignored."""
MAX_COUNTERPART = 12
"""Number of words after "one" among which "the other" makes it a pronoun."""
ASCII_WORD = re.compile(r"([A-Za-z]+)")
# To `re`, Indic vowel signs are not letters, although they are parts of words.
WORD = re.compile(r"((?:[^\W\d_]+|[\u0900-\u0dff]+)+)")
FIGURES = re.compile(r"[0-9%‰‱]+(?:[.,:/][0-9]+)*(?:st|nd|rd|th)?")
CAMEL = re.compile(r"[A-Z]+(?![a-z])|[A-Z]?[a-z]+")
STRETCH = re.compile(r"(.)\1+")
UPPER_ROMAN = re.compile(r"M{0,3}(?:CM|CD|D?C{0,3})(?:XC|XL|L?X{0,3})(?:IX|IV|V?I{0,3})")
CLAUSE = re.compile(r"[.!?:;\n•–—*#>(\"“]|\s-\s")
"""Marks between two words that end a clause."""
COUNTABLE = LEXICON.nouns | LEXICON.events | LEXICON.units
"""Nouns before which "one" is a number even after "the" or an adjective."""
ADJECTIVE_ENDINGS = ("er", "est", "ing", "ed", "most")
CLAUSE_ENDS, SENTENCE_ENDS = frozenset(".,;:!?)…—–"), frozenset(".;!?)")


class Prose:
    """A text split into words and the gaps between them: word k is between gaps k and k + 1."""

    def __init__(self, text: str) -> None:
        pieces = (ASCII_WORD if text.isascii() else WORD).split(text)
        self.words, self.gaps = pieces[1::2], pieces[::2]
        self.lower = list(map(str.casefold, self.words))
        self.bounds = [0, *accumulate(map(len, pieces))]

    def word(self, index: int) -> str:
        """Return a word in lower case; "" for an index outside the text."""
        return self.lower[index] if 0 <= index < len(self.lower) else ""

    def before(self, index: int, by: int = 1) -> str:
        """Return the word `by` words before, in lower case; "" across punctuation but hyphens."""
        return self.lower[index - by] if self._is_joined(index - by, index) else ""

    def after(self, index: int, by: int = 1) -> str:
        """Return the word `by` words after, in lower case; "" across punctuation but hyphens."""
        return self.lower[index + by] if self._is_joined(index, index + by) else ""

    def _is_joined(self, first: int, last: int) -> bool:
        """Return whether only white space and hyphens separate the words from `first` to `last`."""
        if first < 0 or last >= len(self.words):
            return False
        return all(gap == "-" or gap.isspace() for gap in self.gaps[first + 1 : last + 1])

    def opens_clause(self, index: int) -> bool:
        return index == 0 or bool(CLAUSE.search(self.gaps[index][-8:]))

    def ends(self, index: int, marks: Collection[str]) -> bool:
        """Return whether one of `marks` follows a word, or the text ends after it."""
        gap = self.gaps[index + 1].lstrip()
        return gap[:1] in marks if gap else index + 1 == len(self.words)

    def span(self, first: int, last: int) -> tuple[int, int]:
        return self.bounds[2 * first + 1], self.bounds[2 * last + 2]


def find_numbers(text: str) -> list[tuple[int, int]]:
    """Return the spans (start, stop) that state a number, in order and disjoint; never raises."""
    spans: Spans = []
    for reading in normalize(text):
        spans += reading.original(_scan(reading.text))
    return _merged(spans, text) if spans else []


def _merged(spans: Spans, text: str) -> Spans:
    """Join spans that overlap or that only a space or a hyphen separates."""
    spans.sort()
    merged: Spans = []
    first, last = spans[0]
    for start, stop in spans:
        # Combining marks, whose normalized form is empty, belong to the character before them.
        while stop < len(text) and text[stop] > "\x7f" and not fold_character(text[stop]):
            stop += 1
        if start <= last or (start == last + 1 and text[last] in "- "):
            last = stop if stop > last else last
        else:
            merged.append((first, last))
            first, last = start, stop
    return [*merged, (first, last)]


def _scan(text: str) -> Spans:
    spans = [m.span() for pattern in (FIGURES, LENGTH) for m in pattern.finditer(text)]
    if not text.isascii():
        spans += [m.span() for m in UNSPACED.finditer(text)]
    prose = Prose(text)
    words = prose.words
    if max(map(len, words), default=0) > MAX_LETTERS:
        words = [word[:MAX_LETTERS] for word in words]
    for index, rule in enumerate(map(rule_of, words)):
        if rule is not None and (number := rule(prose, index)) is not None:
            spans.append(prose.span(*number))
    return spans


@lru_cache(maxsize=1 << 16)
def rule_of(token: str) -> Rule | None:
    """Return the rule for a word in its original case; None if the word is never a number."""
    word = token.casefold()
    if word in RULES:
        return RULES[word]
    if token.istitle() and word in LEXICON.names:
        return None
    if _is_number(word) or _is_roman(token, word) or _is_camel(token):
        return _always
    return _assembled if word in PREFIXES else None


def _is_number(word: str) -> bool:
    if word in WORDS or GLUED.fullmatch(word) or ARABIC.fullmatch(word):
        return True
    # "twooo" and "threeeee"; "onne", but not "on".
    stretched = STRETCH.search(word) and STRETCHED.get(STRETCH.sub(r"\1", word))
    return bool(stretched) and word not in (stretched, "too", "teen")


STRETCHED = {STRETCH.sub(r"\1", word): word for word in PIECED}


def _is_roman(token: str, word: str) -> bool:
    if word in LEXICON.roman:
        return True
    return (
        len(token) > 1
        and token.isupper()
        and bool(set(token) & set("IVX"))
        and set(token) <= set("IVXLCDM")
        and word not in LEXICON.not_roman
        and bool(UPPER_ROMAN.fullmatch(token))
    )


def _is_camel(token: str) -> bool:
    if token.islower() or token.isupper() or token.istitle():
        return False
    return any(part.casefold() in PIECED for part in CAMEL.findall(token))


def _always(prose: Prose, index: int) -> tuple[int, int] | None:
    return index, index


def _assembled(prose: Prose, index: int) -> tuple[int, int] | None:
    """A number word that is split ("tw-o", "th ree") or whose letters are spaced ("t w o")."""
    words, gaps = prose.lower, prose.gaps
    joined, last = words[index], index
    while joined in PREFIXES and last + 1 < len(words):
        last += 1
        if len(gaps[last]) > 3:
            return None
        joined += words[last]
        if joined in PIECED and _is_split(prose, index, last):
            return index, last
    return None


def _is_split(prose: Prose, first: int, last: int) -> bool:
    pieces = [prose.word(k) for k in range(first, last + 1)]
    gaps = prose.gaps[first + 1 : last + 1]
    if len(pieces) > 2 and all(len(piece) == 1 for piece in pieces):
        return True
    if all(gap.strip() and (len(gap) == 1 or gap == "-\n") for gap in gaps):
        return not set(gaps) & set(',;:()"“”')
    if not all(len(gap) <= 2 and gap.isspace() for gap in gaps):
        return False
    # The letters after an apostrophe are the ending of a word.
    possessive = prose.gaps[first][-1:] in ("'", "’")
    return not possessive and not all(piece in LEXICON.pieces for piece in pieces)


def _one(prose: Prose, index: int) -> tuple[int, int] | None:
    return None if _is_pronoun(prose, index) else (index, index)


def _is_pronoun(prose: Prose, index: int) -> bool:
    """Return whether "one" is a pronoun, as in "the other one"."""
    if prose.gaps[index + 1] in ("'", "’") and prose.word(index + 1) == "s":
        return True
    previous, following = prose.before(index), prose.after(index)
    if following in ("another", "side", "sided") or previous == "no":
        return True
    if previous == "only" and prose.before(index, 2) == "the" and following not in COUNTABLE:
        # "The only one that moves."
        return True
    counts = following == "of" or following in COUNTABLE
    if prose.opens_clause(index) and not counts and _has_counterpart(prose, index):
        return True
    if following in COUNTABLE or rule_of(previous[:MAX_LETTERS]) is _always:
        return False
    is_adjectival = len(previous) > 4 and previous.endswith(ADJECTIVE_ENDINGS)
    if following in LEXICON.modals or previous in LEXICON.adjectives:
        return True
    if is_adjectival and previous not in LEXICON.not_adjectives:
        return True
    if not previous or previous in LEXICON.not_adjectives or previous in COUNTABLE:
        return False
    # With a determiner before the previous word, "one" is a pronoun, as in "the opaque one".
    return prose.before(index, 2) in ("the", "a", "an", "each", "every", "its", "their")


def _has_counterpart(prose: Prose, index: int) -> bool:
    """Return whether "the other" follows in the sentence: "One moves quickly, the other rests"."""
    for k in range(index + 1, min(index + MAX_COUNTERPART, len(prose.words))):
        if SENTENCE_ENDS & set(prose.gaps[k]):
            return False
        if prose.word(k) == "other" and prose.word(k - 1) == "the":
            return True
    return False


def _first(prose: Prose, index: int) -> tuple[int, int] | None:
    """A number, except in "First, ..." at the start of a clause, "at first", "first of all", "in
    the first place" and "the first thing to notice"."""
    if prose.before(index) == "at":
        return None
    if prose.before(index) == "the":
        if prose.after(index) == "thing" and prose.after(index, 2) == "to":
            return None
        if prose.after(index) == "place" and prose.before(index, 2) == "in":
            return None
    aside = prose.gaps[index + 1].lstrip()[:1] in (",", ":", "—", "–")
    aside = aside or (prose.after(index) == "of" and prose.after(index, 2) == "all")
    opening = index - (prose.before(index) in ("but", "and", "so"))
    return None if aside and prose.opens_clause(opening) else (index, index)


def _once(prose: Prose, index: int) -> tuple[int, int] | None:
    """A number if it counts events, and not if it is a conjunction, as in "once struck"."""
    previous, following = prose.before(index), prose.after(index)
    if previous == "at" or following in ("more", "again"):
        return None
    if previous in LEXICON.exactly or following in ("or", "per", "every", "each"):
        return index, index
    if not previous or prose.opens_clause(index):
        counts = prose.ends(index, CLAUSE_ENDS)
    elif following:
        opens = following in LEXICON.clause_openers or following.endswith(("ed", "ing"))
        counts = not opens and not _starts_number(prose, index + 1)
    else:
        counts = not FIGURES.search(prose.gaps[index + 1])
    return (index, index) if counts else None


def _starts_number(prose: Prose, index: int) -> bool:
    rule = rule_of(prose.words[index][:MAX_LETTERS])
    return rule is _once or (rule is not None and rule(prose, index) is not None)


def _unit(prose: Prose, index: int) -> tuple[int, int] | None:
    """Finds measures with a unit: "a few frames", "a frame later", "within a frame", "a pixel"."""
    back = 1
    while back <= 3 and prose.before(index, back) in LEXICON.fillers:
        back += 1
    plural = prose.word(index) in LEXICON.plural_units or prose.gaps[index] == "-"
    if plural and prose.before(index, back) in LEXICON.vague:
        return index - back, index
    if prose.word(index) not in LEXICON.units or prose.before(index) not in ("a", "an"):
        return None
    if prose.word(index) in LEXICON.lengths:
        return index - 1, index
    if prose.word(index) in ("moment", "instant"):
        return None
    if prose.after(index) in ("later", "earlier", "ago", "before", "after"):
        return index - 1, index + 1
    within = prose.before(index, 2) in ("within", "after", "in")
    return (index - 2, index) if within else None


def _minute(prose: Prose, index: int) -> tuple[int, int] | None:
    """A number if it is a unit of time, and not if it means "tiny"."""
    previous, following = prose.before(index), prose.after(index)
    if previous in LEXICON.before_minute:
        return index - 1, index
    if previous not in ("a", "the", "this"):
        return None
    if following in LEXICON.after_minute:
        return index - 1, index + 1
    timed = not following and prose.before(index, 2) in LEXICON.time_prepositions
    return (index - 1, index) if timed or prose.ends(index, SENTENCE_ENDS) else None


def _score(prose: Prose, index: int) -> tuple[int, int] | None:
    a_score_of = prose.before(index) == "a" and prose.after(index) == "of"
    return (index - 1, index + 1) if a_score_of else None


def _secondary(prose: Prose, index: int) -> tuple[int, int] | None:
    """A number before a noun for an event, as in "the secondary collision"."""
    return (index, index + 1) if prose.after(index) in LEXICON.events else None


def _letter(prose: Prose, index: int) -> tuple[int, int] | None:
    """A number if a single I, V or X is a numeral: "phase I", "(i)", "No. V", "I." before text."""
    before, after = prose.gaps[index], prose.gaps[index + 1]
    if after[:1] in ("'", "’") or prose.word(index + 1) == "e":
        return None
    entry = after == ". " and (before[-1:] == "\n" or index == 0)
    if entry or after[:1] == ")" or len(prose.words) == 1:
        return index, index
    if prose.words[index] == "i" and not prose.ends(index, CLAUSE_ENDS):
        return None
    enumerated = before.strip(" .-\n") == "" and prose.word(index - 1) in LEXICON.enumerated
    return (index - 1, index) if enumerated else None


def _italian(prose: Prose, index: int) -> tuple[int, int] | None:
    """A number if "due" or "metà" is before or after an Italian word."""
    if prose.after(index) in LEXICON.italian:
        return index, index + 1
    return (index - 1, index) if prose.before(index) in LEXICON.italian else None


def _except_before(*words: str) -> Rule:
    """Return the rule for a word that is a number unless one of `words` follows."""
    return lambda prose, index: None if prose.after(index) in words else (index, index)


RULES: dict[str, Rule] = {
    **dict.fromkeys((*LEXICON.units, *LEXICON.plural_units), _unit),
    "one": _one,
    "first": _first,
    "once": _once,
    "minute": _minute,
    "score": _score,
    "secondary": _secondary,
    "double": _except_before("check", "checks", "checked", "checking"),
    **dict.fromkeys(map(normalize_word, LEXICON.foreign_firsts), _first),
    **dict.fromkeys(("due", "meta"), _italian),
    # Italian: "second", or, before an article, "according to".
    "secondo": _except_before("la", "il", "le", "i", "lo", "gli"),
    # Hindi: "one", or, before this word, a part of "each other".
    normalize_word("एक"): _except_before(normalize_word("दूसरे")),
    **dict.fromkeys("ivx", _letter),
}
