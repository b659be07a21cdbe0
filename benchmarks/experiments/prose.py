"""Replaces single words of a true rationale by false ones."""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator
from random import Random

from benchmarks.experiments.mutations import ALL_REGIONS, ALL_SPEEDS
from data.records import COLORS, LETTERS
from teacher.predicates import COMPASS, Predicates

Edit = tuple[str, tuple[int, int]]
"""A mutated text and the span of the false word."""


def _swap(text: str, match: re.Match[str], word: str) -> Edit:
    start = match.start()
    return text[:start] + word + text[match.end() :], (start, start + len(word))


def _words(words: list[str] | tuple[str, ...]) -> re.Pattern[str]:
    return re.compile(rf"\b(?:{'|'.join(sorted(words, key=len, reverse=True))})\b(?!-)")


def _is_known(text: str, at: int, predicates: Predicates) -> bool:
    """Whether the predicates know the motion of the last object named before `at`. They do not for
    an object out of view at the cut, so no word for its motion is false."""
    before = text[text.rfind(".", 0, at) + 1 : at].lower()
    last = max(predicates.objects, key=lambda o: before.rfind(o.object))
    return last.object not in before or last.speed is not None


def directions(text: str, predicates: Predicates, rng: Random) -> Iterator[Edit]:
    for match in _words(COMPASS).finditer(text):
        if not _is_known(text, match.start(), predicates):
            continue
        yield _swap(text, match, rng.choice([w for w in COMPASS if w != match[0]]))


def regions(text: str, predicates: Predicates, rng: Random) -> Iterator[Edit]:
    for match in _words(ALL_REGIONS).finditer(text):
        yield _swap(text, match, rng.choice([w for w in ALL_REGIONS if w != match[0]]))


def speeds(text: str, predicates: Predicates, rng: Random) -> Iterator[Edit]:
    moving = ALL_SPEEDS[1:]
    for match in _words(moving).finditer(text):
        if not _is_known(text, match.start(), predicates):
            continue
        yield _swap(text, match, rng.choice([w for w in moving if w != match[0]]))


def colors(text: str, predicates: Predicates, rng: Random) -> Iterator[Edit]:
    known = str(predicates.to_dict())
    for match in re.finditer(rf"\b({'|'.join(COLORS)})( (?:metal|rubber) \w+)", text):
        free = [c for c in COLORS if f"{c}{match[2]}" not in known]
        if free and not match[2].endswith("s"):
            yield _swap(text, match, rng.choice(free) + match[2])


def pairs(text: str, predicates: Predicates, rng: Random) -> Iterator[Edit]:
    """Replace the partner in each sentence of the motion analysis that states exactly one pair."""
    names = [o.object for o in predicates.objects]
    met = {frozenset(m.objects) for m in (*predicates.courses, *predicates.contacts)}
    start, stop = text.find("Motion analysis:"), text.find("Prediction:")
    for clause in re.finditer(r"[^.;]+[.;]", text[start:stop]):
        inside = list(_words(names).finditer(text, start + clause.start(), start + clause.end()))
        pair = frozenset(m[0] for m in inside)
        denied = re.search(r"\b(?:not?|never|without|avoid|misse?s?|clear)\b", clause[0])
        stated = re.search(r"contact|colli|meet|hit|strik|struck|touch|run|course|path", clause[0])
        if len(inside) == 2 and pair in met and stated and not denied:
            kept = inside[0][0]
            free = [n for n in names if n not in pair and frozenset((kept, n)) not in met]
            if free:
                yield _swap(text, inside[1], rng.choice(free))


def answers(text: str, predicates: Predicates, rng: Random) -> Iterator[Edit]:
    for match in re.finditer(r"(?<=^Answer: )[A-D]", text, re.MULTILINE):
        yield _swap(text, match, rng.choice([c for c in LETTERS if c != match[0]]))


EDITS: dict[str, Callable[[str, Predicates, Random], Iterator[Edit]]] = {
    "direction": directions,
    "region": regions,
    "speed": speeds,
    "color": colors,
    "pair": pairs,
    "answer": answers,
}
"""The generators of false words, by kind of fact."""
