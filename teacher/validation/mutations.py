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


def replace_words(
    text: str, words: Sequence[str], rng: Random, predicates: Predicates | None = None
) -> Iterator[Mutation]:
    """Yield one text for each occurrence of one of `words`, in which another of them replaces it.

    With `predicates`, a word about an object whose motion is unknown is not replaced, because no
    word for this motion would be false.
    """
    pattern = "|".join(sorted(words, key=len, reverse=True))
    for match in re.finditer(rf"\b(?:{pattern})\b(?!-)", text):
        if predicates is None or is_motion_known(text, match.start(), predicates):
            yield replace_match(text, match, rng.choice([w for w in words if w != match[0]]))


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


def replace_relations(
    text: str, phrases: Mapping[str, Sequence[str]], rng: Random
) -> Iterator[Mutation]:
    """Yield one text for each relation of these phrases, with another value that excludes it.
    Relations that are denied are left as they are.

    Args:
        phrases: For each phrase, those that are false if it is true.
    """
    pattern = "|".join(map(re.escape, sorted(phrases, key=len, reverse=True)))
    for match in re.finditer(rf"(?<!not )\b({pattern}) (?=the |it\b)", text):
        if _names_object(text, match.end()) or _is_possessed(text, match.start()):
            yield replace_match(text, match, rng.choice(phrases[match[1]]) + " ")


def _names_object(text: str, position: int) -> bool:
    """Return whether "the red metal cube" follows, and not "the left"."""
    return bool(re.match(rf"the (?:{'|'.join(COLORS)}) ", text[position : position + 20]))


def _is_possessed(text: str, position: int) -> bool:
    """Return whether "with the red metal cube" or "has the red metal cube" precedes."""
    return bool(re.search(rf"(?:with|has|have) {OBJECT} $", text[max(0, position - 60) : position]))


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
    words: Mapping[str, str | Sequence[str]], before: str = "", after: str = ""
) -> Callable[[str, Predicates, Random], Iterator[Mutation]]:
    """Return a mutation that replaces each of `words` by its false word, or by one of several.

    Args:
        before: Regular expression of what precedes the word, such as `(?<!not )`.
        after: The same for what follows it.
    """
    pattern = rf"{before}\b(?:{'|'.join(words)})\b{after}"

    def mutate(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
        for match in re.finditer(pattern, text):
            false = words[match[0]]
            yield replace_match(text, match, false if isinstance(false, str) else rng.choice(false))

    return mutate


def swap_subjects(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
    """In "a is between b and c" or "a comes between b and c", exchange a and b: then b lies at an
    end."""
    pattern = rf"({OBJECT})( (?:is |will be |comes )?between )({OBJECT})(?= and )"
    for match in re.finditer(pattern, text, re.IGNORECASE):
        yield replace_match(text, match, f"{match[3]}{match[2]}{match[1]}")


def swap_distances(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
    """In "nearer to b than to c", exchange b and c."""
    pattern = rf"(?<!not )((?:nearer|closer) to )({OBJECT})( than to )({OBJECT})"
    for match in re.finditer(pattern, text):
        yield replace_match(text, match, f"{match[1]}{match[4]}{match[3]}{match[2]}")


def unbalance_distances(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
    """Replace "about as near to b as to c" with "nearer to b than to c"."""
    for match in re.finditer(rf"about as near to ({OBJECT}) as to ({OBJECT})", text):
        yield replace_match(text, match, f"nearer to {match[1]} than to {match[2]}")


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


def replace_answer(text: str, predicates: Predicates, rng: Random) -> Iterator[Mutation]:
    for match in re.finditer(r"(?<=^Answer: )[A-D]", text, re.MULTILINE):
        yield replace_match(text, match, rng.choice([c for c in LETTERS if c != match[0]]))


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


MUTATIONS: dict[str, Callable[[str, Predicates, Random], Iterator[Mutation]]] = {
    "direction": lambda text, p, rng: replace_words(text, COMPASS, rng, p),
    "region": lambda text, p, rng: replace_words(text, ALL_REGIONS, rng),
    "speed": lambda text, p, rng: replace_words(text, MOVING, rng, p),
    "time": replace_by(FALSE_TIMES, after="(?!-)"),
    "color": replace_colors,
    "pair": replace_partners,
    "answer": replace_answer,
    "candidate": swap_candidates,
}
"""For each kind of word, a function that yields texts in which one such word is false."""
RELATION_MUTATIONS: dict[str, Callable[[str, Predicates, Random], Iterator[Mutation]]] = {
    "side": lambda text, p, rng: replace_relations(text, SIDES, rng),
    "height": lambda text, p, rng: replace_relations(text, HEIGHTS, rng),
    "gap": lambda text, p, rng: replace_relations(text, GAPS, rng),
    "cover": lambda text, p, rng: replace_relations(text, COVERS, rng),
    "between": swap_subjects,
    "nearer": swap_distances,
    "as near": unbalance_distances,
    "extreme": replace_by(EXTREMES, before="(?<!not )"),
    "edge": replace_by(OPPOSITE_EDGES, before="(?<=reaches the )", after="(?= edge)"),
    "passing": replace_passed,
    "distance": replace_by(FALSE_EXTENTS, after=r"(?= off\b)"),
    "sight": replace_by({"out of sight": ALL_REGIONS}, before="(?<!not )"),
}
"""The same for words of relations, which only relational rationales have."""
