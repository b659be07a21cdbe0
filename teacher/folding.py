"""Undoes the disguises of prose: entities, markup, styled and look-alike letters.

Folded text is paired with the span of the original that each of its characters came from.
"""

from __future__ import annotations

import html
import re
import unicodedata
from functools import lru_cache

from teacher.lexicon import IDEOGRAPHS, PICTOGRAPHS

Spans = list[tuple[int, int]]

LOOKALIKES = {
    **dict(zip("аеорсухіјѕԁԛԝвмтнкһѵʋɑɡı", "aeopcyxijsdqwbmthkhvvagi", strict=True)),
    **dict(zip("АВЕКМНОРСТУХІЈЅԚԜѴ", "ABEKMHOPCTYXIJSQWV", strict=True)),
    **dict(zip("οντωειυακχρ", "ovtweiuakxp", strict=True)),
    **dict(zip("ΑΒΕΖΗΙΚΜΝΟΡΤΥΧ", "ABEZHIKMNOPTYX", strict=True)),
    **dict(zip("ᴀʙᴄᴅᴇꜰɢʜɪᴊᴋʟᴍɴᴏᴘʀꜱᴛᴜᴠᴡʏᴢ", "abcdefghijklmnoprstuvwyz", strict=True)),
    **dict(zip("łøđħ", "lodh", strict=True)),
    **{
        chr(base + i): chr(65 + i)
        for base in (0x1F130, 0x1F150, 0x1F170, 0x1F1E6)
        for i in range(26)
    },
}
ENTITY = re.compile(r"&(?:#\d{1,7}|#[xX][0-9a-fA-F]{1,6}|[A-Za-z]\w{1,31});?")
TAG = re.compile(r"</?[A-Za-z][^<>]{0,60}>")
LEET = re.compile(r"(?<=[A-Za-z])[!|@](?=[A-Za-z])|\$(?=[A-Za-z])")
LEET_LETTERS = {"!": "i", "|": "i", "@": "a", "$": "s"}


@lru_cache(maxsize=4096)
def fold_character(c: str) -> tuple[str, bool]:
    """What a character reads as, and whether it states a number by itself."""
    plain = unicodedata.normalize("NFKC", c)
    number = c in IDEOGRAPHS or c in PICTOGRAPHS or any(map(_is_numeral, (c, *plain)))
    letters = []
    for part in unicodedata.normalize("NFKD", plain):
        if unicodedata.category(part) not in ("Mn", "Me", "Cf"):
            letters.append(LOOKALIKES.get(part, part))
    return "".join(letters), number


def _is_numeral(c: str) -> bool:
    return unicodedata.category(c)[0] == "N" or unicodedata.numeric(c, None) is not None


def fold_word(word: str) -> str:
    """A lexicon entry as it looks in folded text."""
    return "".join(fold_character(c)[0] for c in word).casefold()


def fold(text: str) -> tuple[list[tuple[str, Spans]], Spans]:
    """Readings of a text, each with the original span of every character, and the spans of the
    characters that state a number by themselves. There is a further reading where markup stands
    between letters, for it may join a word or part two."""
    if text.isascii() and not any(c in text for c in "&<*`~!|@$_"):
        spans = [(i, i + 1) for i in range(len(text))]
        return [(text, spans)], [(i, i + 1) for i, c in enumerate(text) if c.isdigit()]
    text, spans = _unescape(text, [(i, i + 1) for i in range(len(text))])
    numerals, letters, where = [], [], []
    for c, span in zip(text, spans, strict=True):
        folded, number = fold_character(c)
        if number:
            numerals.append(span)
        letters.extend(folded)
        where.extend([span] * len(folded))
    folded = "".join(letters).replace("_", " ")
    readings = [_without(folded, where, TAG)]
    if any(c in folded for c in "*`~"):
        parted = folded.translate(str.maketrans("*`~", "   "))
        readings = [
            _without(readings[0][0], readings[0][1], re.compile(r"[*`~]+")),
            _without(parted, where, TAG),
        ]
    return [
        (LEET.sub(lambda m: LEET_LETTERS[m[0]], reading), spans) for reading, spans in readings
    ], numerals


def _without(text: str, spans: Spans, pattern: re.Pattern[str]) -> tuple[str, Spans]:
    if not pattern.search(text):
        return text, spans
    kept, where, at = [], [], 0
    for match in pattern.finditer(text):
        kept.append(text[at : match.start()])
        where += spans[at : match.start()]
        at = match.end()
    return "".join([*kept, text[at:]]), where + spans[at:]


def _unescape(text: str, spans: Spans) -> tuple[str, Spans]:
    # Twice, for an entity may itself have been escaped.
    for _ in range(2):
        if "&" not in text:
            break
        pieces, where, at = [], [], 0
        for match in ENTITY.finditer(text):
            meant = html.unescape(match[0])
            pieces += [text[at : match.start()], meant]
            whole = (spans[match.start()][0], spans[match.end() - 1][1])
            where += [*spans[at : match.start()], *[whole] * len(meant)]
            at = match.end()
        text, spans = "".join([*pieces, text[at:]]), where + spans[at:]
    return text, spans
