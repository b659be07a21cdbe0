"""Writes rationales whose prediction states what decides the item, in words of relations."""

from __future__ import annotations

import math
from collections.abc import Collection, Sequence
from dataclasses import replace
from importlib.resources import files

import yaml

from dynapix.teacher.predicates.facts import (
    OUT_OF_VIEW,
    CandidateFacts,
    ObjectFacts,
    Relation,
    RelationalPredicates,
    View,
)
from dynapix.teacher.predicates.relations import (
    CHANGES,
    DISPLACED,
    SYMMETRIC,
    find_topic,
    flip_relation,
    normalize_relation,
)
from dynapix.teacher.predicates.statement_choice import Decision
from dynapix.teacher.writers.paper import Detail, Writer

PHRASES = yaml.safe_load((files("dynapix.teacher") / "templates" / "relations.yaml").read_text())

POSSESSIVE = {"is": "has", "will be": "will have"}
"""For each verb, the one to use if the other object is named before the relation: "the cube *has*
the sphere left of it"."""
CHANGE_VERBS = {
    "passes": {"is": "passes", "will be": "will pass", "being": "passing"},
    "crosses": {"is": "crosses", "will be": "will cross", "being": "crossing"},
    "comes": {"is": "comes", "will be": "will come", "being": "coming"},
    "reaches": {"is": "reaches", "will be": "will reach", "being": "reaching"},
}
"""For the first word of each phrase for a change, the form that stands in the place of a form of
"be" before the phrases of other relations."""


def leave_out_unseen(p: RelationalPredicates, named: Collection[str] = ()) -> RelationalPredicates:
    """Leave out what is said of objects that are out of view at the cut, unless all are: a model
    that sees the frames could only guess their names.

    Args:
        named: Objects that are kept.
    """
    kept = {o.object for o in p.objects if o.sight != OUT_OF_VIEW or o.object in named}
    if not kept:
        return p
    return replace(
        p,
        objects=tuple(o for o in p.objects if o.object in kept),
        courses=tuple(m for m in p.courses if kept.issuperset(m.objects)),
        contacts=tuple(m for m in p.contacts if kept.issuperset(m.objects)),
        close=tuple(c for c in p.close if kept.issuperset(c.objects)),
        heavier=tuple(pair for pair in p.heavier if kept.issuperset(pair)),
    )


