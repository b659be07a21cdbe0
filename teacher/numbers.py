"""Finds every number that prose states, in digits, in words or in disguise.

The policy: counts, ordinals that count, fractions, multiples, quantities and measured time are
numbers. "First," opening a sentence, "both", "pair", "one another", "the other one", "once
struck", "no one" and "one side" are not.
"""

from __future__ import annotations

import re

from teacher import lexicon
from teacher.folding import Spans, fold, fold_word

_any = "|".join
WORDS = {
    fold_word(word)
    for group in (
        lexicon.CARDINALS,
        lexicon.ORDINALS,
        lexicon.QUANTITIES,
        lexicon.TIMES,
        lexicon.FOREIGN,
    )
    for word in group
}
PLAIN = {w for w in WORDS if w.isascii() and len(w) > 2} | {"one"}
"""Words that are looked for in spaced, split and stretched spellings."""
GLUED = re.compile(
    rf"(?:one)?(?:{_any(sorted(lexicon.CARDINALS, key=len, reverse=True))})"
    rf"(?:and|one|{_any(sorted((*lexicon.CARDINALS, *lexicon.ORDINALS), key=len, reverse=True))})*"
    rf"(?:{_any(lexicon.SUFFIXES)})?"
    r"|(?:twent|thirt|fort|fift|sixt|sevent|eight|ninet)ies|one(?:fold|time|x)"
    rf"|(?:{_any(lexicon.SCALES)})s?fold|half(?:ed|th|s)"
)
LONGEST = 60
# Indic vowel signs are no letters to `re`, but belong to their words.
TOKEN = re.compile(r"(?:[^\W\d_]|[\u0900-\u0dff])+")
CAMEL = re.compile(r"[A-Z]?[a-z]+|[A-Z]+")
SPACED = re.compile(r"(?<![^\W\d_])[^\W\d_](?:[\W_]{1,2}[^\W\d_]){2,}(?![^\W\d_])")
CHAIN = re.compile(r"(?<![^\W\d_])[^\W\d_]+(?:-[^\W\d_]+)+")
STRETCH = re.compile(r"(.)\1+")
UPPER_ROMAN = re.compile(r"M{0,3}(?:CM|CD|D?C{0,3})(?:XC|XL|L?X{0,3})(?:IX|IV|V?I{0,3})")
SPACED_WORDS = re.compile(_any(sorted(PLAIN, key=len, reverse=True)))
SYMBOLS = re.compile("[%‰‱]")

PHRASES = [
    re.compile(pattern, re.IGNORECASE)
    for pattern in (
        rf"\b(?:{_any(lexicon.VAGUE)})(?:\s+(?:of|more|the|further|additional|short|brief|video))"
        rf"{{0,3}}\s+(?:{_any(lexicon.COUNTED)})\b",
        r"\ban?\s+(?:frame|moment|step|instant|beat)\s+(?:later|earlier|ago|before|after)\b",
        r"\b(?:within|after|in)\s+an?\s+(?:frame|step|beat)\b|\ba\s+pixel\b|\ba\s+score\s+of\b",
        r"\b(?:a|per|each|every|the|within|this|next|last)\s+minute\s*"
        r"(?=[.,;:!?)]|$|(?:later|ago|or|of|after|before|passes|passed|has|long|in|and)\b)",
        r"\bper\s+(?:mille|cent|second|minute)\b",
        r"\((?:i|v|x)\)",
        rf"\b(?:{_any(lexicon.ENUMERATED)})\s+(?-i:[IVX])\b(?!')",
        r"\bonce\b(?=\s*(?:[.,;:!?)]|$|(?:or|and|per|every|each|in|a|only|during|before"
        r"|with|off|against|near|into|on|by)\b))",
        r"\b(?:only|just|exactly|than|least|most)\s+once\b",
    )
]
CLAUSES = re.compile(r"(?:\A|[.!?:;\n•\-–—*#>(\"“])\s*\Z")


def find_numbers(text: str) -> list[tuple[int, int]]:
    """Spans of `text` that state a number, in order and without overlap; never raises."""
    readings, spans = fold(text)
    for reading, where in readings:
        spans += [
            (where[start][0], where[stop - 1][1]) for start, stop in _scan(reading) if start < stop
        ]
    return _merged(spans, text)


def _merged(spans: Spans, text: str) -> Spans:
    merged: Spans = []
    for start, stop in sorted(spans):
        if merged and (start <= merged[-1][1] or text[merged[-1][1] : start] in ("-", " ")):
            merged[-1] = (merged[-1][0], max(stop, merged[-1][1]))
        else:
            merged.append((start, stop))
    return merged


