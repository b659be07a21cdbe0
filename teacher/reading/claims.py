"""Claims of a rationale, and their verdicts from the predicates of an item."""

from __future__ import annotations

import math
from collections import Counter
from collections.abc import Callable, Collection, Iterable
from itertools import product
from typing import NamedTuple

from dynapix.teacher.predicates.facts import (
    COMPASS,
    OUT_OF_VIEW,
    Difference,
    ObjectFacts,
    Predicates,
    Relation,
    RelationalPredicates,
    View,
)
from dynapix.teacher.predicates.relations import (
    EXTENTS,
    VALUES,
    describe_distance,
    normalize_relation,
)

CUT, BETWEEN, TARGET, EITHER = "cut", "between", "target", "either"
"""The moment of a claim: the cut (the last frame that the predicates treat as observed), the time
from the cut to the target, the target, or, if the text leaves it open, the cut or the target."""
COARSE = "~"
"""Prefix of a value that the text states only roughly. "Leftward" has the value "~west": true for
west, unknown for northwest and southwest, and false for the other directions."""
JOINT = " or "
"""Between the names of the objects of which the text may mean any."""
VERDICTS = ("supported", "contradicted", "unknown")


class Claim(NamedTuple):
    """A statement of a rationale, and the verdict of the predicates on it.

    "The red cube is not near the left" has the kind "region", the subject "red metal cube" and the
    value "near the left" (words of the predicates), and is not `affirmed`. `subjects` is empty if
    the text leaves it open; a value after "~" is meant roughly. `when` is the moment, `candidate`
    the letter of the candidate that the claim is about (None for the scene), and `span` the
    position in the text.

    Kinds for an object: "mention" (it exists), "region", "direction", "speed", "still" (at rest),
    "extent", "sight", "leaves", "enters". For a pair: "course", "meeting", "time" (of the meeting),
    "close", "close region" (of a close pair), "place of either" (of the pair or its second object).
    For a candidate: "agrees" (of the place of its subject, if any), "other objects"; objects:
    "region", "lacks", "extra", "displaced". For two or three objects, of the scene or of a
    candidate: the kinds of relations (see `teacher.predicates.relations`), and "weight".
    "unreadable" stands for a sentence that could not be read, and always has the verdict "unknown".
    """

    kind: str
    subjects: tuple[str, ...]
    value: str
    affirmed: bool
    when: str
    candidate: str | None
    span: tuple[int, int]
    verdict: str = "unknown"

    def __str__(self) -> str:
        words = [self.kind, *([] if self.affirmed else ["not"]), self.value.lstrip(COARSE)]
        names = " and ".join(self.subjects)
        where = f"in {self.candidate}" if self.candidate else ""
        return " ".join(filter(None, (*words, f"({names})" if names else "", where)))


