"""Normalizes disguised text: HTML entities, markup, styled letters and look-alike letters.

A reading is a normalized text with, for each character, the span of the original that it comes
from. In a reading, numerals of every script are ASCII digits.
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
LEXICON = SimpleNamespace(
    lookalikes=_LISTS.pop("lookalikes"),
    **{name: dict.fromkeys(text.split()) for name, text in _LISTS.items()},
)
"""The word lists of lexicon.yaml, each as the keys of a dict: a set in the order of the file."""

LOOKALIKES = {
    chr(base + i): chr(65 + i) for base in (0x1F130, 0x1F150, 0x1F170, 0x1F1E6) for i in range(26)
}
"""The letter that a styled or foreign letter looks like."""
for _letters, _plain in LEXICON.lookalikes.items():
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
TAG = r"</?[A-Za-z][^<>]{0,60}>"
IDIOM = re.compile("|".join(LEXICON.idioms))
SEAM = re.compile(rf"[*`~\u200b]+|{TAG}")
"""Invisible parts of a word: markup and zero-width characters (all normalized to U+200B)."""
SEAMS_TO_SPACES = str.maketrans("*`~\u200b_", "     ")
LEET = re.compile(r"(?<=[A-Za-z])[!|@](?=[A-Za-z])|\$(?=[A-Za-z])")
LEET_LETTERS = {"!": "i", "|": "i", "@": "a", "$": "s"}


@dataclass(frozen=True)
class Reading:
    """Normalized text; character k comes from the original's [starts[k], stops[k])."""

    text: str
    starts: Sequence[int]
    stops: Sequence[int]

    def original(self, spans: Spans) -> Spans:
        """The spans of the original that correspond to spans of the reading."""
        return [(self.starts[start], self.stops[stop - 1]) for start, stop in spans]


@lru_cache(maxsize=1 << 16)
def fold_character(c: str) -> str:
    """The normalized form of a character."""
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
    """A lexicon entry in its normalized form."""
    return "".join(map(fold_character, word)).casefold()


def normalize(text: str) -> list[Reading]:
    """The readings of a text. Markup or an invisible character between letters gives two: with a
    space in its place, and without."""
    reading = Reading(text, range(len(text)), range(1, len(text) + 1))
    if text.isascii() and not DISGUISE.search(text):
        return [reading]
    # Twice, since an entity may itself be escaped.
    for _ in range(2):
        reading = _substitute(reading, ENTITY, _meaning)
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
    """Replace the matches of a pattern; a new character comes from the whole span of its match."""
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
def _meaning(entity: str) -> str:
    # An entity of no character stays as it is.
    return html.unescape(entity) or entity
