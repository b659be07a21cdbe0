"""Normalizes disguised text: HTML entities, markup, styled letters and look-alike letters.

The result is one or two readings. A reading is a normalized text that records the span of the
original text from which each character comes. It has ASCII digits in place of the numerals of every
script, most of which become "1", since only the presence of a number matters.
"""

from __future__ import annotations

import html
import re
import unicodedata
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache
from importlib.resources import files
from types import SimpleNamespace

import yaml

Spans = list[tuple[int, int]]

_LISTS = yaml.safe_load((files("teacher.numbers") / "lexicon.yaml").read_text(encoding="utf-8"))
_LOOKALIKES: dict[str, str] = _LISTS.pop("lookalikes")
LEXICON = SimpleNamespace(**{name: dict.fromkeys(text.split()) for name, text in _LISTS.items()})
"""The word lists of lexicon.yaml, each as the keys of a dict: a set in the order of the file."""

LOOKALIKES = {
    chr(base + i): chr(65 + i) for base in (0x1F130, 0x1F150, 0x1F170, 0x1F1E6) for i in range(26)
}
"""For each styled or foreign letter, the ASCII letter that it looks like."""
for _letters, _plain in _LOOKALIKES.items():
    LOOKALIKES |= zip(_letters, _plain, strict=True)
PICTOGRAPHS = {
    *(chr(c) for c in range(0x1F550, 0x1F568)),  # clock faces
    *(chr(c) for c in range(0x2680, 0x2686)),  # dice
    *(chr(c) for c in range(0x1F030, 0x1F0F6)),  # dominoes and playing cards
    *"🔟💯🔢🥇🥈🥉\u283c",
}
MAX_FOLD = 6
"""Characters that expand to more letters than this, such as the phrase U+FDFA, stay as they are."""
ENTITY = re.compile(r"&(?:#\d{1,7}|#[xX][0-9a-fA-F]{1,6}|[A-Za-z]\w{1,31});?")
NOT_ASCII = re.compile(r"[^\x00-\x7f]")
DISGUISE = re.compile(r"[&*`~_<$|@]|[A-Za-z]![A-Za-z]")
"""Parts of a text that normalization may change, besides characters outside ASCII."""
TAG = r"</?[A-Za-z][^<>]{0,60}>"
IDIOM = re.compile("|".join(LEXICON.idioms))
SEAM = re.compile(rf"[*`~\u200b]+|{TAG}")
"""Parts that readers do not see within a word: markup, and zero-width characters, all of which are
normalized to U+200B."""
SEAMS_TO_SPACES = str.maketrans("*`~\u200b_", "     ")
LEET = re.compile(r"(?<=[A-Za-z])[!|@](?=[A-Za-z])|\$(?=[A-Za-z])")
LEET_LETTERS = {"!": "i", "|": "i", "@": "a", "$": "s"}
"""The letters that these characters replace within a word, as in "s!x"."""


@dataclass(frozen=True)
class Reading:
    """A normalized text. Its character k comes from [starts[k], stops[k]) of the original text."""

    text: str
    starts: Sequence[int]
    stops: Sequence[int]

    def original(self, spans: Spans) -> Spans:
        """Convert spans of the reading to spans of the original text."""
        return [(self.starts[start], self.stops[stop - 1]) for start, stop in spans]


@lru_cache(maxsize=1 << 16)
def fold_character(c: str) -> str:
    """Return the normalized form of a character; empty for a combining mark."""
    plain = unicodedata.normalize("NFKC", c)
    if c in LEXICON.ideographs or c in PICTOGRAPHS or any(map(_is_numeral, (c, *plain))):
        digits = "".join(p for p in plain if p in "0123456789")
        return digits[:MAX_FOLD] or "1"
    letters = []
    for part in unicodedata.normalize("NFKD", plain):
        category = unicodedata.category(part)
        if category == "Cf":
            letters.append("\u200b")
        elif category not in ("Mn", "Me"):
            letters.append(LOOKALIKES.get(part, part))
    return c if len(letters) > MAX_FOLD else "".join(letters)


def _is_numeral(c: str) -> bool:
    return unicodedata.category(c)[0] == "N" or unicodedata.numeric(c, None) is not None


def normalize_word(word: str) -> str:
    """Return the normalized form of an entry of the lexicon."""
    return "".join(map(fold_character, word)).casefold()


def normalize(text: str) -> list[Reading]:
    """Return the readings of a text. If markup or zero-width characters may split words, there are
    two: one with spaces in their place (tags stay as they are), and one without them."""
    reading = Reading(text, range(len(text)), range(1, len(text) + 1))
    if text.isascii() and not DISGUISE.search(text):
        return [reading]
    # Twice, since an entity may itself be escaped, as in "&amp;#50;".
    for _ in range(2):
        reading = _substitute(reading, ENTITY, _unescape)
    # The numerals in idioms count nothing, so a character without a numeric value replaces them.
    folded = IDIOM.sub(lambda m: "人" * len(m[0]), reading.text)
    reading = Reading(folded, reading.starts, reading.stops)
    reading = _substitute(reading, NOT_ASCII, fold_character)
    readings = [Reading(reading.text.translate(SEAMS_TO_SPACES), reading.starts, reading.stops)]
    if SEAM.search(reading.text):
        joined = _substitute(reading, SEAM, lambda _: "")
        readings.append(Reading(joined.text.replace("_", " "), joined.starts, joined.stops))
    return [
        Reading(LEET.sub(lambda m: LEET_LETTERS[m[0]], r.text), r.starts, r.stops) for r in readings
    ]


def _substitute(reading: Reading, pattern: re.Pattern[str], new: Callable[[str], str]) -> Reading:
    """Replace the matches of a pattern. Each new character gets the span of the whole match."""
    pieces: list[str] = []
    starts: list[int] = []
    stops: list[int] = []
    end = 0
    for match in pattern.finditer(reading.text):
        first, last = match.span()
        if (text := new(match[0])) == match[0]:
            continue
        pieces += (reading.text[end:first], text)
        starts += [*reading.starts[end:first], *[reading.starts[first]] * len(text)]
        stops += [*reading.stops[end:first], *[reading.stops[last - 1]] * len(text)]
        end = last
    pieces.append(reading.text[end:])
    return Reading(
        "".join(pieces), [*starts, *reading.starts[end:]], [*stops, *reading.stops[end:]]
    )


@lru_cache(maxsize=4096)
def _unescape(entity: str) -> str:
    # An entity that stands for no character stays as it is.
    return html.unescape(entity) or entity
