"""What steers a clause about the scene: where it begins and ends, its verb, its negation, its
moment; and the holding of what is said of its subject."""

from __future__ import annotations

from teacher.reading.pairs import PairReader
from teacher.reading.reader import BOUNDARIES, Names
from teacher.reading.tagging import Tag

SAID = {"from", "region", "direction", "speed", "still", "moving", "rest", "out", "hidden"}
"""Tags of what may be said of an object before it is named."""
OPENING = SAID | {"into", "toward", "slight", "word", "by", "be", "comma", "pronoun", "future"}
OPENING |= {"expected"}
"""Tags that may stand between a clause's beginning and a subject that comes late."""
WAS = {"was", "were", "had"}
"""Opening words of phrases of the past that are verbs."""


class ClauseReader(PairReader):
    """Keeps what a clause's words of time, negation and doubt leave open or settle."""

    def begin(self) -> None:
        self.before = self.subjects
        """Whom the sentence before told of last."""
        self.begin_pairs()
        self.group_start = 0
        """Where in `subjects` the part begins that a comma's afterthought is said of."""
        self.pending: list[tuple[str, str, bool, str, Tag]] = []
        """What has been said before its subject was named."""
        self.finite = False
        """Whether the subject has its verb, so that a further noun phrase is a new subject."""
        self.blocked = self.complement = False
        """Whether what follows may be said of another object than the subject."""
        self.crossed = self.moved = self.absolute = False
        self.last: Names = []
        """Whom "which" stands for."""
        self.hypothetical = False
        self.inner = False
        """Whether a clause of a place is being read ("where the A was"), within another's."""
        self.neither = self.relative = False
        self.pronominal = False
        """Whether the subject is a pronoun, which no list goes on from."""
        self.gapped = self.verbal = False
        """Whether the subject has what is said of it without a verb ("the A moves east, the B
        west"), and whether an earlier subject of the sentence had its verb."""
        self._boundary()

    def end(self) -> None:
        self.flush()
        ending = [t.tag for t in self.sentence[-2:]]
        if ending == ["not", "stop"]:
            # "They look set to meet, but they do not."
            self.claims = [c for c in self.claims if c.kind != "meeting"]

    def _boundary(self) -> None:
        self.negated = self.staying = self.future = self.past = self.slight = False
        self.maybe = self.hypothetical
        self.crossed = True

    # Boundaries.

    def on_comma(self, tag: Tag) -> None:
        if not self.is_incomplete():
            self.flush()
            # "Neither the A, which moves, nor the B, ...": what is denied of both comes later.
            self.hypothetical |= self.neither and self.relative
            self._boundary()
            if self.inner and self.near(1).tag != "break":
                self.subjects, self.group_start, self.inner = [None], 0, False
            self.finite |= self.absolute
            self.absolute = False
            if self.near(1).tag == "region" and self.near(2).tag == "object":
                self._open()

    def on_semicolon(self, tag: Tag) -> None:
        self.flush()
        self._boundary()
        self.finite = bool(self.subjects)
        self._open()

    on_break = on_semicolon

    def on_and(self, tag: Tag) -> None:
        if not self.is_incomplete():
            self.flush()
            self.negated = self.slight = False
            self.crossed = True
            # "Near the left and near the right, the A ..." goes on with a list.
            listed = self.near(-1).tag == self.near(1).tag == "region"
            if not (listed and self.near(2).tag == "comma"):
                self._open()

    def _open(self) -> None:
        """Forget the subject where a clause opens with what is said of the next: "and near the
        top is the A", "while moving slowly, the A"."""
        step = 1
        while self.near(step).tag in OPENING:
            if self.word(self.near(step)) == "where":
                return
            step += 1
        if step > 1 and self.near(step - 1).tag not in ("by", "with"):
            said = any(self.near(k).tag in SAID for k in range(1, step))
            if said and self.near(step).tag == "object":
                self.subjects, self.finite, self.blocked, self.nobody = [], False, False, False

    # Words that steer.

    def on_not(self, tag: Tag) -> None:
        self.negated = True
        self.neither |= self.word(tag) == "neither"

    on_contrast = on_not

    def on_maybe(self, tag: Tag) -> None:
        self.maybe = True
        self.hypothetical |= "if" in self.word(tag).split()

    def on_future(self, tag: Tag) -> None:
        self.future = True
        if self.word(tag) == "would" and any(t.tag == "maybe" for t in self.sentence):
            self.maybe = True
        self.verb()

    on_expected = on_future

    def on_past(self, tag: Tag) -> None:
        self.past = True
        if self.word(tag).split()[0] in WAS:
            self.verb()

    def on_lack(self, tag: Tag) -> None:
        if self.word(tag).startswith("without"):
            self.negated = True

    def on_word(self, tag: Tag) -> None:
        if self.near(-1).tag == "object":
            # A verb that is not in the vocabulary, if it is one, may be of motion.
            self.verb()
            self.moved |= str(tag.value).endswith("s")

    def on_be(self, tag: Tag) -> None:
        self.verb()

    on_show = on_be

    def on_stays(self, tag: Tag) -> None:
        self.staying = True
        self.verb()

    def verb(self) -> None:
        if self.crossed:
            self.blocked = False
        if self.subjects or self.nobody:
            self.finite = True

    # What is said of the subject.

    def tell(
        self,
        kind: str,
        value: str,
        affirmed: bool,
        when: str,
        tag: Tag,
        subjects: Names | None = None,
    ) -> None:
        if self.maybe or self.blocked:
            return
        if subjects is None:
            if not self.subjects:
                if not self.nobody:
                    self.pending.append((kind, value, affirmed, when, tag))
                return
            # Before the verb, "the A and the B near the top" may speak of the B alone.
            apart = not self.finite and self.near(-1).tag == "object"
            subjects = self.subjects[-1:] if apart else self.subjects
            if not self.finite and not apart:
                subjects = self.subjects[self.group_start :]
            self.gapped |= not self.finite and (self.verbal or self._is_verbless(kind))
        for name in subjects:
            self.claims.append(self.claim(kind, (name,), value, affirmed, when, tag))
        if len(subjects) > 1 and affirmed:
            self.shared.append((kind, value, tuple(subjects), tag))

    def _is_verbless(self, kind: str) -> bool:
        """Whether a motion is said of the subject without so much as a participle."""
        step = -1
        while self.near(step).tag not in ("object", *BOUNDARIES):
            if self.near(step).tag in ("moving", "moves"):
                return False
            step -= 1
        return kind in ("direction", "speed", "extent")
