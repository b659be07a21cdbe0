"""Finds every number in prose: digits, number words, and disguised spellings of both.

Counts, ordinals, fractions, multiples, quantities, measured times and lengths in terms of objects
are numbers. Pronouns, adverbs and idioms are not: "the other one", "it first rests", "once struck",
"one another", "second nature". docs/teacher.md has the policy.

The text is normalized (see `normalization`) and split into words. Most words are never numbers,
some always are, and a rule of lexicon.yaml reads the phrases around each of the others.
"""

from __future__ import annotations

import re
from collections.abc import Callable
from functools import lru_cache
from itertools import accumulate

from dynapix.teacher.numbers.normalization import LEXICON, Spans, fold_character, normalize

NAME = re.compile(r"\{([a-z_]+)\}")
GAP = r"(?:\s{1,9}|-)"


def expand(template: str) -> str:
    """Return the regular expression of a phrase of the lexicon."""
    return NAME.sub(lambda m: f"(?:{'|'.join(map(expand, LEXICON[m[1]].split()))})", template)


PIECED = {"one", *f"{LEXICON['cardinals']} {LEXICON['ordinals']} {LEXICON['multiples']}".split()}
PIECED = {word for word in PIECED if word.isalpha() and len(word) > 2}
"""Words that are also detected when spaced ("t w o"), split ("th ree") or stretched ("twooo")."""
PREFIXES = {word[:k] for word in PIECED for k in range(1, len(word) + 1)}
_foreign = "".join(map(fold_character, LEXICON["foreign"])).casefold().replace("*", r"\w*")
_stretched = "|".join("+".join(word) + "+" for word in sorted(PIECED))
ALWAYS = re.compile(
    expand(
        "{scene}*(?:one)?{count}(?:and|one|{count})*(?:{suffixes}|{scene}+)?|{multiples}|{times}"
        "|(?:one|first|twice|half|double|single|triple){scene}+|(?:half|one)(?:fold|time|x|th)"
        "|onedimensional|(?:{count}s?|many|several|multi|[nkm])fold|{collectives}"
    )
    + rf"|{'|'.join(_foreign.split())}|(?!teen$)(?:{_stretched})"
)
"""Words that state a number wherever they are."""
FIGURES = re.compile(r"[0-9%‰‱]+(?:[.,:/][0-9]+)*(?:st|nd|rd|th)?")
UNSPACED = re.compile(expand("{unspaced}"))
ROMAN = re.compile(
    r"(?=[IVX]{2}|[IVXLCDM]{4}|[IVX](?:st|nd|rd|th))"
    r"M{0,3}(?:CM|CD|D?C{0,3})(?:XC|XL|L?X{0,3})(?:IX|IV|V?I{0,3})(?:st|nd|rd|th)?"
)
ASCII_WORD, WORD = re.compile(r"([A-Za-z]+)"), re.compile(r"([^\W\d_]+)")
# A word that is spaced or split by a mark, and one that is split by spaces, after no apostrophe.
SPLIT = re.compile(r"""\w(?:\W{1,3}\w)+|\w+(?:(?:[^\w\s,;:()"“”]|-\n)\w+)+""")
SPACED = re.compile(r"(?<!['’])\w+(?:\s{1,2}\w+)+")


class Prose:
    """A text split into words and the gaps between them: word k is between gaps k and k + 1."""

    def __init__(self, text: str) -> None:
        pieces = (ASCII_WORD if text.isascii() else WORD).split(text)
        self.text, self.words, self.gaps = text, pieces[1::2], pieces[::2]
        self.bounds = [0, *accumulate(map(len, pieces))]
        self.matches: dict[tuple[int, int], re.Match[str] | None] = {}

    def span(self, first: int, last: int) -> tuple[int, int]:
        return self.bounds[2 * first + 1], self.bounds[2 * last + 2]


class Rule:
    """Decides by the phrases around a word whether it states a number."""

    def __init__(self, words: str, lists: list[dict[str, str]]) -> None:
        self.words = re.compile(expand(words))
        self.lists = []
        for verdict, phrases in (entry for item in lists for entry in item.items()):
            pattern = expand("|".join(phrases.split("; "))).replace(" ", GAP)
            verdict, _, within = verdict.partition(" within ")
            compiled = re.compile(rf"(?:{pattern})(?!\w)", re.IGNORECASE)
            self.lists.append((verdict == "number", compiled, int(within or 4)))

    def __call__(self, prose: Prose, index: int) -> tuple[int, int] | None:
        start, stop = prose.span(index, index)
        is_number = False
        for is_number, phrases, within in self.lists:
            for first in range(max(0, index - within), index + 1):
                key = id(phrases), first
                if key not in prose.matches:
                    prose.matches[key] = phrases.match(prose.text, prose.bounds[2 * first + 1])
                if (match := prose.matches[key]) is not None and match.end() >= stop:
                    return match.span() if is_number else None
        return None if is_number else (start, stop)


RULES = [Rule(words, lists) for words, lists in LEXICON["rules"].items()]


def find_numbers(text: str) -> list[tuple[int, int]]:
    """Return the spans (start, stop) that state a number, in order and disjoint; never raises.

    Numbers that overlap, or that only a space or a hyphen separates, are one.
    """
    merged: Spans = []
    for start, stop in sorted(s for r in normalize(text) for s in r.original(_scan(r.text))):
        # Combining marks, whose normalized form is empty, belong to the character before them.
        while stop < len(text) and text[stop] > "\x7f" and not fold_character(text[stop]):
            stop += 1
        if merged and start - (last := merged[-1][1]) <= (text[last : last + 1] in ("-", " ")):
            start, stop = merged.pop()[0], max(last, stop)
        merged.append((start, stop))
    return merged


def _scan(text: str) -> Spans:
    spans = [m.span() for m in FIGURES.finditer(text)]
    if not text.isascii():
        spans += [m.span() for m in UNSPACED.finditer(text)]
    prose = Prose(text)
    for index, finders in enumerate(map(finders_of, prose.words)):
        spans += [span for find in finders if (span := find(prose, index)) is not None]
    return spans


@lru_cache(maxsize=1 << 16)
def finders_of(token: str) -> tuple[Callable[[Prose, int], tuple[int, int] | None], ...]:
    """Return what may find a number that has a word, which is in its original case."""
    token = token[:60]  # The rest of a longer word is ignored.
    word = token.casefold()
    if rules := [rule for rule in RULES if rule.words.fullmatch(word)]:
        return tuple(rules)
    numeral = token.upper() if set(token) <= set("ivx") else token
    if ALWAYS.fullmatch(word) or ROMAN.fullmatch(numeral):
        return (lambda prose, index: prose.span(index, index),)
    return (_find_pieces,) if word in PREFIXES else ()


def _find_pieces(prose: Prose, index: int) -> tuple[int, int] | None:
    """Find a number word that is split ("tw-o", "th ree") or whose letters are spaced ("t w o")."""
    joined, last = prose.words[index].casefold(), index
    while joined in PREFIXES and last + 1 < len(prose.words) and len(prose.gaps[last + 1]) <= 3:
        last += 1
        joined += prose.words[last].casefold()
        span = prose.span(index, last)
        pieces = {word.casefold() for word in prose.words[index : last + 1]}
        if joined in PIECED and (
            SPLIT.fullmatch(prose.text, *span)
            or (SPACED.fullmatch(prose.text, *span) and not pieces <= {*LEXICON["pieces"].split()})
        ):
            return span
    return None
