"""The built-in narrator: predicates become varied prose without a model.

Every statement has a few phrasings over a small vocabulary, so that a small student can learn it.
"""

from __future__ import annotations

import hashlib

import numpy as np

from data.records import Scene, SelectionItem
from teacher.predicates import (
    OUT_OF_VIEW,
    CandidateFacts,
    Difference,
    Facts,
    Meeting,
    ObjectFacts,
    Predicates,
    extract_facts,
)

NARRATOR_VERSION = "5"
ENOUGH, ROOM = 110, 250
"""Words under which a rationale is told in full, well above the 80 that it needs, and over which it
is told in brief (paper, Rationale construction)."""
BRIEF, SPARSE, FULL = (3, 1, 1, 1), (4, 1, 2, 1), (6, 4, 6, 2)
"""Objects parsed, movers analysed, objects predicted and pairs of each kind that are named: in a
rationale, where four candidates take the room, and else."""


def write_rationale(
    predicates: Predicates, item: SelectionItem, seed: int, attempt: int = 0
) -> str:
    """A rationale of 80 to 250 words; the same arguments give the same text."""
    text = _Voice(SPARSE, seed, item.item_id, attempt).rationale(predicates)
    if len(text.split()) > ROOM:
        text = _Voice(BRIEF, seed, item.item_id, attempt).rationale(predicates)
    if len(text.split()) < ENOUGH:
        text = _Voice(FULL, seed, item.item_id, attempt, padded=True).rationale(predicates)
    return text


def write_description(scene: Scene, start: int, stop: int, target: int, seed: int) -> str | None:
    """What happens between the prefix [start, stop] and the target frame, without candidates;
    None if the prefix is too short to tell."""
    facts = extract_facts(scene, start, stop, target)
    if facts is None:
        return None
    return _Voice(FULL, seed, scene.scene_id, start, stop, target).description(facts)


def write_match_lines(predicates: Predicates, item: SelectionItem) -> tuple[str, ...]:
    """Whether each candidate matches the predicted state and why, a line a candidate; the same
    arguments give the same lines."""
    voice, key = _Voice(SPARSE, item.item_id, "matches"), most_discriminative_object(predicates)
    expected = {o.object: o.target_region for o in predicates.objects}
    return tuple(voice.match(c, key, expected) for c in predicates.candidates)


def most_discriminative_object(predicates: Predicates) -> ObjectFacts:
    """The object by whose place most candidates are told from the target; of several the first
    that the prediction is about. All candidates are compared by it, so that each is described
    before it is judged."""
    wrong = [c.differences for c in predicates.candidates if not c.agrees]

    def told_apart(o: ObjectFacts) -> int:
        return sum(
            any(d.object == o.object and d.kind in ("region", "missing") for d in differences)
            for differences in wrong
        )

    ranked = sorted(predicates.objects, key=lambda o: _rank(predicates, o))
    return max([o for o in ranked if o.target_sight == "shown"] or ranked, key=told_apart)


def _sentences(statements: list[str]) -> str:
    return " ".join(s[0].upper() + s[1:] + "." for s in statements)


def _pair(objects: tuple[str, str]) -> str:
    return f"the {objects[0]} and the {objects[1]}"


def _rank(facts: Facts, o: ObjectFacts) -> tuple[bool, bool, bool]:
    met = any(o.object in m.objects for m in (*facts.courses, *facts.contacts))
    return (not met, o.extent == "stays", o.speed in (None, "stationary"))


