"""The built-in narrator: writes rationales from predicates with templates, without a model.

Each statement has a few phrasings (templates/phrases.yaml). Their vocabulary is small, so that a
small student can learn it.
"""

from __future__ import annotations

import hashlib
from importlib.resources import files
from typing import Any, NamedTuple

import numpy as np
import yaml

from data.records import Scene, SelectionItem
from teacher.predicates.extraction import extract_facts
from teacher.predicates.facts import (
    OUT_OF_VIEW,
    CandidateFacts,
    Difference,
    Facts,
    Meeting,
    ObjectFacts,
    Predicates,
)

PHRASES = yaml.safe_load((files("teacher") / "templates" / "phrases.yaml").read_text())
NARRATOR_VERSION = "5"
SHORT, LONG = 110, 250
"""A rationale with more than LONG words is written again with less detail, one of fewer than SHORT
words with more. SHORT is well above the minimum, 80 words (paper, Rationale construction)."""


class Detail(NamedTuple):
    """Maximum numbers of objects and pairs that the sections of a text mention."""

    parsed: int
    """Objects in the scene parse."""
    analysed: int
    """Moving objects in the motion analysis."""
    predicted: int
    """Objects in the prediction."""
    pairs: int
    """Pairs of objects in each section."""


BRIEF, SPARSE, FULL = Detail(3, 1, 1, 1), Detail(4, 1, 2, 1), Detail(6, 4, 6, 2)


def write_rationale(
    predicates: Predicates, item: SelectionItem, seed: int, attempt: int = 0
) -> str:
    """Return a rationale of 80 to 250 words.

    The same arguments give the same text. Another `attempt` chooses other phrasings.
    """
    keys = (seed, item.item_id, attempt)
    text = _Writer(predicates, SPARSE, *keys).text()
    if len(text.split()) > LONG:
        text = _Writer(predicates, BRIEF, *keys).text()
    if len(text.split()) < SHORT:
        text = _Writer(predicates, FULL, *keys, padded=True).text()
    return text


def write_description(scene: Scene, start: int, stop: int, target: int, seed: int) -> str | None:
    """Describe what happens from the end of the prefix [start, stop] to the target frame.

    The description mentions no candidates. Returns None if the prefix is too short.
    """
    facts = extract_facts(scene, start, stop, target)
    if facts is None:
        return None
    return _Writer(facts, FULL, seed, scene.scene_id, start, stop, target).text()


def write_match_lines(predicates: Predicates, item: SelectionItem) -> tuple[str, ...]:
    """Return a line for each candidate: whether it matches the prediction, and if not, why.

    The same arguments give the same lines.
    """
    writer = _Writer(predicates, SPARSE, item.item_id, "matches")
    return tuple(writer.match(c) for c in predicates.candidates)


def most_discriminative_object(predicates: Predicates) -> ObjectFacts:
    """Return the object that distinguishes the most wrong candidates from the target: the object is
    in another region there, or missing.

    Of tied objects, the most relevant one is returned (see `_rank_objects`). The candidate analysis
    says where each candidate shows this object before it judges the candidate.
    """
    wrong = [c.differences for c in predicates.candidates if not c.agrees]

    def count_distinguished(o: ObjectFacts) -> int:
        return sum(
            any(d.object == o.object and d.kind in ("region", "missing") for d in differences)
            for differences in wrong
        )

    ranked = _rank_objects(predicates)
    visible = [o for o in ranked if o.target_sight == "shown"]
    return max(visible or ranked, key=count_distinguished)


def _sentences(parts: list[str]) -> str:
    return " ".join(s[0].upper() + s[1:] + "." for s in parts)


def _pair(objects: tuple[str, str]) -> str:
    return f"the {objects[0]} and the {objects[1]}"


def _unseen(name: str, verb: str, sight: str, region: str) -> str:
    return f"the {name} {verb} {sight}" + (f" {region}" if sight != OUT_OF_VIEW else "")


def _toward(heading: str | None) -> str:
    return f" toward the {heading}" if heading else ""


def _rank_objects(facts: Facts) -> list[ObjectFacts]:
    """Sort objects by relevance: first those that collide or may collide, then moving ones."""
    met = {name for m in (*facts.courses, *facts.contacts) for name in m.objects}
    return sorted(
        facts.objects,
        key=lambda o: (o.object not in met, o.extent == "stays", o.speed in (None, "stationary")),
    )


