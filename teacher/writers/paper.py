"""Writes the sections of a rationale with templates, in the words of the paper's predicates."""

from __future__ import annotations

import hashlib
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
import yaml

from dynapix.teacher.predicates.facts import (
    OUT_OF_VIEW,
    CandidateFacts,
    Difference,
    Facts,
    Meeting,
    ObjectFacts,
    Predicates,
)

PHRASES = yaml.safe_load((files("dynapix.teacher") / "templates" / "phrases.yaml").read_text())


class Detail(NamedTuple):
    """What a text mentions: maximum numbers of objects and pairs in its sections."""

    parsed: int
    """Objects in the scene parse."""
    analysed: int
    """Moving objects in the motion analysis."""
    predicted: int
    """Objects in the prediction."""
    pairs: int
    """Pairs of objects in each section."""
    relations: int = 1
    """Relations in the scene parse, and changes of relations in the motion analysis."""
    compared: int = 2
    """What the candidate analysis of a relational text says of a candidate: what it shows in the
    respects of all deciding statements (2); of a distractor only what excludes it (1); and of the
    target only the first statement (0)."""


def most_discriminative_object(predicates: Predicates) -> ObjectFacts:
    """Return the object that distinguishes the most wrong candidates from the target: the object is
    in another region there, or missing.

    Of tied objects, the most relevant one is returned (see `rank_objects`). The candidate analysis
    says where each candidate shows this object before it judges the candidate.
    """
    wrong = [c.differences for c in predicates.candidates if not c.agrees]

    def count_distinguished(o: ObjectFacts) -> int:
        return sum(
            any(d.object == o.object and d.kind in ("region", "missing") for d in differences)
            for differences in wrong
        )

    ranked = rank_objects(predicates)
    visible = [o for o in ranked if o.target_sight == "shown"]
    return max(visible or ranked, key=count_distinguished)


def join_sentences(parts: list[str]) -> str:
    return " ".join(s[0].upper() + s[1:] + "." for s in parts)


def name_pair(objects: tuple[str, str]) -> str:
    return f"the {objects[0]} and the {objects[1]}"


def unseen_phrase(name: str, verb: str, sight: str, region: str) -> str:
    return f"the {name} {verb} {sight}" + (f" {region}" if sight != OUT_OF_VIEW else "")


def toward_phrase(heading: str | None) -> str:
    return f" toward the {heading}" if heading else ""


def rank_objects(facts: Facts) -> list[ObjectFacts]:
    """Sort objects by relevance: first those that collide or may collide, then moving ones."""
    met = {name for m in (*facts.courses, *facts.contacts) for name in m.objects}
    return sorted(
        facts.objects,
        key=lambda o: (o.object not in met, o.extent == "stays", o.speed in (None, "stationary")),
    )


