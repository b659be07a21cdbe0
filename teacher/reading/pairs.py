"""Reads claims about pairs of objects: collision courses, contacts, their time, and closeness."""

from __future__ import annotations

from dataclasses import dataclass

from teacher.reading.grounding import BETWEEN, CUT, EITHER, TARGET, Ground
from teacher.reading.reader import Names, Reader
from teacher.reading.tagging import BOUNDARIES, Tag

RELATIONS = {"course", "meet", "contact", "passed", "close"}
LIMITS = {"moment", "yet", "then", "before", "until", "far"}
"""Last words of phrases that limit the time up to which an event is denied."""


@dataclass
class Relation:
    """A pair in the current clause: its participants and time, as far as they have been read."""

    kind: str
    tag: Tag
    affirmed: bool
    subjects: Names
    denied_subject: bool
    partners: Names
    between: bool = False


class PairReader(Reader):
    """Collects the participants of a relation and records it when its clause ends."""

    def __init__(self, ground: Ground, moment: str) -> None:
        """`moment`: the moment of the section's present tense."""
        super().__init__(ground)
        self.moment = moment
        self.still_when = CUT if moment == CUT else EITHER
        self.subjects: Names = []
        self.negated = self.maybe = self.future = False

    def record_verb(self) -> None:
        """Record that the clause has its verb."""
        raise NotImplementedError

    def begin_pairs(self) -> None:
        self.subjects = []
        self.denied_subject = False
        """Whether the subject is a phrase such as "no pair"."""
        self.relation: Relation | None = None
        self.time: Tag | None = None
        self.met: tuple[str | None, ...] = ()
        """The last pair of the sentence."""
        self.companions: Names = []
        """The object after "with" before the relation is named."""

    def is_incomplete(self) -> bool:
        return bool(self.relation and self.relation.between and len(self.relation.partners) < 2)

    def both(self) -> Names:
        """The two objects that "they" refers to, if unambiguous."""
        named = list(dict.fromkeys(self.mentioned)) or list(self.before)
        return named if len(named) == 2 and None not in named else [None]

    def on_course(self, tag: Tag) -> None:
        self._start_relation("course", tag)

    def on_meet(self, tag: Tag) -> None:
        self._start_relation("meeting", tag)

    def on_passed(self, tag: Tag) -> None:
        if tag.words.startswith("no ") and not self._is_ahead({"between", "with"}):
            there = "there" in (self.near(-1).words, self.near(-2).words)
            if there or self.near(-1).tag in BOUNDARIES:
                # "No contact awaits the A" is not about the previous pair.
                return
        self._start_relation("meeting", tag, denied=True)

    def on_contact(self, tag: Tag) -> None:
        if self.near(1).tag in ("between", "with", "object"):
            self._start_relation("meeting", tag)
        elif self.negated or self._is_ahead({"not", "none", "contrast"}):
            # A denied contact need not be that of the previous pair.
            return
        elif self.relation is None and self.near(-1).tag not in ("by", "past"):
            pair = self.met or tuple(self.both())
            if len(pair) == 2:
                self._start_relation("meeting", tag)
                if self.relation:
                    self.relation.partners, self.relation.between = list(pair), True

    def _is_ahead(self, wanted: set[str]) -> bool:
        """Whether one of the tags follows in the clause."""
        return self.next_of(BOUNDARIES | wanted).tag in wanted

    def on_close(self, tag: Tag) -> None:
        if self.relation and not self.relation.partners and self.relation.kind != "close":
            return
        self._start_relation("close", tag)

    def on_between(self, tag: Tag) -> None:
        if self.relation and not self.relation.partners:
            self.relation.between = True

    def on_when(self, tag: Tag) -> None:
        opening = self.near(-1).tag in BOUNDARIES
        if self.time is None and not (opening and tag.value == "later"):
            self.time = tag

    def _start_relation(self, kind: str, tag: Tag, denied: bool = False) -> None:
        """Begin a relation at `tag`; `denied` if its words deny the event ("misses")."""
        time = self.time
        self.flush()
        self.time = time
        partners: Names = []
        if self.companions and self.near(1).tag not in ("object", "by", "with"):
            # "Its course with the B ends without contact."
            partners, self.companions = self.companions, []
        if self.maybe:
            return
        affirmed = self.negated == denied
        self.relation = Relation(kind, tag, affirmed, self.subjects, self.denied_subject, partners)
        if tag.tag != "contact":
            self.record_verb()

    def close_region(self, relation: Relation, tag: Tag) -> None:
        """The region of a close pair, stated right after it."""
        pair = self._pairs(relation)
        if len(pair) != 1 or self.maybe or self.negated:
            return
        if relation.partners or self.near(-1).tag in ("close", "ignore"):
            when = TARGET if self.moment == TARGET or self.future else EITHER
            # "Close to the A near the top" may describe only the place of the A.
            kind = "place of either" if self.near(-1).tag == "object" else "close region"
            self.claims.append(self.claim(kind, pair[0], str(tag.value), True, when, tag))

    def _pairs(self, relation: Relation) -> list[tuple[str | None, ...]]:
        if relation.between:
            return [tuple(relation.partners)] if len(relation.partners) == 2 else []
        if relation.partners:
            if relation.denied_subject:
                return [(name,) for name in relation.partners]
            return [(a, b) for a in relation.subjects for b in relation.partners]
        return [tuple(relation.subjects)] if len(relation.subjects) in (1, 2) else []

    def flush(self) -> None:
        """End the current relation and record its claims."""
        relation, time = self.relation, self.time
        self.relation = self.time = None
        if relation is None or self.maybe:
            return
        kind = relation.kind
        affirmed = relation.affirmed and not relation.denied_subject
        if self.moment == CUT:
            when = CUT
        elif kind == "close":
            when = EITHER if self.moment == EITHER and not self.future else TARGET
        else:
            # "They do not touch by then" denies only events up to the target.
            limited = self.moment == TARGET or any(t.last_word in LIMITS for t in self.sentence)
            when = TARGET if limited and not affirmed else BETWEEN
        pairs = self._pairs(relation)
        if relation.denied_subject and not pairs and kind == "course":
            pairs = [()]
        for pair in pairs:
            if None in pair or len(set(pair)) < len(pair):
                continue
            if len(pair) == 1 and (kind == "close" or not (affirmed or kind == "course")):
                continue
            value = str(relation.tag.value)
            self.claims.append(self.claim(kind, pair, value, affirmed, when, relation.tag))
            if len(pair) == 2:
                self.met = pair
                if time and affirmed and kind != "close":
                    value = str(time.value)
                    self.claims.append(self.claim("time", pair, value, True, BETWEEN, time))
