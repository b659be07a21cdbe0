"""False words: changes of a rationale that make one of its statements false.

Each mutation yields texts in which one word, or a pair of names, is replaced so that the statement
is false of the item. Words whose replacement could be true as well are left as they are.
"""

from __future__ import annotations

import re
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import asdict
from random import Random

from dynapix.data.records import COLORS, LETTERS
from dynapix.teacher.predicates.facts import (
    COMPASS,
    REGIONS,
    SPEEDS,
    VERY_FAST,
    Predicates,
    RelationalPredicates,
)

ALL_REGIONS = [region for row in REGIONS for region in row]
MOVING = [*SPEEDS, VERY_FAST]

Mutation = tuple[str, tuple[int, int]]
"""A text with a false word, and the span of this word."""
Mutate = Callable[[str, Predicates, Random], Iterator[Mutation]]


def replace_match(text: str, match: re.Match[str], word: str) -> Mutation:
    start = match.start()
    return text[:start] + word + text[match.end() :], (start, start + len(word))


def is_motion_known(text: str, position: int, predicates: Predicates) -> bool:
    """Return whether the last object named before `position` in its sentence has a known speed."""
    before = text[text.rfind(".", 0, position) + 1 : position].lower()
    last = max(predicates.objects, key=lambda facts: before.rfind(facts.object))
    return last.object not in before or last.speed is not None


