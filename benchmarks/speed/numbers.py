"""How long the finder of numbers takes a kilobyte (of UTF-8), for prose and for hostile text.

    python -m benchmarks.speed.numbers

The prose is what the built-in narrator tells of random scenes. Hostile texts repeat a piece to
4 KB, 64 KB and 1 MB: a figure that does not grow from column to column is linear time. Each is the
best of five runs, in processor time.
"""

from __future__ import annotations

import random
import time

import numpy as np

from data.records import LETTERS
from teacher.narrator import narrate
from teacher.numbers import find_numbers
from teacher.predicates import predicates_of
from tests.teacher import synthetic

SIZES = (4 << 10, 64 << 10, 1 << 20)
RATIONALES = 200
MIXTURES = 300
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
    *("\ud800", "\U0010ffff", "\x00", "é", "ß", "İ", "т", "🇹🇼"),
)
"""What is repeated: openings that never close, disguises, and words whose rules look about them."""


def rationales(count: int = RATIONALES) -> list[str]:
    """What the built-in narrator tells of random scenes."""
    rng = np.random.default_rng(0)
    told: list[str] = []
    while len(told) < count:
        scene = synthetic.random_scene(rng)
        item = synthetic.item((60, 70, 80, 90), answer=len(told) % len(LETTERS))
        predicates = predicates_of(item, scene, None)
        if predicates is not None:
            told.append(narrate(predicates, item, seed=len(told)))
    return told


def hostile(piece: str, size: int) -> str:
    """A piece repeated to about so many bytes."""
    return piece * (size // len(piece.encode("utf-8", "surrogatepass")))


def ms_per_kilobyte(texts: list[str]) -> float:
    best = float("inf")
    for _ in range(5):
        start = time.process_time()
        for text in texts:
            find_numbers(text)
        best = min(best, time.process_time() - start)
    size = sum(len(text.encode("utf-8", "surrogatepass")) for text in texts)
    return 1e3 * best / (size / 1024)


def main() -> None:
    told = rationales()
    each = sum(map(len, told)) / len(told)
    prose = ms_per_kilobyte(told)
    print(f"{len(told)} rationales of {each:.0f} characters")
    print(f"prose             {prose:.3f} ms a kilobyte, {prose * each / 1024:.3f} ms a rationale")
    typographic = ms_per_kilobyte([f"“{text}” — é" for text in told])
    print(f"not all ASCII     {typographic:.3f} ms a kilobyte")
    print("\nhostile, ms a kilobyte at        4 KB    64 KB     1 MB")
    rows = [
        (piece, [ms_per_kilobyte([hostile(piece, size)]) for size in SIZES]) for piece in PIECES
    ]
    for piece, row in sorted(rows, key=lambda row: -max(row[1]))[:20]:
        print(f"{piece!a:27}" + "".join(f"{ms:9.3f}" for ms in row))
    print(f"the slowest of {len(rows)} at 1 MB: {max(row[-1] for _, row in rows):.3f}")
    rng = random.Random(0)
    mixed = ["".join(rng.choices(PIECES, k=rng.choice((2, 3)))) for _ in range(MIXTURES)]
    slowest = max((ms_per_kilobyte([hostile(piece, SIZES[1])]), ascii(piece)) for piece in mixed)
    print(f"the slowest of {MIXTURES} mixtures of these at 64 KB: {slowest[0]:.3f}, {slowest[1]}")


if __name__ == "__main__":
    main()
