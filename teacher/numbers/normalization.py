"""Normalizes disguised text: HTML entities, markup, styled letters and look-alike letters.

A reading is a normalized text with, for each character, the span of the original that it comes
from. In a reading, numerals of every script are ASCII digits.
"""

from __future__ import annotations

import html
import re
import unicodedata
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from itertools import chain, compress, repeat

from teacher.numbers.lexicon import LEXICON

Spans = list[tuple[int, int]]

LOOKALIKES = {
    **dict(zip("аеорсухіјѕԁԛԝвмтнкһѵʋɑɡıгпөш", "aeopcyxijsdqwbmthkhvvagirnow", strict=True)),
    **dict(zip("АВЕКМНОРСТУХІЈЅԚԜѴ", "ABEKMHOPCTYXIJSQWV", strict=True)),
    **dict(zip("οντωειυακχρη", "ovtweiuakxpn", strict=True)),
    **dict(zip("ΑΒΕΖΗΙΚΜΝΟΡΤΥΧ", "ABEZHIKMNOPTYX", strict=True)),
    **dict(zip("օոհսցⲟ", "onhugo", strict=True)),
    **dict(zip("ᴀʙᴄᴅᴇꜰɢʜɪᴊᴋʟᴍɴᴏᴘʀꜱᴛᴜᴠᴡʏᴢ", "abcdefghijklmnoprstuvwyz", strict=True)),
    **dict(zip("łøđħŧƒɛəʰ", "lodhtfeeh", strict=True)),
    **{
        chr(base + i): chr(65 + i)
        for base in (0x1F130, 0x1F150, 0x1F170, 0x1F1E6)
        for i in range(26)
    },
}
PICTOGRAPHS = {
    *(chr(c) for c in range(0x1F550, 0x1F568)),  # clock faces
    *(chr(c) for c in range(0x2680, 0x2686)),  # dice
    *(chr(c) for c in range(0x1F030, 0x1F0F6)),  # dominoes and playing cards
    *"🔟💯🔢🥇🥈🥉\u283c",
}
MAX_FOLD = 6
"""Characters that expand to more letters than this, such as the phrase U+FDFA, stay as they are."""
ENTITY = re.compile(r"&(?:#\d{1,7}|#[xX][0-9a-fA-F]{1,6}|[A-Za-z]\w{1,31});?")
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


class _Folds(dict[str, str]):
    """A bounded cache of the normalized form of each character."""

    def __missing__(self, c: str) -> str:
        if len(self) >= 1 << 16:
            self.clear()
        self[c] = folded = _fold_character(c)
        return folded


def _fold_character(c: str) -> str:
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


FOLDS = _Folds()


def normalize_word(word: str) -> str:
    """A lexicon entry in its normalized form."""
    return "".join(map(FOLDS.__getitem__, word)).casefold()


def normalize(text: str) -> list[Reading]:
    """The readings of a text: two if markup or an invisible character separates letters, which may
    be of one word or of two."""
    reading = Reading(text, range(len(text)), range(1, len(text) + 1))
    if text.isascii() and not DISGUISE.search(text):
        return [reading]
    reading = _folded(
        _unescaped(_unescaped(reading))
    )  # Twice, since an entity may itself be escaped.
    joined = _without_seams(reading)
    parted = Reading(reading.text.translate(SEAMS_TO_SPACES), reading.starts, reading.stops)
    return [
        Reading(LEET.sub(lambda m: LEET_LETTERS[m[0]], r.text), r.starts, r.stops)
        for r in ([parted, joined] if joined else [parted])
    ]


def _unescaped(reading: Reading) -> Reading:
    text, starts, stops = reading.text, reading.starts, reading.stops
    entities = [m for m in ENTITY.finditer(text) if _meaning(m[0]) != m[0]]
    if not entities:
        return reading
    pieces: list[str] = []
    new_starts: list[int] = []
    new_stops: list[int] = []
    at = 0
    for match in entities:
        first, last = match.span()
        meant = _meaning(match[0])
        pieces += (text[at:first], meant)
        new_starts += starts[at:first]
        new_starts += [starts[first]] * len(meant)
        new_stops += stops[at:first]
        new_stops += [stops[last - 1]] * len(meant)
        at = last
    pieces.append(text[at:])
    return Reading("".join(pieces), [*new_starts, *starts[at:]], [*new_stops, *stops[at:]])


@lru_cache(maxsize=4096)
def _meaning(entity: str) -> str:
    # An entity of no character stays as it is.
    return html.unescape(entity) or entity


def _folded(reading: Reading) -> Reading:
    if reading.text.isascii():
        return reading
    text = IDIOM.sub(lambda m: "人" * len(m[0]), reading.text)
    folded = list(map(FOLDS.__getitem__, text))
    lengths = list(map(len, folded))
    if lengths.count(1) == len(lengths):
        return Reading("".join(folded), reading.starts, reading.stops)
    return Reading(
        "".join(folded),
        list(chain.from_iterable(map(repeat, reading.starts, lengths))),
        list(chain.from_iterable(map(repeat, reading.stops, lengths))),
    )


def _without_seams(reading: Reading) -> Reading | None:
    """The reading without seams; None if it has none."""
    keeps = bytearray(b"\1") * len(reading.text)
    for match in SEAM.finditer(reading.text):
        keeps[match.start() : match.end()] = bytes(match.end() - match.start())
    if all(keeps):
        return None
    text = "".join(compress(reading.text, keeps)).replace("_", " ")
    return Reading(
        text, list(compress(reading.starts, keeps)), list(compress(reading.stops, keeps))
    )