class Writer:
    """Writes the sections of a text.

    Args:
        facts: Content of the text.
        detail: How many objects and pairs each section mentions.
        keys: Seed of the random choice of phrasings.
        padded: Whether to lengthen the text by two sentences that hold for every scene.
    """

    def __init__(
        self, facts: Predicates, detail: Detail, *keys: int | str, padded: bool = False
    ) -> None:
        digest = hashlib.sha256(repr(keys).encode()).digest()
        self.rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
        self.facts, self.detail, self.padded = facts, detail, padded
        self.ranked = rank_objects(facts)
        self.target_regions = {o.object: o.target_region for o in facts.objects}
        self.key = most_discriminative_object(facts)

    def say(self, statement: str, **values: Any) -> str:
        """Fill a random phrasing of a statement with values."""
        phrasings = PHRASES[statement]
        return phrasings[self.rng.integers(len(phrasings))].format(**values)

    def text(self) -> str:
        """Return the rationale: a line for each section, and the answer."""
        lines = [f"{name}: {join_sentences(parts)}" for name, parts in self.sections().items()]
        return "\n".join([*lines, f"Answer: {self.facts.answer}"])

    def sections(self) -> dict[str, list[str]]:
        """Return the clauses of each section."""
        return {
            "Scene parse": self.scene_parse(),
            "Motion analysis": self.motion_analysis(),
            "Prediction": self.prediction(),
            "Candidate analysis": [
                f"candidate {c.letter} {self.judgement(c)}" for c in self.facts.candidates
            ],
            "Outcome": self.outcome(),
        }

    def scene_parse(self) -> list[str]:
        parts = [self.observed(o) for o in self.order(self.ranked[: self.detail.parsed])]
        parts[0] = f"{self.facts.instant}, {parts[0]}"
        courses = self.facts.courses[: self.detail.pairs]
        parts += [f"{name_pair(course.objects)} are on a collision course" for course in courses]
        if courses or not self.facts.records_contacts:
            return parts
        return [*parts, self.say("no_course")]

    def order(self, objects: list[ObjectFacts]) -> list[ObjectFacts]:
        """Return objects in the order in which a section mentions them."""
        return objects

    def observed(self, o: ObjectFacts) -> str:
        if o.sight != "shown":
            return unseen_phrase(o.object, "is", o.sight, o.region)
        statement = "rests" if o.speed == "stationary" else "moves"
        return self.say(statement, o=o, toward=toward_phrase(o.heading))

    def motion_analysis(self) -> list[str]:
        facts, ranked = self.facts, self.ranked
        parts = [self.meeting(m) for m in facts.courses[: self.detail.pairs] if m.when != "unseen"]
        on_course = {frozenset(m.objects) for m in facts.courses}
        for contact in facts.contacts[: self.detail.pairs]:
            if frozenset(contact.objects) not in on_course:
                parts.append(f"{name_pair(contact.objects)} will also meet")
        parts += [f"the {one} is heavier than the {other}" for one, other in facts.heavier]
        still = ("stays", "unseen")
        movers = [o for o in ranked if o.extent not in still or o.enters or o.leaves]
        struck = {name for m in facts.contacts for name in m.objects}
        moving = self.order(movers[: self.detail.analysed])
        parts += [self.travel(o, o.object in struck) for o in moving]
        if not movers:
            parts.append(self.say("all_stay"))
        elif any(o.extent == "stays" for o in ranked) and len(movers) <= self.detail.analysed:
            parts.append(self.say("others_stay"))
        if self.padded and facts.records_contacts:
            parts.append("an object keeps its heading until contact turns it or it comes to rest")
        return parts

    def meeting(self, meeting: Meeting) -> str:
        statement = {None: "never_meet", "imminent": "meet_at_once"}.get(meeting.when, "meet")
        return self.say(statement, pair=name_pair(meeting.objects), when=meeting.when)

    def travel(self, o: ObjectFacts, struck: bool) -> str:
        if o.leaves:
            statement = "leaves"
        elif o.enters:
            statement = "enters"
        elif struck and o.speed == "stationary":
            statement = "changes_once_struck"
        else:
            statement = "changes"
        return self.say(statement, o=o, toward=toward_phrase(o.travel))

    def prediction(self) -> list[str]:
        parts = self.predicted()
        parts[0] = f"{self.facts.moment}, {parts[0]}"
        if self.padded:
            parts.append("the layout at the target moment follows from these motions")
        return parts

    def predicted(self) -> list[str]:
        """Return what is said of the target moment; one clause at least."""
        close = self.facts.close[: self.detail.pairs]
        parts = [f"{name_pair(c.objects)} will be very close {c.region}" for c in close]
        key_first = sorted(self.ranked, key=lambda o: o is not self.key)
        return parts + [self.expected(o) for o in key_first[: self.detail.predicted]]

    def expected(self, o: ObjectFacts) -> str:
        if o.target_sight != "shown":
            return unseen_phrase(o.object, "will be", o.target_sight, o.target_region)
        remains = o.extent == "stays" and o.region == o.target_region
        return self.say("remains" if remains else "will_be", o=o)

    def judgement(self, candidate: CandidateFacts) -> str:
        """State where a candidate shows the key object, and whether the candidate agrees."""
        if candidate.agrees:
            return self.say("agrees", key=self.key)
        d = {d.object: d for d in candidate.differences}.get(self.key.object)
        if d is None:
            why = self.difference(candidate.differences[0])
            text = self.say("key_as_expected", key=self.key, why=why)
        else:
            text = self.say(f"key_{d.kind}", key=self.key, d=d, toward=toward_phrase(d.heading))
        return text + ", and shows other objects" * candidate.other_objects

    def match(self, candidate: CandidateFacts) -> str:
        name = f"Candidate {candidate.letter}"
        if candidate.agrees:
            return f"{name} matches: every object is where it should be."
        first = min(candidate.differences, key=lambda d: d.object != self.key.object)
        why = ["shows other objects"] * candidate.other_objects
        why.append(self.difference(first))
        return f"{name} does not match: it {' and '.join(why)}."

    def difference(self, d: Difference) -> str:
        without_heading = d.kind == "displaced" and not d.heading
        statement = "displaced_without_heading" if without_heading else d.kind
        expected = self.target_regions.get(d.object)
        return self.say(statement, d=d, expected=expected, toward=toward_phrase(d.heading))

    def outcome(self) -> list[str]:
        close = self.facts.close[:1]
        parts = [f"{name_pair(c.objects)} are very close {c.region}" for c in close]
        visible = [o for o in self.ranked if o.target_sight == "shown"]
        parts += [f"the {o.object} is {o.target_region}" for o in visible[: 2 - len(parts)]]
        return [*parts, self.say("answer", answer=self.facts.answer)]
