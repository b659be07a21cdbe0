"""Text that makes a search for numbers slow if the search takes quadratic time."""

from __future__ import annotations

PIECES = (
    *("<", ">", "&", "&#", "&a", "&lt;", "&amp;", "&#51;", "<a", "<b>", "</", "*", "`", "~", "_"),
    *("**a", "a*", "é*", "é<b>", "!a", "a!", "$a", "|a|", "-", "a-", "t-", "t-w-", "one-", "tw-"),
    *("one ", "one one's ", "One, ", "the one ", "first ", "first, ", "at first", "once ", "once"),
    *("once, ", "minute ", "a minute ", "few of the more ", "few frames ", "a frame ", "frame "),
    *("I ", "I'", "V", "(i)", "phase I ", "MDCCCLXXXVIII", "a ", "A", "ab ", "t w o ", "s e v e "),
    *("t.w.", "s\n", "two", "twoone", "eighteenq", "hundredand", "oo", "aabb", "teeeen", "TwoOne"),
    *("x", "to ", "no ", "thous and ", ". ", ", ", "\n", "\t", " ", "1", "1,", "%", "½", "٣"),
    *("\u0301", "t\u0301", "1\u0301", "\u200b", "a\u200b", "t\u200bw\u200b", "\u00ad", "\ufeff"),
    *("\u0915\u093e", "\u093f", "三", "二球", "ふた", "ส", "\ufdfa", "\u3300", "\U0001d7d8", "🕒"),
    *("the other ", "the wider ", "a few more ", "any number of ", "a red metal ", "width "),
    *("as far as the cube is ", "rests a cube ", "gap of ", "away ", "second ", "第", "一", "几"),
    *("\ud800", "\U0010ffff", "\x00", "é", "ß", "İ", "т", "🇹🇼"),
)
"""Pieces to repeat: markup that is never closed, disguised numbers, and words that are numbers only
in some contexts."""


def repeat_piece(piece: str, size: int) -> str:
    """Return the piece, repeated to about `size` bytes of UTF-8."""
    return piece * (size // len(piece.encode("utf-8", "surrogatepass")))