def _scan(text: str) -> Spans:
    spans = [m.span() for m in SYMBOLS.finditer(text)]
    tokens = [(m[0], m.start(), m.end()) for m in TOKEN.finditer(text)]
    lower = [token.casefold() for token, _, _ in tokens]
    for index, (token, start, stop) in enumerate(tokens):
        word = lower[index]
        if word == "one":
            stated = not _is_pronoun(text, tokens, lower, index)
        elif word == "first":
            stated = not _is_adverb(text, tokens, lower, index)
        else:
            stated = _is_number(word) or _is_roman(token, word) or _is_camel(token)
        if stated:
            spans.append((start, stop))
        elif index + 1 < len(tokens) and text[stop : tokens[index + 1][1]] in (" ", "\n", "\t"):
            following = tokens[index + 1][0]
            # A lone letter that is no word of its own belongs to its neighbour: "tw o".
            lone = 1 in (len(token), len(following)) and text[start - 1 : start] not in ("'", "’")
            if lone and not {token, following} & set("aAiIBCD"):
                joined = word + lower[index + 1]
                if joined in PLAIN and joined != "one":
                    spans.append((start, tokens[index + 1][2]))
    for match in SPACED.finditer(text):
        joined = "".join(c for c in match[0] if c.isalpha()).casefold()
        if SPACED_WORDS.search(joined):
            spans.append(match.span())
    for match in CHAIN.finditer(text):
        joined = match[0].replace("-", "").casefold()
        if joined in PLAIN:
            spans.append(match.span())
    for pattern in PHRASES:
        spans += [m.span() for m in pattern.finditer(text)]
    return [s for s in spans if not _is_idiom(text, s)]


def _is_number(word: str) -> bool:
    # Longer words are cut, for backtracking over them would not be linear.
    if word in WORDS or GLUED.fullmatch(word[:LONGEST]):
        return True
    if not STRETCH.search(word):
        return False
    # "twooo" and "threeeee", but not "too" or "bee": only a letter thrice in a row is a stretch.
    if not re.search(r"(.)\1\1", word):
        return False
    return any(STRETCH.sub(kept, word) in PLAIN for kept in (r"\1", r"\1\1"))


def _is_roman(token: str, word: str) -> bool:
    if word in lexicon.ROMAN:
        return True
    return (
        len(token) > 1
        and token.isupper()
        and bool(set(token) & set("IVX"))
        and set(token) <= set("IVXLCDM")
        and bool(UPPER_ROMAN.fullmatch(token))
    )


def _is_camel(token: str) -> bool:
    if token.islower() or token.isupper() or token.istitle():
        return False
    return any(part.casefold() in PLAIN for part in CAMEL.findall(token))


def _is_idiom(text: str, span: tuple[int, int]) -> bool:
    before = text[max(0, span[0] - 4) : span[0]].casefold()
    return text[slice(*span)].casefold().startswith("once") and before.endswith("at ")


def _is_adverb(text: str, tokens: list[tuple[str, int, int]], lower: list[str], index: int) -> bool:
    """Whether "first" opens a sentence before a comma, or stands in "at first"."""
    _, start, stop = tokens[index]
    if index and lower[index - 1] == "at" and text[tokens[index - 1][2] : start] == " ":
        return True
    return text[stop : stop + 1] == "," and bool(CLAUSES.search(text[max(0, start - 8) : start]))


def _is_pronoun(
    text: str, tokens: list[tuple[str, int, int]], lower: list[str], index: int
) -> bool:
    """Whether "one" stands for a thing, and so counts nothing."""
    _, start, stop = tokens[index]
    previous = lower[index - 1] if index else ""
    beside = index > 0 and text[tokens[index - 1][2] : start].isspace()
    following = lower[index + 1] if index + 1 < len(tokens) else ""
    gap = text[stop : tokens[index + 1][1]] if following else ""
    if following in ("another", "side", "sided", "s") and gap in (" ", "-", "'", "’", "\n"):
        return True
    if beside and previous == "no":
        return True
    adjacent = gap.isspace() or gap == "-"
    if following in lexicon.NOUNS and adjacent:
        return False
    if following in lexicon.MODALS and adjacent:
        return True
    if not beside:
        return False
    return previous in lexicon.ADJECTIVES or (
        len(previous) > 4
        and previous.endswith(("er", "est", "ing", "ed", "most"))
        and previous not in ("almost", "after", "under", "over", "either", "during", "being")
    )
