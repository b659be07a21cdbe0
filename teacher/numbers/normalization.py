"""Normalizes disguised text: HTML entities, markup, styled letters and look-alike letters.

A normalized text is a `Reading`. It has ASCII digits in place of the numerals of every script, most
of which become "1", since only the presence of a number matters.
"""

from __future__ import annotations

import html
import re
import unicodedata
from collections.abc import Callable
from functools import lru_cache
from importlib.resources import files
from typing import Any, NamedTuple

import yaml

Spans = list[tuple[int, int]]

LEXICON: dict[str, Any] = yaml.safe_load(
    (files("dynapix.teacher.numbers") / "lexicon.yaml").read_bytes()
)
LOOKALIKES: dict[str, str] = LEXICON["lookalikes"]
ASCII_LETTERS = str.maketrans("".join(LOOKALIKES), "".join(LOOKALIKES.values()))
STYLED = re.compile(r"(?:.* )?(?:LATIN|CIRCLED|SQUARED|INDICATOR) .*\b([A-Z])(?: WITH .*)?")
"""The Unicode name of a letter in some style, such as "LATIN LETTER SMALL CAPITAL T"."""
PICTOGRAPH = re.compile(
    "CLOCK FACE|DIE FACE|DOMINO TILE|PLAYING CARD|PLACE MEDAL|KEYCAP|HUNDRED POINTS"
    "|INPUT SYMBOL FOR NUMBERS|BRAILLE PATTERN DOTS-3456$"
)
"""The Unicode name of a symbol that states a number."""
ENTITY = re.compile(r"&(?:#\d{1,7}|#[xX][0-9a-fA-F]{1,6}|[A-Za-z]\w{1,31});?")
NOT_ASCII = re.compile(r"[^\x00-\x7f]")
DISGUISE = re.compile(r"[&*`~_<]|[^\x00-\x7f]")
"""Parts of a text that normalization may change."""
SEAM = re.compile(r"[*`~\u200b]+|</?[A-Za-z][^<>]{0,60}>")
"""Parts that readers do not see within a word: markup, and zero-width characters, all of which are
normalized to U+200B."""
SEAMS_TO_SPACES = str.maketrans("*`~\u200b_", "     ")


class Reading(NamedTuple):
    """A normalized text, and the span of the original from which each character comes, if any."""

    text: str
    sources: Spans

    def original(self, spans: Spans) -> Spans:
        """Convert spans of the reading to spans of the original text."""
        sources = self.sources
        return [(sources[i][0], sources[j - 1][1]) for i, j in spans] if sources else spans


@lru_cache(maxsize=1 << 16)
def fold_character(c: str) -> str:
    """Return the normalized form of a character; empty for a combining mark."""
    plain = unicodedata.normalize("NFKC", c)
    if PICTOGRAPH.search(unicodedata.name(c, "")) or any(map(_is_numeral, (c, *plain))):
        return "".join(re.findall("[0-9]", plain)) or "1"
    letters = []
    for part in unicodedata.normalize("NFKD", plain):
        category = unicodedata.category(part)
        if category == "Cf":
            letters.append("\u200b")
        elif category not in ("Mn", "Me"):
            styled = STYLED.fullmatch(unicodedata.name(part, ""))
            letters.append(styled[1].lower() if styled else part.translate(ASCII_LETTERS))
    return "".join(letters)


def _is_numeral(c: str) -> bool:
    # Chinese and Japanese numerals are parts of many words; the lexicon has phrases for them.
    if "\u3400" <= c <= "\u9fff":
        return False
    return unicodedata.category(c)[0] == "N" or unicodedata.numeric(c, None) is not None


def normalize(text: str) -> list[Reading]:
    """Return the readings of a text. If markup or zero-width characters may split words, there are
    two: one with spaces in their place (tags stay as they are), and one without them."""
    if not DISGUISE.search(text):
        return [Reading(text, [])]
    reading = Reading(text, list(enumerate(range(1, len(text) + 1))))
    # Twice, since an entity may itself be escaped, as in "&amp;#50;". Some stand for nothing.
    for _ in range(2):
        reading = _substitute(reading, ENTITY, lambda entity: html.unescape(entity) or entity)
    reading = _substitute(reading, NOT_ASCII, fold_character)
    readings = [reading._replace(text=reading.text.translate(SEAMS_TO_SPACES))]
    if SEAM.search(reading.text):
        joined = _substitute(reading, SEAM, lambda _: "")
        readings.append(joined._replace(text=joined.text.replace("_", " ")))
    return readings


def _substitute(reading: Reading, pattern: re.Pattern[str], new: Callable[[str], str]) -> Reading:
    """Replace the matches of a pattern. Each new character gets the span of the whole match."""
    text, sources = reading
    pieces: list[str] = []
    spans: Spans = []
    end = 0
    for match in pattern.finditer(text):
        first, last = match.span()
        pieces += (text[end:first], new(match[0]))
        spans += sources[end:first]
        spans += [(sources[first][0], sources[last - 1][1])] * len(pieces[-1])
        end = last
    return Reading("".join((*pieces, text[end:])), spans + sources[end:])