class _Voice:
    """A narrator whose choices of phrasing follow from `keys` alone."""

    def __init__(
        self, detail: tuple[int, int, int, int], *keys: int | str, padded: bool = False
    ) -> None:
        digest = hashlib.sha256(repr(keys).encode()).digest()
        self.rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
        self.parsed, self.analysed, self.predicted, self.pairs = detail
        self.padded = padded

    def pick(self, *options: str) -> str:
        return options[self.rng.integers(len(options))]

    def rationale(self, predicates: Predicates) -> str:
        key = most_discriminative_object(predicates)
        return "\n".join(
            [
                *self.opening(predicates, key),
                f"Candidate analysis: {_sentences(self.candidates(predicates, key))}",
                f"Outcome: {_sentences(self.outcome(predicates, predicates.answer))}",
                f"Answer: {predicates.answer}",
            ]
        )

    def description(self, facts: Facts) -> str:
        return "\n".join(
            [*self.opening(facts), f"Outcome: {_sentences(self.outcome(facts, None))}"]
        )

    def opening(self, facts: Facts, key: ObjectFacts | None = None) -> list[str]:
        """All before the candidates, whose `key` object is predicted first."""
        ranked = sorted(facts.objects, key=lambda o: _rank(facts, o))
        predicted = sorted(ranked, key=lambda o: o is not key) if key else ranked
        return [
            f"Scene parse: {_sentences(self.parse(facts, ranked))}",
            f"Motion analysis: {_sentences(self.motion(facts, ranked))}",
            f"Prediction: {_sentences(self.prediction(facts, predicted))}",
        ]

    def parse(self, facts: Facts, ranked: list[ObjectFacts]) -> list[str]:
        told = [self.seen(o) for o in ranked[: self.parsed]]
        told[0] = f"{facts.instant}, {told[0]}"
        if not facts.courses:
            free = self.pick("no pair is on a collision course", "no pair is heading for contact")
            return [*told, free]
        for course in facts.courses[: self.pairs]:
            told.append(f"{_pair(course.objects)} are on a collision course")
        return told

    def seen(self, o: ObjectFacts) -> str:
        if o.sight == OUT_OF_VIEW:
            return f"the {o.object} is out of view"
        if o.sight == "hidden":
            return f"the {o.object} is hidden {o.region}"
        if o.speed == "stationary":
            return self.pick(
                f"the {o.object} is stationary {o.region}",
                f"the {o.object} rests {o.region}",
                f"the {o.object} is {o.region} and does not move",
            )
        way = f" toward the {o.heading}" if o.heading else ""
        return self.pick(
            f"the {o.object} is {o.region}, moving {o.speed}{way}",
            f"the {o.object} is {o.region} and moves {o.speed}{way}",
            f"the {o.object} {o.region} is moving {o.speed}{way}",
        )

    def motion(self, facts: Facts, ranked: list[ObjectFacts]) -> list[str]:
        told = [self.meeting(m) for m in facts.courses[: self.pairs] if m.when != "unseen"]
        on_course = {frozenset(m.objects) for m in facts.courses}
        for contact in facts.contacts[: self.pairs]:
            if frozenset(contact.objects) not in on_course:
                told.append(f"{_pair(contact.objects)} will also meet")
        still = ("stays", "unseen")
        movers = [o for o in ranked if o.extent not in still or o.enters or o.leaves]
        struck = {name for m in facts.contacts for name in m.objects}
        told += [self.travel(o, o.object in struck) for o in movers[: self.analysed]]
        if not movers:
            told.append("the objects remain where they are")
        elif any(o.extent == "stays" for o in ranked) and len(movers) <= self.analysed:
            told.append(
                self.pick(
                    "the other objects remain where they are",
                    "the other objects hardly move",
                    "the rest of the scene stays as it is",
                )
            )
        elif any(o.extent == "stays" and o.speed == "stationary" for o in ranked):
            told.append("the stationary objects remain where they are unless struck")
        if self.padded:
            told.append("an object keeps its heading until contact turns it or it comes to rest")
        return told

    def meeting(self, meeting: Meeting) -> str:
        pair = _pair(meeting.objects)
        if meeting.when is None:
            return self.pick(f"{pair} will pass without contact", f"{pair} will not meet")
        if meeting.when == "imminent":
            return self.pick(f"contact between {pair} is imminent", f"{pair} are about to meet")
        return self.pick(
            f"{pair} will meet {meeting.when}", f"contact between {pair} comes {meeting.when}"
        )

    def travel(self, o: ObjectFacts, struck: bool) -> str:
        if o.leaves:
            return self.pick(f"the {o.object} leaves the view", f"the {o.object} moves out of view")
        if o.enters:
            return f"the {o.object} enters the view {o.target_region}"
        way = f" toward the {o.travel}" if o.travel else ""
        if o.speed in (None, "stationary"):
            cause = "once struck, " if struck and o.speed else ""
        else:
            cause = self.pick("", f"moving {o.speed}, ", "given its speed, ")
        return f"{cause}the {o.object} {o.extent}{way}"

    def prediction(self, facts: Facts, ranked: list[ObjectFacts]) -> list[str]:
        told = [
            f"{_pair(c.objects)} will be very close {c.region}" for c in facts.close[: self.pairs]
        ]
        told += [self.expected(o) for o in ranked[: self.predicted]]
        told[0] = f"{facts.moment}, {told[0]}"
        if self.padded:
            told.append("the layout at the target moment follows from these motions")
        return told

    def expected(self, o: ObjectFacts) -> str:
        if o.target_sight == OUT_OF_VIEW:
            return f"the {o.object} will be out of view"
        if o.target_sight == "hidden":
            return f"the {o.object} will be hidden {o.target_region}"
        if o.extent == "stays" and o.region == o.target_region:
            return self.pick(
                f"the {o.object} remains {o.target_region}",
                f"the {o.object} stays {o.target_region}",
            )
        return self.pick(
            f"the {o.object} will be {o.target_region}",
            f"the {o.object} should be {o.target_region}",
        )

    def candidates(self, predicates: Predicates, key: ObjectFacts) -> list[str]:
        expected = {o.object: o.target_region for o in predicates.objects}
        return [self.candidate(c, key, expected) for c in predicates.candidates]

    def candidate(
        self, candidate: CandidateFacts, key: ObjectFacts, expected: dict[str, str]
    ) -> str:
        """Where a candidate shows the `key` object, and then whether it agrees."""
        name, shown = f"candidate {candidate.letter}", f"shows the {key.object}"
        if candidate.agrees:
            end = self.pick("", " with the prediction")
            return f"{name} {shown} {key.target_region} and agrees{end}"
        others = ", and shows other objects" * candidate.other_objects
        differs = {d.object: d for d in candidate.differences}.get(key.object)
        if differs is None:
            why = self.difference(candidate.differences[0], expected)
            return f"{name} {shown} {key.target_region} but {why}{others}"
        if differs.kind == "displaced":
            way = f" toward the {differs.heading}" if differs.heading else ""
            return f"{name} {shown} {key.target_region} but {differs.extent} off{way}{others}"
        if differs.kind == "missing":
            return f"{name} lacks the {key.object}{others}"
        return f"{name} {shown} {differs.region}, not {key.target_region}{others}"

    def match(self, candidate: CandidateFacts, key: ObjectFacts, expected: dict[str, str]) -> str:
        name = f"Candidate {candidate.letter}"
        if candidate.agrees:
            return f"{name} matches: every object is where it should be."
        first = min(candidate.differences, key=lambda d: d.object != key.object)
        why = ["shows other objects"] * candidate.other_objects
        why.append(self.difference(first, expected))
        return f"{name} does not match: it {' and '.join(why)}."

    def difference(self, d: Difference, expected: dict[str, str]) -> str:
        if d.kind == "missing":
            return self.pick(f"does not show the {d.object}", f"lacks the {d.object}")
        if d.kind == "extra":
            return self.pick(
                f"shows the {d.object}, which should not be seen",
                f"shows the {d.object} by mistake",
            )
        if d.kind == "region":
            return self.pick(
                f"shows the {d.object} {d.region}, not {expected[d.object]}",
                f"has the {d.object} {d.region} and not {expected[d.object]}",
            )
        way = f" toward the {d.heading}" if d.heading else ""
        return self.pick(
            f"has the {d.object} {d.extent} off{way}",
            f"shows the {d.object} {d.extent} too far{way}" if way else f"has the {d.object} off",
        )

    def outcome(self, facts: Facts, letter: str | None) -> list[str]:
        told = [f"{_pair(c.objects)} are very close {c.region}" for c in facts.close[:1]]
        ranked = sorted(facts.objects, key=lambda o: _rank(facts, o))
        shown = [o for o in ranked if o.target_sight == "shown"]
        told += [f"the {o.object} is {o.target_region}" for o in shown[: 2 - len(told)]]
        if letter is not None:
            told.append(
                self.pick(
                    f"candidate {letter} shows this layout",
                    f"this layout is that of candidate {letter}",
                    f"only candidate {letter} agrees",
                )
            )
        return told or ["no object is in view"]
