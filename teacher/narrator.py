"""Built-in narrator: writes rationales from predicates with templates, without a model.

Each statement has a few phrasings over a small vocabulary, so that a small student can learn it.
"""

from __future__ import annotations

import hashlib
from typing import NamedTuple

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
FEW_WORDS, MOST_WORDS = 110, 250
"""A rationale of fewer words is rewritten in full detail, one of more words in brief. The lower
bound is well above the minimum length, 80 words (paper, Rationale construction)."""


class Detail(NamedTuple):
    """The highest numbers of objects and pairs that the parts of a text name.

    Attributes:
        parsed: Objects in the scene parse.
        analysed: Moving objects in the motion analysis.
        predicted: Objects in the prediction.
        pairs: Pairs of objects in each part.
    """

    parsed: int
    analysed: int
    predicted: int
    pairs: int


BRIEF, SPARSE, FULL = Detail(3, 1, 1, 1), Detail(4, 1, 2, 1), Detail(6, 4, 6, 2)


def write_rationale(
    predicates: Predicates, item: SelectionItem, seed: int, attempt: int = 0
) -> str:
    """Return a rationale of 80 to 250 words.

    The same arguments give the same text; another `attempt` gives another choice of phrasings.
    """
    keys = (seed, item.item_id, attempt)
    text = _Writer(predicates, SPARSE, *keys).text()
    if len(text.split()) > MOST_WORDS:
        text = _Writer(predicates, BRIEF, *keys).text()
    if len(text.split()) < FEW_WORDS:
        text = _Writer(predicates, FULL, *keys, padded=True).text()
    return text


def write_description(scene: Scene, start: int, stop: int, target: int, seed: int) -> str | None:
    """Describe what happens between the prefix [start, stop] and the target frame.

    The description mentions no candidates. Returns None if the prefix is too short.
    """
    facts = extract_facts(scene, start, stop, target)
    if facts is None:
        return None
    return _Writer(facts, FULL, seed, scene.scene_id, start, stop, target).text()


def write_match_lines(predicates: Predicates, item: SelectionItem) -> tuple[str, ...]:
    """Return one line per candidate that says whether it matches the prediction, and why.

    The same arguments give the same lines.
    """
    writer = _Writer(predicates, SPARSE, item.item_id, "matches")
    return tuple(writer.match(c) for c in predicates.candidates)


