"""Reads claims about pairs of objects: collision courses, contacts, their time, and closeness."""

from __future__ import annotations

from dataclasses import dataclass, field

from teacher.reading.grounding import BETWEEN, CUT, EITHER, TARGET, Ground
from teacher.reading.reader import BOUNDARIES, END, Names, Reader
from teacher.reading.tagging import Tag

RELATIONS = {"course", "meet", "contact", "passed", "close"}
LIMITS = {"moment", "yet", "then", "before", "until", "far"}
"""Last words of phrases that limit the time up to which an event is denied."""


@dataclass
class Relation:
    """A pair in the current clause: its participants and time, as far as they have been read."""

    kind: str
    tag: Tag
    value: str
    affirmed: bool
    subjects: Names
    denied_subject: bool
    partners: Names = field(default_factory=list)
    between: bool = False


class PairReader(Reader):
    """Collects the participants of a relation and records it when its clause ends."""

    def __init__(self, text: str, ground: Ground, moment: str) -> None:
        """`moment`: the moment of the section's present tense."""
        super().__init__(text, ground)
        self.moment = moment
        self.still_when = CUT if moment == CUT else EITHER
        self.subjects: Names = []
        self.negated = self.maybe = self.future = False

    def verb(self) -> None:
        """Record that the clause has its verb."""
        raise NotImplementedError

    def begin_pairs(self) -> None:
        self.subjects = []
        self.denied_subject = False
        """Whether the subject is a phrase such as "no pair"."""
        self.relation: Relation | None = None
        self.time: tuple[str, Tag] | None = None
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
        self._relate("course", tag, str(tag.value), not self.negated)

    def on_meet(self, tag: Tag) -> None:
        self._relate("meeting", tag, "", not self.negated)

    def on_passed(self, tag: Tag) -> None:
        if self.word(tag).startswith("no ") and not self._ahead({"between", "with"}):
            opening = self.near(-1) is END or self.near(-1).tag in BOUNDARIES
            if opening or "there" in (self.word(self.near(-1)), self.word(self.near(-2))):
                # "No contact awaits the A" is not about the previous pair.
                return
        self._relate("meeting", tag, "", self.negated)

    def on_contact(self, tag: Tag) -> None:
        following = self.near(1)
        if following.tag in ("between", "with", "object"):
            self._relate("meeting", tag, "", not self.negated)
        elif self.negated or self._ahead({"not", "none", "contrast"}):
            # A denied contact need not be that of the previous pair.
            return
        elif self.relation is None and self.near(-1).tag not in ("by", "past"):
            pair = self.met or tuple(self.both())
            if len(pair) == 2:
                self._relate("meeting", tag, "", not self.negated)
                if self.relation:
                    self.relation.partners, self.relation.between = list(pair), True

    def is_limited(self) -> bool:
        """Whether the sentence is limited to events up to the target: "do not touch by then"."""
        marked = any(self.last_word(t) in LIMITS for t in self.sentence)
        return self.moment == TARGET or marked

    def _ahead(self, wanted: set[str]) -> bool:
        """Whether one of the tags follows in the clause."""
        step = 1
        while self.near(step).tag not in BOUNDARIES:
            if self.near(step).tag in wanted:
                return True
            step += 1
        return False

    def on_close(self, tag: Tag) -> None:
        if self.relation and not self.relation.partners and self.relation.kind != "close":
            return
        self._relate("close", tag, str(tag.value), not self.negated)

    def on_between(self, tag: Tag) -> None:
        if self.relation and not self.relation.partners:
            self.relation.between = True

    def on_when(self, tag: Tag) -> None:
        opening = self.near(-1) is END or self.near(-1).tag in BOUNDARIES
        if self.time is None and not (opening and tag.value == "later"):
            self.time = (str(tag.value), tag)

    def _relate(self, kind: str, tag: Tag, value: str, affirmed: bool) -> None:
        time = self.time
        self.flush(keep=self.relation is None)
        if self.relation is None and time:
            self.time = time
        self.relation = Relation(
            kind, tag, value, affirmed and not self.maybe, list(self.subjects), self.denied_subject
        )
        if self.companions and self.near(1).tag not in ("object", "by", "with"):
            # "Its course with the B ends without contact."
            self.relation.partners, self.companions = self.companions, []
        if self.maybe:
            self.relation = None
        elif tag.tag != "contact":
            self.verb()

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
        if len(relation.subjects) <= 2:
            return [tuple(relation.subjects)] if relation.subjects else []
        return []

    def flush(self, keep: bool = False) -> None:
        """End the current relation and record its claims."""
        relation, time = self.relation, self.time
        self.relation = None
        if not keep:
            self.time = None
        if relation is None or self.maybe:
            return
        affirmed = relation.affirmed and not relation.denied_subject
        when = CUT if self.moment == CUT else TARGET if relation.kind == "close" else BETWEEN
        if relation.kind == "close" and self.moment == EITHER and not self.future:
            when = EITHER
        if not affirmed and when == BETWEEN and self.is_limited():
            when = TARGET
        pairs = self._pairs(relation)
        if relation.denied_subject and not pairs and relation.kind == "course":
            pairs = [()]
        for pair in pairs:
            alone = len(pair) == 1
            if alone and (relation.kind == "close" or not (affirmed or relation.kind == "course")):
                continue
            self._record(relation, pair, affirmed, when, time)

    def _record(
        self,
        relation: Relation,
        pair: tuple[str | None, ...],
        affirmed: bool,
        when: str,
        time: tuple[str, Tag] | None,
    ) -> None:
        if None in pair or len(set(pair)) < len(pair):
            return
        self.claims.append(
            self.claim(relation.kind, pair, relation.value, affirmed, when, relation.tag)
        )
        if len(pair) == 2:
            self.met = pair
        if time and affirmed and relation.kind in ("meeting", "course") and len(pair) == 2:
            self.claims.append(self.claim("time", pair, time[0], True, BETWEEN, time[1]))