class IndexedPredicates:
    """The predicates of an item in dictionaries, by object, pair or candidate."""

    def __init__(self, predicates: Predicates) -> None:
        self.objects = {o.object: o for o in predicates.objects}
        counts = Counter(o.object for o in predicates.objects)
        self.look_alikes = {name for name, count in counts.items() if count > 1}
        self.courses = {frozenset(m.objects): m.when for m in predicates.courses}
        self.contacts = {frozenset(m.objects): m.when for m in predicates.contacts}
        self.close = {frozenset(c.objects): c.region for c in predicates.close}
        self.later = [frozenset(pair) for pair in predicates.later]
        self.heavier = predicates.heavier
        self.records_contacts = predicates.records_contacts
        self.candidates = {c.letter: c for c in predicates.candidates}
        self.differences: dict[str, dict[str, Difference]] = {
            c.letter: {d.object: d for d in c.differences} for c in predicates.candidates
        }
        self.observed: frozenset[Relation] | None = None
        """Relations at the cut; None if the predicates have no relations."""
        self.views: dict[str, View] = {}
        if isinstance(predicates, RelationalPredicates):
            self.observed = frozenset(predicates.observed)
            self.views = {view.letter: view for view in predicates.views}
        self.answer = predicates.answer
        self.extras = {
            name
            for found in self.differences.values()
            for name, d in found.items()
            if d.kind == "extra" and name not in self.objects
        }

    def is_observed(self, kind: str, objects: tuple[str, ...], value: str) -> bool:
        """Return whether a relation is known to hold at the cut."""
        found = self.observed or ()
        return len(objects) > 1 and normalize_relation(Relation(kind, objects, value)) in found

    def judge(self, claim: Claim) -> Claim:
        """Return a claim with its verdict. If the text leaves open which object is meant, the claim
        is contradicted if it is false of each that may be, otherwise unknown."""
        options = [*product(*(name.split(JOINT) for name in claim.subjects))]
        verdicts = {self.verdict(claim._replace(subjects=names)) for names in options}
        if len(options) == 1:
            return claim._replace(verdict=verdicts.pop())
        false = verdicts == {"contradicted"}
        return claim._replace(subjects=(), verdict="contradicted" if false else "unknown")

    def verdict(self, claim: Claim) -> str:
        """Return one of `VERDICTS`; "unknown" if the predicates do not tell, or if several objects
        have the name that the claim uses."""
        if claim.kind != "mention" and self.look_alikes.intersection(claim.subjects):
            return "unknown"
        truth = self.truth(claim)
        if truth is None:
            return "unknown"
        if truth == claim.affirmed:
            return "supported"
        return "contradicted"

    def truth(self, claim: Claim) -> bool | None:
        """Return whether a claim without its negation holds; None if predicates do not tell."""
        if claim.kind == "unreadable":
            return None
        if not self.records_contacts and (claim.kind in PAIR_CHECKS or claim.kind == "gap"):
            return None
        if claim.kind == "weight":
            pair = claim.subjects[:: 1 if claim.value == "heavier than" else -1]
            return pair in self.heavier or (False if pair[::-1] in self.heavier else None)
        if claim.kind in VALUES:
            return self._truth_of_relation(claim)
        if claim.candidate is not None:
            return self._truth_in_candidate(claim.candidate, claim)
        if claim.kind == "mention":
            name = claim.subjects[0]
            # The text may name an object that only a candidate shows.
            return name in self.objects or (claim.when == EITHER and name in self.extras)
        if claim.kind == "close region" and not claim.subjects:
            return self._truth_of_any(claim)
        if claim.kind in PAIR_CHECKS:
            return PAIR_CHECKS[claim.kind](self, claim)
        facts = self.objects.get(claim.subjects[0])
        return None if facts is None else OBJECT_CHECKS[claim.kind](facts, claim.value, claim.when)

    def _truth_of_relation(self, claim: Claim) -> bool | None:
        """Return whether a relation holds at the claim's moment; None if an object is unseen."""
        if self.observed is None or not claim.subjects:
            return None
        relation = normalize_relation(Relation(claim.kind, claim.subjects, claim.value))
        view = self.views.get(claim.candidate or self.answer)
        if view is None or not set(claim.subjects) <= self.objects.keys():
            return None
        shown = {o.object for o in view.objects if o.target_sight == "shown"}
        at_target = _holds(relation, view.statements) if shown >= set(claim.subjects) else None
        if claim.candidate is not None or claim.when in (TARGET, BETWEEN):
            # A candidate that lacks an object does not show it in any relation.
            lacks = claim.candidate is not None and not shown >= set(claim.subjects)
            return False if lacks else at_target
        shown = {o.object for o in self.objects.values() if o.sight == "shown"}
        at_cut = _holds(relation, self.observed) if shown >= set(claim.subjects) else None
        return at_cut if claim.when == CUT else _either(at_cut, at_target)

    def _truth_in_candidate(self, letter: str, claim: Claim) -> bool | None:
        if letter not in self.candidates:
            return None
        if claim.kind == "agrees":
            agrees = self.candidates[letter].agrees
            # A wrong candidate may show the object of the claim as close to its place.
            distance = self._find_distance(letter, *claim.subjects[:1])
            is_close = distance is not None and describe_distance(distance) is None
            return None if is_close and not agrees else agrees
        if claim.kind == "other objects":
            return self.candidates[letter].other_objects
        differences = self.differences[letter]
        name = claim.subjects[0]
        if claim.kind == "region" and (region := self._find_region(letter, name)) is not None:
            difference = differences.get(name)
            # The differences leave out an object that is in another region only by a little, and
            # they have no region of an object that the target does not show.
            if claim.value == region or (difference and difference.kind == "extra"):
                return _same(claim.value, region)
        if claim.kind == "displaced" and claim.value in ("", *EXTENTS):
            extent = self._find_extent(letter, name)
            if extent is not None:
                # An object that is far off is also clearly off.
                return claim.value in ("", extent) or (claim.value, extent) == ("clearly", "far")
        return _shown(claim, self.objects.get(name), differences.get(name))

    def _find_extent(self, letter: str, name: str) -> str | None:
        """Return how far from its place at the target a candidate shows an object, in words; None
        if it shows the object there, or if the predicates do not tell."""
        distance = self._find_distance(letter, name)
        if distance is not None:
            extent = describe_distance(distance)
            if extent is not None:
                return extent
        # The largest difference of a candidate has an extent even if it is small.
        difference = self.differences[letter].get(name)
        return None if difference is None else difference.extent

    def _find_distance(self, letter: str, name: str | None = None) -> float | None:
        """Return the distance of an object in a candidate from its place at the target, as a share
        of the image; None if one of them does not show it, or if the predicates have no views."""
        views = [self.views[v] for v in (letter, self.answer) if v in self.views]
        places = [v.places.image[name] for v in views if name in v.places.image]
        return math.dist(*places) if len(places) == 2 else None

    def _find_region(self, letter: str, name: str) -> str | None:
        """Return the region where the view of a candidate shows an object; None if it does not show
        it, or if the predicates have no views or several objects of this name."""
        objects = self.views[letter].objects if letter in self.views else ()
        regions = [o.target_region for o in objects if o.object == name]
        return regions[0] if len(regions) == 1 else None

    def _truth_of_any(self, claim: Claim) -> bool | None:
        """Return False if the region of a claim is false of every object, as "the collision occurs
        near the top" if no object is there; otherwise None."""
        truths = {_region(o, claim.value, EITHER) for o in self.objects.values()}
        near = any(_same(claim.value, region) for region in self.close.values())
        return False if truths == {False} and not near else None