def most_discriminative_object(predicates: Predicates) -> ObjectFacts:
    """Return the object whose place distinguishes the largest number of wrong candidates.

    Of tied objects, the first in order of relevance is returned. The candidate analysis states the
    place of this object in every candidate before it judges the candidate.
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
    """Return the objects in order of relevance: first those of a `Meeting`, then moving ones."""
    met = {name for m in (*facts.courses, *facts.contacts) for name in m.objects}
    return sorted(
        facts.objects,
        key=lambda o: (o.object not in met, o.extent == "stays", o.speed in (None, "stationary")),
    )


class _Writer:
    """Writes the parts of a text.

    Args:
        facts: What to write about; a text about predicates analyses their candidates.
        detail: How many objects and pairs each part names.
        keys: Seed of the random choices of phrasing.
        padded: Whether to add two general sentences that lengthen a short text.
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

    def pick(self, *options: str) -> str:
        return options[self.rng.integers(len(options))]

    def text(self) -> str:
        """Return a rationale of predicates, or a description of facts without candidates."""
        facts, answer = self.facts, None
        sections = {
            "Scene parse": self.parse(),
            "Motion analysis": self.motion(),
            "Prediction": self.prediction(),
        }
        if isinstance(facts, Predicates):
            answer = facts.answer
            sections["Candidate analysis"] = [self.candidate(c) for c in facts.candidates]
        sections["Outcome"] = self.outcome(answer)
        lines = [f"{name}: {_sentences(parts)}" for name, parts in sections.items()]
        return "\n".join([*lines, f"Answer: {answer}"] if answer else lines)

    def parse(self) -> list[str]:
        parts = [self.observed(o) for o in self.ranked[: self.detail.parsed]]
        parts[0] = f"{self.facts.instant}, {parts[0]}"
        courses = self.facts.courses[: self.detail.pairs]
        parts += [f"{_pair(course.objects)} are on a collision course" for course in courses]
        if not courses:
            parts.append(
                self.pick("no pair is on a collision course", "no pair is heading for contact")
            )
        return parts

    def observed(self, o: ObjectFacts) -> str:
        if o.sight != "shown":
            return _unseen(o.object, "is", o.sight, o.region)
        if o.speed == "stationary":
            return self.pick(
                f"the {o.object} is stationary {o.region}",
                f"the {o.object} rests {o.region}",
                f"the {o.object} is {o.region} and does not move",
            )
        motion = f"{o.speed}{_toward(o.heading)}"
        return self.pick(
            f"the {o.object} is {o.region}, moving {motion}",
            f"the {o.object} is {o.region} and moves {motion}",
            f"the {o.object} {o.region} is moving {motion}",
        )

    def motion(self) -> list[str]:
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
            parts.append(
                self.pick(
                    "the other objects remain where they are",
                    "the other objects hardly move",
                    "the rest of the scene stays as it is",
                )
            )
        elif any(o.extent == "stays" and o.speed == "stationary" for o in ranked):
            parts.append("the stationary objects remain where they are unless struck")
        if self.padded:
            parts.append("an object keeps its heading until contact turns it or it comes to rest")
        return parts

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
        if o.speed in (None, "stationary"):
            cause = "once struck, " if struck and o.speed else ""
        else:
            cause = self.pick("", f"moving {o.speed}, ", "given its speed, ")
        return f"{cause}the {o.object} {o.extent}{_toward(o.travel)}"

    def prediction(self) -> list[str]:
        close = self.facts.close[: self.detail.pairs]
        parts = [f"{_pair(c.objects)} will be very close {c.region}" for c in close]
        first_key = sorted(self.ranked, key=lambda o: self.key is not None and o is not self.key)
        parts += [self.expected(o) for o in first_key[: self.detail.predicted]]
        parts[0] = f"{self.facts.moment}, {parts[0]}"
        if self.padded:
            parts.append("the layout at the target moment follows from these motions")
        return parts

    def expected(self, o: ObjectFacts) -> str:
        if o.target_sight != "shown":
            return _unseen(o.object, "will be", o.target_sight, o.target_region)
        if o.extent == "stays" and o.region == o.target_region:
            return self.pick(
                f"the {o.object} remains {o.target_region}",
                f"the {o.object} stays {o.target_region}",
            )
        return self.pick(
            f"the {o.object} will be {o.target_region}",
            f"the {o.object} should be {o.target_region}",
        )

    def candidate(self, candidate: CandidateFacts) -> str:
        """Say where the key object is in a candidate, and then whether the candidate agrees."""
        key = self.key
        name, shows = f"candidate {candidate.letter}", f"shows the {key.object}"
        if candidate.agrees:
            end = self.pick("", " with the prediction")
            return f"{name} {shows} {key.target_region} and agrees{end}"
        others = ", and shows other objects" * candidate.other_objects
        difference = {d.object: d for d in candidate.differences}.get(key.object)
        if difference is None:
            why = self.difference(candidate.differences[0])
            return f"{name} {shows} {key.target_region} but {why}{others}"
        if difference.kind == "displaced":
            off = f"{difference.extent} off{_toward(difference.heading)}"
            return f"{name} {shows} {key.target_region} but {off}{others}"
        if difference.kind == "missing":
            return f"{name} lacks the {key.object}{others}"
        return f"{name} {shows} {difference.region}, not {key.target_region}{others}"

    def match(self, candidate: CandidateFacts) -> str:
        name = f"Candidate {candidate.letter}"
        if candidate.agrees:
            return f"{name} matches: every object is where it should be."
        first = min(candidate.differences, key=lambda d: d.object != self.key.object)
        why = ["shows other objects"] * candidate.other_objects
        why.append(self.difference(first))
        return f"{name} does not match: it {' and '.join(why)}."

    def difference(self, d: Difference) -> str:
        if d.kind == "missing":
            return self.pick(f"does not show the {d.object}", f"lacks the {d.object}")
        if d.kind == "extra":
            return self.pick(
                f"shows the {d.object}, which should not be seen",
                f"shows the {d.object} by mistake",
            )
        if d.kind == "region":
            expected = self.target_regions[d.object]
            return self.pick(
                f"shows the {d.object} {d.region}, not {expected}",
                f"has the {d.object} {d.region} and not {expected}",
            )
        toward = _toward(d.heading)
        return self.pick(
            f"has the {d.object} {d.extent} off{toward}",
            f"shows the {d.object} {d.extent} too far{toward}"
            if toward
            else f"has the {d.object} off",
        )

    def outcome(self, answer: str | None) -> list[str]:
        close = self.facts.close[:1]
        parts = [f"{_pair(c.objects)} are very close {c.region}" for c in close]
        visible = [o for o in self.ranked if o.target_sight == "shown"]
        parts += [f"the {o.object} is {o.target_region}" for o in visible[: 2 - len(parts)]]
        if answer is not None:
            parts.append(
                self.pick(
                    f"candidate {answer} shows this layout",
                    f"this layout is that of candidate {answer}",
                    f"only candidate {answer} agrees",
                )
            )
        return parts or ["no object is in view"]