class RelationalWriter(Writer):
    """Writes the sections of a rationale from relational predicates.

    The prediction begins with the statements that decide the item (see
    `teacher.predicates.statement_choice`). The candidate analysis describes each candidate by the
    topics of these statements only. The outcome names the candidate that shows the object of the
    first statement closest to its place.
    Other objects that are out of view at the cut are left out.
    """

    facts: RelationalPredicates

    def __init__(
        self,
        facts: RelationalPredicates,
        decision: Decision,
        detail: Detail,
        *keys: int | str,
        padded: bool = False,
    ) -> None:
        named = {name for s in decision.statements for name in s.objects}
        super().__init__(leave_out_unseen(facts, named), detail, *keys, padded=padded)
        self.rank = {o.object: k for k, o in enumerate(self.ranked)}
        # Regions come first. "No red cube and the blue sphere near the top" would deny both, and in
        # "the red cube with the blue sphere left of it and near the top", either could be near the
        # top.
        self.statements = sorted(
            (self.orient(s) for s in decision.statements),
            key=lambda s: (s.kind == "sight", s.kind in SYMMETRIC, s.kind != "region"),
        )
        self.place_of_target = decision.place
        self.is_decided = not decision.rivals
        # The objects of the deciding statements come first in every section.
        self.ranked = sorted(self.ranked, key=lambda o: o.object not in named)
        self.view_of = {view.letter: view for view in facts.views}
        self.all_courses_left_out = bool(facts.courses) and not self.facts.courses

    def orient(self, relation: Relation) -> Relation:
        """Make the more relevant of two objects the subject of a relation."""
        if relation.kind in SYMMETRIC:
            first, second = relation.objects
            if self.rank[second] < self.rank[first]:
                return flip_relation(relation)
        return relation

    # Statements.

    def place(self, relation: Relation, pronoun: bool = False) -> str:
        """Return what a relation says of its subject, such as "left of the red cube".

        Args:
            pronoun: Whether to write "it" instead of the other object.
        """
        if relation.kind == "region":
            return relation.value
        if relation.kind == "sight":
            return "out of sight"
        others = [f"the {name}" for name in relation.objects[1:]]
        values = dict(zip("bc", ["it"] if pronoun else others, strict=False))
        return PHRASES[relation.value].format(**values)

    def other(self, relation: Relation) -> str:
        """Return where the other object of a symmetric relation is, such as "the red cube near it".

        Both objects are named before the relation, so that a model that writes the word can attend
        to both.
        """
        return f"the {relation.objects[1]} {self.place(flip_relation(relation), pronoun=True)}"

    def statement(self, relation: Relation, verb: str) -> str:
        """Return a clause; `verb` is a key of `POSSESSIVE`."""
        if relation.kind in SYMMETRIC:
            return f"the {relation.objects[0]} {POSSESSIVE[verb]} {self.other(relation)}"
        if relation.kind in CHANGES:
            return f"the {relation.objects[0]} {self.change(relation, verb)}"
        return f"the {relation.objects[0]} {verb} {self.place(relation)}"

    def change(self, relation: Relation, verb: str) -> str:
        """Return what an object does; `verb` is a key of the inner dictionaries of `CHANGE_VERBS`,
        such as "will be" for "will reach the left edge"."""
        present, rest = self.place(relation).split(" ", 1)
        return f"{CHANGE_VERBS[present][verb]} {rest}"

    def attribute(self, relation: Relation, true: bool = True) -> str:
        """Return what follows the subject in `shown`, for a relation that is true or false."""
        if relation.kind in CHANGES:
            return f"{'' if true else 'not '}{self.change(relation, 'being')}"
        if not true:
            return f"not {self.place(relation)}"
        if relation.kind in SYMMETRIC:
            return f"with {self.other(relation)}"
        return self.place(relation)

    def shown(self, statements: Sequence[tuple[Relation, bool]]) -> str:
        """Return what a candidate shows as the object of "shows".

        Args:
            statements: Statements about the candidate, and whether each is true of it.
        """
        text, subject = "", None
        # What is out of sight comes last: "no red cube and the blue sphere near the top" would deny
        # both.
        for s, true in sorted(statements, key=lambda each: each[0].kind == "sight"):
            if s.kind == "sight":
                part = f"no {s.objects[0]}"
            else:
                said = self.attribute(s, true)
                part = said if s.objects[0] == subject else f"the {s.objects[0]} {said}"
                # In "between the cube and the sphere and with the cylinder left of it", "it" would
                # be the sphere.
                subject = s.objects[0] if len(s.objects) == 1 or s.kind in SYMMETRIC else None
            separator = ", and " if "," in text + part else " and "
            text = f"{text}{separator}{part}" if text else part
        return text

    def find_closest(self, views: Sequence[View]) -> str | None:
        """Return the letter of the candidate that shows the object of the first statement closest
        to its place at the target; None if this statement is not about a place, or if another
        candidate shows it about as close."""
        if self.place_of_target is None:
            return None
        (name,) = self.place_of_target.objects
        target = self.facts.target.places.image[name]
        shown = {v.letter: v.places.image[name] for v in views if name in v.places.image}
        distances = sorted((math.dist(place, target), letter) for letter, place in shown.items())
        (nearest, letter), *others = distances or [(math.inf, None)]
        if any(d - nearest < DISPLACED for d, _ in others):
            return None
        return letter

    # Sections.

    def order(self, objects: list[ObjectFacts]) -> list[ObjectFacts]:
        """Return objects from left to right, so that a reader of the frame knows which is next."""
        return sorted(objects, key=lambda o: self.facts.left_to_right.index(o.object))

    def scene_parse(self) -> list[str]:
        parts = super().scene_parse()
        if self.all_courses_left_out:
            # "No pair is on a collision course" would be false.
            parts.pop()
        now = [find_topic(s, self.facts.observed) for s in self.statements]
        parts += [self.statement(s, "is") for s in now if s is not None][: self.detail.relations]
        return parts

    def motion_analysis(self) -> list[str]:
        parts = super().motion_analysis()
        named = {name for s in self.statements for name in s.objects}
        if any(o.extent not in ("stays", "unseen") for o in self.ranked):
            still = [o for o in self.ranked if o.object in named and o.extent == "stays"]
            parts[-1:-1] = [
                self.say("stays" if o.speed == "stationary" else "hardly_moves", o=o) for o in still
            ]
        changes = [
            r
            for r in self.facts.target.relations
            if r.kind in CHANGES and named.issuperset(r.objects)
        ]
        for change in changes[: self.detail.relations]:
            parts.append(f"the {change.objects[0]} {self.place(change)}")
        return parts

    def predicted(self) -> list[str]:
        parts = [self.statement(s, "will be") for s in self.statements]
        stated = {s.objects[0] for s in self.statements if s.kind in ("region", "sight")}
        places = [self.expected(o) for o in self.ranked if o.object not in stated]
        parts += places[: max(self.detail.predicted - len(stated), 0)]
        return parts or places[:1]

    def judgement(self, candidate: CandidateFacts) -> str:
        if not self.statements:
            return super().judgement(candidate)
        return self.comparison(self.view_of[candidate.letter])

    def comparison(self, view: View) -> str:
        """Describe a candidate in the respects of the deciding statements.

        The text does not say whether the candidate agrees with the prediction. A model that writes
        it does not decide this before it has described all candidates.
        """
        found = list(dict.fromkeys(self.find_shown(s, view) for s in self.statements))
        if self.detail.compared < 2:
            predicted = [(s, True) for s in self.statements]
            excluding = [each for each in found if each not in predicted]
            found = excluding[:1] or predicted[: None if self.detail.compared else 1]
        return f"shows {self.shown(found)}"

    def find_shown(self, s: Relation, view: View) -> tuple[Relation, bool]:
        """Return what a candidate shows in the respect of a deciding statement: a statement, and
        whether it is true of the candidate. It is false if no words but its denial tell it."""
        if normalize_relation(s) in view.statements:
            return s, True
        facts = {o.object: o for o in view.objects}
        unseen = [name for name in s.objects if facts[name].target_sight != "shown"]
        if unseen:
            return Relation("sight", (unseen[0],), "unseen"), True
        if s.kind in ("region", "sight"):
            return Relation("region", s.objects, facts[s.objects[0]].target_region), True
        actual = find_topic(s, view.relations)
        return (s, False) if actual is None else (actual, True)

    def match(self, candidate: CandidateFacts) -> str:
        # No reason is given: a model that describes the candidate a second time may contradict its
        # analysis and its outcome.
        verb = "matches" if candidate.agrees else "does not match"
        return f"Candidate {candidate.letter} {verb}."

    def outcome(self) -> list[str]:
        if not self.statements:
            return super().outcome()
        parts = [self.conclusion(self.facts.views)]
        # "Only candidate A agrees" would be false if the same is said of another candidate.
        if self.is_decided or self.find_closest(self.facts.views) is None:
            parts.append(self.say("answer", answer=self.facts.answer))
        return parts

    def conclusion(self, views: Sequence[View]) -> str:
        """Return which candidate shows the object of the first statement closest to its place or,
        if several are about as close, the shortest deciding statement."""
        if self.place_of_target and (letter := self.find_closest(views)) is not None:
            (name,) = self.place_of_target.objects
            return f"the {name} is closest to its expected place in candidate {letter}"
        return self.statement(min(self.statements, key=lambda s: len(s.objects)), "is")