def _same(value: str, actual: str | None) -> bool | None:
    """Return whether a value is the actual one. A rough value may also be neither true nor false:
    "~west" for northwest and southwest, "~near the left" for its corners."""
    if actual is None:
        return None
    if not value.startswith(COARSE):
        return value == actual
    value = value[1:]
    if value in COMPASS:
        apart = abs(COMPASS.index(value) - COMPASS.index(actual))
        apart = min(apart, 8 - apart)
        return True if apart == 0 else None if apart == 1 else False
    if value == actual:
        return True
    side = value.removeprefix("near the ")
    return None if side in actual else False


def _holds(relation: Relation, statements: Collection[Relation]) -> bool | None:
    """Return whether a relation is among the statements of a frame; None if a stricter one is: what
    is right against an object is near it, too."""
    if relation in statements:
        return True
    stricter = relation._replace(value="against")
    return None if relation.value == "near" and stricter in statements else False


def _either(*found: bool | None) -> bool | None:
    return True if True in found else None if None in found else False


def _at(when: str, cut: str, target: str) -> tuple[str, ...]:
    """Return the values at the moment `when` of a claim."""
    return {CUT: (cut,), TARGET: (target,)}.get(when, (cut, target))


def _region(o: ObjectFacts, value: str, when: str) -> bool | None:
    return _either(*(_same(value, region) for region in _at(when, o.region, o.target_region)))


def _direction(o: ObjectFacts, value: str, when: str) -> bool | None:
    resting, staying = o.speed == "stationary", o.extent == "stays"
    heading = False if resting else _same(value, o.heading)
    travel = None if staying else _same(value, o.travel)
    if when == CUT:
        return heading
    if when == BETWEEN:
        return False if staying and resting else travel
    if resting and staying:
        return False
    # An object in place may still be heading somewhere; an object at rest may still be pushed.
    return _either(heading, False if staying else travel)


def _still(o: ObjectFacts, value: str, when: str) -> bool | None:
    resting = None if o.speed is None else o.speed == "stationary"
    staying = None if o.extent == "unseen" else o.extent == "stays"
    return resting if when == CUT else staying if when == BETWEEN else _either(resting, staying)


def _extent(o: ObjectFacts, value: str, when: str) -> bool | None:
    if o.extent == "unseen" or (value == COARSE and o.extent == "shifts slightly"):
        return None
    return o.extent == (value if value != COARSE else "stays")


def _sight(o: ObjectFacts, value: str, when: str) -> bool | None:
    sights = _at(when, o.sight, o.target_sight)
    return any(sight != "shown" if value == "unseen" else sight == value for sight in sights)


