"""Reads claims about pairs: collision courses, contacts, the time of contacts, and closeness."""

from __future__ import annotations

from dataclasses import dataclass

from teacher.reading.claims import BETWEEN, CUT, EITHER, TARGET, IndexedPredicates
from teacher.reading.reader import Names, Reader
from teacher.reading.tagging import BOUNDARIES, Tag

PAIR_TAGS = {"course", "meet", "contact", "no_contact", "close"}
"""Tags of statements about two objects: a collision course, a contact, closeness."""
LIMITS = {"moment", "yet", "then", "before", "until", "far"}
"""Last words of tags that limit a denial to the time up to the target, as "by then"."""


@dataclass
class PairEvent:
    """A statement of the current clause about two objects, as far as it has been read: that they
    are on a collision course, collide, or are close.

    In "the red cube meets the sphere", `tag` stands for "meets", the cube is the only subject and
    the sphere the only partner. `denied_subject` is true for a subject such as "no pair", `between`
    if both objects are partners ("a contact between the cube and the sphere").
    """

    kind: str
    tag: Tag
    affirmed: bool
    subjects: Names
    denied_subject: bool
    partners: Names
    between: bool = False


class PairReader(Reader):
    """Collects the objects of a pair event, and records its claims when its clause ends."""

    def __init__(self, predicates: IndexedPredicates, moment: str) -> None:
        """`moment`: the moment that the present tense of the section refers to."""
        super().__init__(predicates)
        self.moment = moment
        self.still_moment = CUT if moment == CUT else EITHER
        self.subjects: Names = []
        self.negated = self.maybe = self.future = False

    def record_verb(self) -> None:
        raise NotImplementedError

    def begin_pairs(self) -> None:
        self.subjects = []
        self.denied_subject = False
        """Whether the subject is a phrase such as "no pair"."""
        self.pair_event: PairEvent | None = None
        self.time: Tag | None = None
        self.last_pair: tuple[str | None, ...] = ()
        """The last pair about which the sentence stated an event."""
        self.companions: Names = []
        """The objects after a "with" that precedes the event."""

    def is_incomplete(self) -> bool:
        """Return whether the next objects belong to the event: "a contact between"."""
        event = self.pair_event
        return bool(event and event.between and len(event.partners) < 2)

    def find_both(self) -> Names:
        """Return the two objects that "they" refers to, or [None] if it is ambiguous."""
        named = list(dict.fromkeys(self.mentioned)) or list(self.previous_subjects)
        return named if len(named) == 2 and None not in named else [None]

    def on_course(self, tag: Tag) -> None:
        self._start_pair_event("course", tag)

    def on_meet(self, tag: Tag) -> None:
        self._start_pair_event("meeting", tag)

    def on_no_contact(self, tag: Tag) -> None:
        if tag.words.startswith("no ") and not self._is_ahead({"between", "with"}):
            there = "there" in (self.near(-1).words, self.near(-2).words)
            if there or self.near(-1).name in BOUNDARIES:
                # "No contact awaits the red cube" is not about the previous pair.
                return
        self._start_pair_event("meeting", tag, denied=True)

    def on_contact(self, tag: Tag) -> None:
        if self.near(1).name in ("between", "with", "object"):
            self._start_pair_event("meeting", tag)
        elif self.negated or self._is_ahead({"not", "none", "contrast"}):
            # A contact that is denied need not be a contact of the previous pair.
            return
        elif self.pair_event is None and self.near(-1).name not in ("by", "past"):
            pair = self.last_pair or tuple(self.find_both())
            if len(pair) == 2:
                self._start_pair_event("meeting", tag)
                if self.pair_event:
                    self.pair_event.partners, self.pair_event.between = list(pair), True

    def _is_ahead(self, wanted: set[str]) -> bool:
        """Return whether a tag with a name in `wanted` follows in the clause."""
        return self.next_of(BOUNDARIES | wanted).name in wanted

    def on_close(self, tag: Tag) -> None:
        if self.pair_event and not self.pair_event.partners and self.pair_event.kind != "close":
            return
        self._start_pair_event("close", tag)

    def on_between(self, tag: Tag) -> None:
        if self.pair_event and not self.pair_event.partners:
            self.pair_event.between = True

    def on_time(self, tag: Tag) -> None:
        opening = self.near(-1).name in BOUNDARIES
        if self.time is None and not (opening and tag.value == "later"):
            self.time = tag

    def _start_pair_event(self, kind: str, tag: Tag, denied: bool = False) -> None:
        """Begin a pair event at `tag`; `denied` if its words deny the event ("misses")."""
        time = self.time
        self.end_pair_event()
        self.time = time
        partners: Names = []
        if self.companions and self.near(1).name not in ("object", "by", "with"):
            # "Its course with the blue sphere ends without contact."
            partners, self.companions = self.companions, []
        if self.maybe:
            return
        affirmed = self.negated == denied
        self.pair_event = PairEvent(
            kind, tag, affirmed, self.subjects, self.denied_subject, partners
        )
        if tag.name != "contact":
            self.record_verb()

    def add_close_region(self, event: PairEvent, tag: Tag) -> None:
        """Record the region of a close pair, as in "they are close together near the top"."""
        pair = self._find_pairs(event)
        if len(pair) != 1 or self.maybe or self.negated:
            return
        if event.partners or self.near(-1).name in ("close", "ignore"):
            when = TARGET if self.moment == TARGET or self.future else EITHER
            # In "close to the red cube near the top", the region may be that of the cube alone.
            kind = "place of either" if self.near(-1).name == "object" else "close region"
            self.claims.append(self.claim(kind, pair[0], str(tag.value), True, when, tag))

    def _find_pairs(self, event: PairEvent) -> list[tuple[str | None, ...]]:
        """Return the pairs of an event; a tuple has one object if the other is not named."""
        if event.between:
            return [tuple(event.partners)] if len(event.partners) == 2 else []
        if event.partners:
            if event.denied_subject:
                return [(name,) for name in event.partners]
            return [(a, b) for a in event.subjects for b in event.partners]
        return [tuple(event.subjects)] if len(event.subjects) in (1, 2) else []

    def end_pair_event(self) -> None:
        """End the current pair event and record its claims."""
        event, time = self.pair_event, self.time
        self.pair_event = self.time = None
        if event is None or self.maybe:
            return
        kind = event.kind
        affirmed = event.affirmed and not event.denied_subject
        if self.moment == CUT:
            when = CUT
        elif kind == "close":
            when = EITHER if self.moment == EITHER and not self.future else TARGET
        else:
            # "They do not touch by then" denies contacts up to the target, not later ones.
            limited = self.moment == TARGET or any(t.last_word in LIMITS for t in self.sentence)
            when = TARGET if limited and not affirmed else BETWEEN
        pairs = self._find_pairs(event)
        if event.denied_subject and not pairs and kind == "course":
            pairs = [()]
        for pair in pairs:
            if None in pair or len(set(pair)) < len(pair):
                continue
            if len(pair) == 1 and (kind == "close" or not (affirmed or kind == "course")):
                continue
            value = str(event.tag.value)
            self.claims.append(self.claim(kind, pair, value, affirmed, when, event.tag))
            if len(pair) == 2:
                self.last_pair = pair
                if time and affirmed and kind != "close":
                    claim = self.claim("time", pair, str(time.value), True, BETWEEN, time)
                    self.claims.append(claim)