def replace_colors(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
    """Replace the colour of an object so that the name fits no object in the predicates.

    "Candidate A shows no red metal cube" is left as it is: it is true of any other object, too.
    """
    known = str(asdict(predicates))
    for match in re.finditer(rf"(?<!\bno )\b({'|'.join(COLORS)})( (?:metal|rubber) \w+)", text):
        free = [color for color in COLORS if f"{color}{match[2]}" not in known]
        if free and not match[2].endswith("s"):
            yield replace_match(text, match, rng.choice(free) + match[2])


def replace_partners(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
    """Replace the second object in clauses of the motion analysis that state that a pair meets."""
    names = [facts.object for facts in predicates.objects]
    met = {frozenset(m.objects) for m in (*predicates.courses, *predicates.contacts)}
    met |= {frozenset(pair) for pair in predicates.later}
    start, stop = text.find("Motion analysis:"), text.find("Prediction:")
    for clause in re.finditer(r"[^.;]+[.;]", text[start:stop]):
        begin, end = start + clause.start(), start + clause.end()
        inside = list(re.compile("|".join(names)).finditer(text, begin, end))
        pair = frozenset(match[0] for match in inside)
        denied = re.search(r"\b(?:not?|never|without|avoid|misse?s?|clear)\b", clause[0])
        stated = re.search(r"contact|colli|meet|hit|strik|struck|touch|run|course|path", clause[0])
        if len(inside) == 2 and pair in met and stated and not denied:
            kept = inside[0][0]
            free = [n for n in names if n not in pair and frozenset((kept, n)) not in met]
            if free:
                yield replace_match(text, inside[1], rng.choice(free))


OBJECT = rf"the (?:{'|'.join(COLORS)}) (?:metal|rubber) \w+"
SIDES = {
    "left of": ["right of", "vertically aligned with"],
    "to the left of": ["right of", "to the right of"],
    "right of": ["left of", "vertically aligned with"],
    "to the right of": ["left of", "to the left of"],
    "vertically aligned with": ["left of", "right of"],
}
HEIGHTS = {
    "above": ["below", "level with"],
    "below": ["above", "level with"],
    "level with": ["above", "below"],
}
# An object that is right against another is also near it.
GAPS = {
    "right against": ["well apart from"],
    "near": ["right against", "well apart from"],
    "well apart from": ["near", "right against"],
}
COVERS = {"in front of": ["behind"], "behind": ["in front of"]}
OPPOSITE_EDGES = {"left": "right", "right": "left", "top": "bottom", "bottom": "top"}
EXTREMES = {
    "leftmost": "rightmost", "rightmost": "leftmost", "topmost": "lowest", "lowest": "topmost"
}  # fmt: skip

# What is imminent comes soon, too.
FALSE_TIMES = {"imminent": ["later"], "soon": ["imminent", "later"], "later": ["imminent", "soon"]}
# An object that is far off is also clearly off.
FALSE_EXTENTS = {
    "slightly": ["clearly", "far"],
    "clearly": ["slightly", "far"],
    "far": ["slightly"],
}


def replace_by(
    words: Mapping[str, str | Sequence[str]],
    before: str = "",
    after: str = "",
    of_motion: bool = False,
) -> Mutate:
    """Return a mutation that replaces each of `words` by its false word, or by one of several.

    Args:
        before: Regular expression of what precedes the word, such as `(?<!not )`.
        after: The same for what follows it.
        of_motion: Whether words about an object whose motion is unknown are left as they are,
            because no word for this motion would be false.
    """
    pattern = rf"{before}\b(?:{'|'.join(words)})\b{after}"

    def mutate(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
        for match in re.finditer(pattern, text):
            if not of_motion or is_motion_known(text, match.start(), predicates):
                false = words[match[0]]
                word = false if isinstance(false, str) else rng.choice(false)
                yield replace_match(text, match, word)

    return mutate


def list_others(words: Sequence[str]) -> dict[str, list[str]]:
    """Return the other words for each of `words`."""
    return {word: [other for other in words if other != word] for word in words}


def replace_relations(phrases: Mapping[str, Sequence[str]]) -> Mutate:
    """Return a mutation that replaces each relation of these phrases by another value that excludes
    it. Relations that are denied are left as they are.

    Args:
        phrases: For each phrase, those that are false if it is true.
    """
    pattern = "|".join(sorted(phrases, key=len, reverse=True))
    # "The red metal cube" and not "the left" follows, or "with the red metal cube" precedes.
    named = re.compile(rf"the (?:{'|'.join(COLORS)}) ")
    possessed = re.compile(rf"(?:with|has|have) {OBJECT} $")

    def mutate(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
        for match in re.finditer(rf"(?<!not )\b({pattern}) (?=the |it\b)", text):
            start, stop = match.span()
            if named.match(text, stop) or possessed.search(text[max(0, start - 60) : start]):
                yield replace_match(text, match, rng.choice(phrases[match[1]]) + " ")

    return mutate


def rewrite(pattern: str, template: str) -> Mutate:
    """Return a mutation that replaces each match of a pattern by a template with its groups."""

    def mutate(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
        for match in re.finditer(pattern, text):
            yield replace_match(text, match, match.expand(template))

    return mutate


def replace_passed(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
    """In "a passes b" or "a crosses behind b", replace b by an object that a does not pass."""
    if not isinstance(predicates, RelationalPredicates):
        return
    passed = {r.objects for r in predicates.target.statements if r.kind == "passing"}
    verbs = "passes|crosses in front of|crosses behind"
    for match in re.finditer(rf"({OBJECT}) (?:{verbs}) (?=({OBJECT}))", text, re.IGNORECASE):
        mover, other = (name[len("the ") :] for name in match.groups())
        free = [n for n in predicates.paths if n not in (mover, other) and (mover, n) not in passed]
        if free:
            start, stop = match.span(2)
            name = f"the {rng.choice(free)}"
            yield text[:start] + name + text[stop:], (start, start + len(name))


def swap_candidates(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
    """Exchange the letters of the target and of another candidate after the word "candidate", from
    the candidate analysis up to the answer."""
    right = predicates.answer
    other = rng.choice([letter for letter in LETTERS if letter != right])
    start, stop = text.find("Candidate analysis:"), text.find("Answer:")
    swapped = {right: other, other: right}
    body = re.sub(r"(?<=andidate )[A-D]\b", lambda m: swapped.get(m[0], m[0]), text[start:stop])
    if body != text[start:stop]:
        yield text[:start] + body + text[stop:], (start, stop)


MUTATIONS: dict[str, Mutate] = {
    "direction": replace_by(list_others(COMPASS), after="(?!-)", of_motion=True),
    "region": replace_by(list_others(ALL_REGIONS), after="(?!-)"),
    "speed": replace_by(list_others(MOVING), after="(?!-)", of_motion=True),
    "time": replace_by(FALSE_TIMES, after="(?!-)"),
    "color": replace_colors,
    "pair": replace_partners,
    "answer": replace_by(list_others(LETTERS), before="(?m:(?<=^Answer: ))"),
    "candidate": swap_candidates,
}
"""For each kind of word, a function that yields texts in which one such word is false."""
RELATION_MUTATIONS: dict[str, Mutate] = {
    "side": replace_relations(SIDES),
    "height": replace_relations(HEIGHTS),
    "gap": replace_relations(GAPS),
    "cover": replace_relations(COVERS),
    # In "a is between b and c" or "a comes between b and c", exchange a and b: b lies at an end.
    "between": rewrite(
        rf"(?i:({OBJECT})( (?:is |will be |comes )?between )({OBJECT})(?= and ))", r"\3\2\1"
    ),
    # In "nearer to b than to c", exchange b and c.
    "nearer": rewrite(
        rf"(?<!not )((?:nearer|closer) to )({OBJECT})( than to )({OBJECT})", r"\1\4\3\2"
    ),
    "as near": rewrite(
        rf"about as near to ({OBJECT}) as to ({OBJECT})", r"nearer to \1 than to \2"
    ),
    "extreme": replace_by(EXTREMES, before="(?<!not )"),
    "edge": replace_by(OPPOSITE_EDGES, before="(?<=reaches the )", after="(?= edge)"),
    "passing": replace_passed,
    "distance": replace_by(FALSE_EXTENTS, after=r"(?= off\b)"),
    "sight": replace_by({"out of sight": ALL_REGIONS}, before="(?<!not )"),
}
"""The same for words of relations, which only relational rationales have."""