OBJECT_CHECKS: dict[str, Callable[[ObjectFacts, str, str], bool | None]] = {
    "region": _region,
    "direction": _direction,
    "speed": lambda o, value, when: _same(value, o.speed),
    "still": _still,
    "extent": _extent,
    "sight": _sight,
    "leaves": lambda o, value, when: None if when == CUT else o.leaves,
    "enters": lambda o, value, when: None if when == CUT else o.enters,
}
"""For each kind of claim about an object, the check of its value at its moment."""


def _has_pair(pairs: Iterable[frozenset[str]], claim: Claim) -> bool:
    """Return whether a pair contains the subjects of a claim, which may be one object or none."""
    return any(set(claim.subjects) <= pair for pair in pairs)


def _course(predicates: IndexedPredicates, claim: Claim) -> bool | None:
    if _has_pair(predicates.courses, claim):
        return True
    if claim.value == COARSE and _has_pair(predicates.contacts, claim):
        # "Headed for contact" also describes a pair that meets without a collision course.
        return True if claim.affirmed else None
    # The predicates have no courses of an object that is hit at the cut, which has no heading.
    facts = [predicates.objects[name] for name in claim.subjects if name in predicates.objects]
    is_hit = any(o.heading is None and o.speed not in (None, "stationary") for o in facts)
    return None if is_hit else False


def _meeting(predicates: IndexedPredicates, claim: Claim) -> bool | None:
    if claim.when == CUT and predicates.is_observed("gap", claim.subjects, "against"):
        # "The red cube touches the sphere" at the end of the observation.
        return True
    if not claim.affirmed and claim.when != BETWEEN:
        # "They have not met yet" does not exclude later meetings.
        return None if claim.when == CUT else _has_pair(predicates.contacts, claim)
    met = [when for pair, when in predicates.courses.items() if set(claim.subjects) <= pair]
    if _has_pair(predicates.contacts, claim) or any(when not in (None, "unseen") for when in met):
        return True
    return None if "unseen" in met or _has_pair(predicates.later, claim) else False


def _time(predicates: IndexedPredicates, claim: Claim) -> bool | None:
    pair = frozenset(claim.subjects)
    when = predicates.contacts.get(pair) or predicates.courses.get(pair)
    # What is imminent comes soon, too.
    is_wide = when == "imminent" and claim.value == "soon"
    return None if when in (None, "unseen") or is_wide else when == claim.value


def _close(predicates: IndexedPredicates, claim: Claim) -> bool | None:
    if claim.when != TARGET:
        return None
    if any(predicates.objects[name].target_sight == OUT_OF_VIEW for name in claim.subjects):
        return None if claim.value == COARSE else False
    return frozenset(claim.subjects) in predicates.close


def _close_region(predicates: IndexedPredicates, claim: Claim) -> bool | None:
    region = predicates.close.get(frozenset(claim.subjects))
    return None if claim.when != TARGET else _same(claim.value, region)


def _place_of_either(predicates: IndexedPredicates, claim: Claim) -> bool | None:
    region = predicates.close.get(frozenset(claim.subjects))
    partner = predicates.objects[claim.subjects[-1]]
    return _either(_same(claim.value, region), _region(partner, claim.value, EITHER))


PAIR_CHECKS: dict[str, Callable[[IndexedPredicates, Claim], bool | None]] = {
    "course": _course,
    "meeting": _meeting,
    "time": _time,
    "close": _close,
    "close region": _close_region,
    "place of either": _place_of_either,
}
"""The check of each kind of claim about a pair."""


def _shown(claim: Claim, facts: ObjectFacts | None, difference: Difference | None) -> bool | None:
    """Return whether a claim about an object in a candidate holds.

    Args:
        facts: The object in the scene, if it is there.
        difference: How the candidate shows it differently from the target, if it does.
    """
    kind = None if difference is None else difference.kind
    if claim.kind == "extra":
        return kind == "extra"
    if claim.kind == "lacks":
        if facts is None:
            return None
        return facts.target_sight != "shown" if kind is None else kind == "missing"
    if claim.kind == "region":
        if kind in (None, "displaced"):
            return None if facts is None else _same(claim.value, facts.target_region)
        if kind == "region":
            return _same(claim.value, difference.region)
        return None if kind == "extra" else False
    if kind in (None, "missing"):
        return False
    if kind != "displaced":
        return None
    return _same(claim.value, difference.heading) if claim.value else True