class _Writer:
    """Writes the sections of a text.

    Args:
        facts: Content of the text. Predicates add the candidate analysis and the answer.
        detail: How many objects and pairs each section mentions.
        keys: Seed of the random choice of phrasings.
        padded: Whether to lengthen the text by two sentences that hold for every scene.
    """

    def __init__(
        self, facts: Facts, detail: Detail, *keys: int | str, padded: bool = False
    ) -> None:
        digest = hashlib.sha256(repr(keys).encode()).digest()
        self.rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
        self.facts, self.detail, self.padded = facts, detail, padded
        self.ranked = _rank_objects(facts)
        self.target_regions = {o.object: o.target_region for o in facts.objects}
        self.key = most_discriminative_object(facts) if isinstance(facts, Predicates) else None

    def say(self, statement: str, **values: Any) -> str:
        """Fill a random phrasing of a statement with values."""
        phrasings = PHRASES[statement]
        return phrasings[self.rng.integers(len(phrasings))].format(**values)

    def text(self) -> str:
        """Return a rationale from predicates, or a description from facts without candidates."""
        facts, answer = self.facts, None
        sections = {
            "Scene parse": self.scene_parse(),
            "Motion analysis": self.motion_analysis(),
            "Prediction": self.prediction(),
        }
        if isinstance(facts, Predicates):
            answer = facts.answer
            sections["Candidate analysis"] = [
                f"candidate {c.letter} {self.judgement(c)}" for c in facts.candidates
            ]
        sections["Outcome"] = self.outcome(answer)
        lines = [f"{name}: {_sentences(parts)}" for name, parts in sections.items()]
        return "\n".join([*lines, f"Answer: {answer}"] if answer else lines)

    def scene_parse(self) -> list[str]:
        parts = [self.observed(o) for o in self.ranked[: self.detail.parsed]]
        parts[0] = f"{self.facts.instant}, {parts[0]}"
        courses = self.facts.courses[: self.detail.pairs]
        parts += [f"{_pair(course.objects)} are on a collision course" for course in courses]
        return parts if courses else [*parts, self.say("no_course")]

    def observed(self, o: ObjectFacts) -> str:
        if o.sight != "shown":
            return _unseen(o.object, "is", o.sight, o.region)
        statement = "rests" if o.speed == "stationary" else "moves"
        return self.say(statement, o=o, toward=_toward(o.heading))

    def motion_analysis(self) -> list[str]:
        facts, ranked = self.facts, self.ranked
        parts = [self.meeting(m) for m in facts.courses[: self.detail.pairs] if m.when != "unseen"]
        on_course = {frozenset(m.objects) for m in facts.courses}
        for contact in facts.contacts[: self.detail.pairs]:
            if frozenset(contact.objects) not in on_course:
                parts.append(f"{_pair(contact.objects)} will also meet")
        still = ("stays", "unseen")
        movers = [o for o in ranked if o.extent not in still or o.enters or o.leaves]
        struck = {name for m in facts.contacts for name in m.objects}
        parts += [self.travel(o, o.object in struck) for o in movers[: self.detail.analysed]]
        if not movers:
            parts.append("the objects remain where they are")
        elif any(o.extent == "stays" for o in ranked) and len(movers) <= self.detail.analysed:
            parts.append(self.say("others_stay"))
        elif any(o.extent == "stays" and o.speed == "stationary" for o in ranked):
            parts.append("the stationary objects remain where they are unless struck")
        if self.padded:
            parts.append("an object keeps its heading until contact turns it or it comes to rest")
        return parts

    def meeting(self, meeting: Meeting) -> str:
        statement = {None: "never_meet", "imminent": "meet_at_once"}.get(meeting.when, "meet")
        return self.say(statement, pair=_pair(meeting.objects), when=meeting.when)

    def travel(self, o: ObjectFacts, struck: bool) -> str:
        if o.leaves:
            statement = "leaves"
        elif o.enters:
            statement = "enters"
        elif o.speed not in (None, "stationary"):
            statement = "travels"
        else:
            statement = "changes_once_struck" if struck and o.speed else "changes"
        return self.say(statement, o=o, toward=_toward(o.travel))

    def prediction(self) -> list[str]:
        close = self.facts.close[: self.detail.pairs]
        parts = [f"{_pair(c.objects)} will be very close {c.region}" for c in close]
        key_first = sorted(self.ranked, key=lambda o: self.key is not None and o is not self.key)
        parts += [self.expected(o) for o in key_first[: self.detail.predicted]]
        parts[0] = f"{self.facts.moment}, {parts[0]}"
        if self.padded:
            parts.append("the layout at the target moment follows from these motions")
        return parts

    def expected(self, o: ObjectFacts) -> str:
        if o.target_sight != "shown":
            return _unseen(o.object, "will be", o.target_sight, o.target_region)
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
            text = self.say(f"key_{d.kind}", key=self.key, d=d, toward=_toward(d.heading))
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
        return self.say(statement, d=d, expected=expected, toward=_toward(d.heading))

    def outcome(self, answer: str | None) -> list[str]:
        close = self.facts.close[:1]
        parts = [f"{_pair(c.objects)} are very close {c.region}" for c in close]
        visible = [o for o in self.ranked if o.target_sight == "shown"]
        parts += [f"the {o.object} is {o.target_region}" for o in visible[: 2 - len(parts)]]
        if answer is not None:
            parts.append(self.say("answer", answer=answer))
        return parts or ["no object is in view"]
