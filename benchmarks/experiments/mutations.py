"""Flips facts of predicates, so that a rationale narrated from them states a falsehood."""

from __future__ import annotations

import json
import re
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from random import Random
from typing import Any

from data.records import COLORS, SelectionItem
from teacher.narrator import write_rationale
from teacher.predicates import (
    COMPASS,
    REGIONS,
    SPEEDS,
    VERY_FAST,
    CandidateFacts,
    Closeness,
    Difference,
    Meeting,
    ObjectFacts,
    Predicates,
)

ALL_REGIONS = [region for row in REGIONS for region in row]
ALL_SPEEDS = ["stationary", *(word for _, word in SPEEDS), VERY_FAST]
STILL = r"stationary|\brests\b|does not move"
PAIRED = {"courses": "collision course", "contacts": "ontact|meet", "close": "very close"}


@dataclass(frozen=True)
class Mutation:
    """Flipped predicates, and patterns that match in a sentence that states the flipped fact."""

    predicates: Predicates
    patterns: tuple[str, ...]

    def is_stated(self, text: str) -> bool:
        """Whether a sentence of the rationale states the flipped fact."""
        sentences = re.split(r"(?<=\.)\s", text)
        return any(all(re.search(p, s) for p in self.patterns) for s in sentences)


def predicates_from(record: dict[str, Any]) -> Predicates:
    """Rebuild predicates from the JSON form of their `to_dict`."""

    def pairs(name: str, make: Callable[..., Any]) -> tuple[Any, ...]:
        return tuple(make(**{**m, "objects": tuple(m["objects"])}) for m in record[name])

    candidates = tuple(
        CandidateFacts(**{**c, "differences": tuple(Difference(**d) for d in c["differences"])})
        for c in record["candidates"]
    )
    return Predicates(
        record["instant"],
        record["moment"],
        tuple(ObjectFacts(**o) for o in record["objects"]),
        tuple(record["entering"]),
        tuple(record["leaving"]),
        pairs("courses", Meeting),
        pairs("contacts", Meeting),
        pairs("close", Closeness),
        candidates,
    )


def mutations(predicates: Predicates, kind: str, rng: Random) -> list[Mutation]:
    """All flips of one kind, each to a random false value."""
    return KINDS[kind](predicates, rng)


def falsehoods(
    predicates: Predicates, item: SelectionItem, kind: str, rng: Random, seed: int = 0
) -> Iterator[tuple[str, Mutation]]:
    """Rationales that the built-in narrator writes from flipped facts and that state them."""
    text = write_rationale(predicates, item, seed)
    options = mutations(predicates, kind, rng)
    rng.shuffle(options)
    for mutation in options:
        false = write_rationale(mutation.predicates, item, seed)
        if false != text and mutation.is_stated(false):
            yield false, mutation


def _other(rng: Random, words: list[str] | tuple[str, ...], *but: str | None) -> str:
    return rng.choice([w for w in words if w not in but])


def _with_object(p: Predicates, i: int, **changes: Any) -> Predicates:
    return replace(
        p, objects=(*p.objects[:i], replace(p.objects[i], **changes), *p.objects[i + 1 :])
    )


def _with_difference(p: Predicates, c: int, d: int, **changes: Any) -> Predicates:
    facts = p.candidates[c]
    flips = list(facts.differences)
    flips[d] = replace(flips[d], **changes)
    candidates = list(p.candidates)
    candidates[c] = replace(facts, differences=tuple(flips))
    return replace(p, candidates=tuple(candidates))


def _differences(p: Predicates) -> list[tuple[int, int, str, Difference]]:
    return [
        (c, d, facts.letter, difference)
        for c, facts in enumerate(p.candidates)
        for d, difference in enumerate(facts.differences)
    ]


def directions(p: Predicates, rng: Random) -> list[Mutation]:
    flips = []
    for i, o in enumerate(p.objects):
        for field in ("heading", "travel"):
            if getattr(o, field):
                direction = _other(rng, COMPASS, o.heading, o.travel)
                patterns = (f"{o.object}", rf"toward the {direction}\b")
                flips.append(Mutation(_with_object(p, i, **{field: direction}), patterns))
    for c, d, letter, difference in _differences(p):
        if difference.heading:
            direction = _other(rng, COMPASS, difference.heading)
            patterns = (f"andidate {letter}", rf"{difference.object} [^.]*toward the {direction}\b")
            flips.append(Mutation(_with_difference(p, c, d, heading=direction), patterns))
    return flips


def speeds(p: Predicates, rng: Random) -> list[Mutation]:
    flips = []
    for i, o in enumerate(p.objects):
        if o.speed is None:
            continue
        speed = _other(rng, ALL_SPEEDS, o.speed)
        word = STILL if speed == "stationary" else rf"[mM]ov(?:ing|es) {speed}\b"
        flips.append(Mutation(_with_object(p, i, speed=speed), (o.object, word)))
    return flips


def regions(p: Predicates, rng: Random) -> list[Mutation]:
    flips = []
    for i, o in enumerate(p.objects):
        for field in ("region", "target_region"):
            if getattr(o, field) in ALL_REGIONS:
                region = _other(rng, ALL_REGIONS, o.region, o.target_region)
                patterns = (f"{o.object}", rf"{region}(?![-\w])")
                flips.append(Mutation(_with_object(p, i, **{field: region}), patterns))
    for c, d, letter, difference in _differences(p):
        if difference.region:
            places = {o.object: o.target_region for o in p.objects}
            region = _other(rng, ALL_REGIONS, difference.region, places[difference.object])
            patterns = (f"andidate {letter}", rf"{difference.object} {region}(?![-\w])")
            flips.append(Mutation(_with_difference(p, c, d, region=region), patterns))
    for k, close in enumerate(p.close):
        region = _other(rng, ALL_REGIONS, close.region)
        flipped = (*p.close[:k], replace(close, region=region), *p.close[k + 1 :])
        flips.append(Mutation(replace(p, close=flipped), (f"very close {region}(?![-\\w])",)))
    return flips


def pairs(p: Predicates, rng: Random) -> list[Mutation]:
    """Replace the partner of a pair by an object for which the fact is false."""
    names = [o.object for o in p.objects]
    met = {frozenset(m.objects) for m in (*p.courses, *p.contacts)}
    near = {frozenset(c.objects) for c in p.close}
    flips = []
    for field, known in (("courses", met), ("contacts", met), ("close", near)):
        facts = getattr(p, field)
        for k, fact in enumerate(facts):
            kept = fact.objects[0]
            free = [n for n in names if n != kept and frozenset((kept, n)) not in known]
            if free:
                partner = rng.choice(free)
                new = replace(fact, objects=(kept, partner))
                flipped = replace(p, **{field: (*facts[:k], new, *facts[k + 1 :])})
                flips.append(Mutation(flipped, (kept, partner, PAIRED[field])))
    if p.courses:
        flips.append(Mutation(replace(p, courses=()), ("No pair",)))
    return flips


def colors(p: Predicates, rng: Random) -> list[Mutation]:
    flips = []
    text = json.dumps(p.to_dict())
    names = {o.object for o in p.objects}
    for o in p.objects:
        color, _, looks = o.object.partition(" ")
        free = [c for c in COLORS if f"{c} {looks}" not in text]
        if color in COLORS and free and len(names) == len(p.objects):
            name = f"{rng.choice(free)} {looks}"
            flipped = predicates_from(json.loads(text.replace(f'"{o.object}"', f'"{name}"')))
            flips.append(Mutation(flipped, (name,)))
    return flips


def answers(p: Predicates, rng: Random) -> list[Mutation]:
    """Swap the facts of the right candidate with those of another one."""
    letters = [c.letter for c in p.candidates]
    right = letters.index(p.answer)
    other = rng.choice([i for i in range(len(letters)) if i != right])
    return [Mutation(_swapped(p, right, other), (f"andidate {letters[other]}",))]


def candidates(p: Predicates, rng: Random) -> list[Mutation]:
    """Swap the facts of two wrong candidates."""
    wrong = [i for i, c in enumerate(p.candidates) if not c.agrees]
    i, j = rng.sample(wrong, 2)
    first, second = p.candidates[i], p.candidates[j]
    if first.other_objects == second.other_objects and (
        first.differences[0] in second.differences and second.differences[0] in first.differences
    ):
        # The statement about each is true of both.
        return []
    return [Mutation(_swapped(p, i, j), (f"andidate {p.candidates[i].letter}",))]


def _swapped(p: Predicates, i: int, j: int) -> Predicates:
    flips = list(p.candidates)
    flips[i], flips[j] = (
        replace(flips[j], letter=flips[i].letter),
        replace(flips[i], letter=flips[j].letter),
    )
    return replace(p, candidates=tuple(flips))


def times(p: Predicates, rng: Random) -> list[Mutation]:
    """Change when a pair meets: another time, or never."""
    flips = []
    for k, course in enumerate(p.courses):
        if course.when == "unseen":
            continue
        when = rng.choice([w for w in ("imminent", "soon", "later", None) if w != course.when])
        flipped = (*p.courses[:k], replace(course, when=when), *p.courses[k + 1 :])
        patterns = "without contact|not meet" if when is None else f"about to|{when}"
        flips.append(Mutation(replace(p, courses=flipped), (*course.objects, patterns)))
    return flips


KINDS: dict[str, Callable[[Predicates, Random], list[Mutation]]] = {
    "direction": directions,
    "speed": speeds,
    "region": regions,
    "pair": pairs,
    "color": colors,
    "answer": answers,
    "imminence": times,
    "candidate": candidates,
}
"""The generators of flips, by kind of fact."""
