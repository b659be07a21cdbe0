"""Tracks the structure of a clause about the scene: its start and end, verb, negation and moment;
and records the claims about its subject."""

from __future__ import annotations

from teacher.reading.pairs import PairReader
from teacher.reading.reader import Names
from teacher.reading.tagging import BOUNDARIES, Tag

PRECEDING = {"from", "region", "direction", "speed", "still", "moving", "rest", "out", "hidden"}
"""Tags of claims that may precede the name of their object."""
OPENING = PRECEDING | {"into", "toward", "slight", "word", "by", "be", "comma", "pronoun", "future"}
OPENING |= {"expected"}
"""Tags allowed between the start of a clause and a late subject."""
WAS = {"was", "were", "had"}
"""First words of phrases about the past that are verbs."""


class ClauseReader(PairReader):
    """Tracks a clause's time, negation and doubt."""

    def begin(self) -> None:
        self.before = self.subjects
        """The subjects at the end of the previous sentence."""
        self.begin_pairs()
        self.group_start = 0
        """The index of the first subject that words behind a comma refer to."""
        self.pending: list[tuple[str, str, bool, str, Tag]] = []
        """Claims that precede their subject."""
        self.finite = False
        """Whether the subject already has a verb, so that another noun phrase is a new subject."""
        self.blocked = self.complement = False
        """Whether the following words may refer to an object other than the subject, and whether
        the sentence has named one."""
        self.crossed = False
        """Whether the next verb is that of the subject, since a boundary lies before it."""
        self.moved = False
        """Whether the sentence has said that something moves."""
        self.absolute = False
        """Whether the clause ends with the next comma: "with the A at rest, the B ..."."""
        self.last: Names = []
        """The antecedents of "which"."""
        self.hypothetical = False
        """Whether the whole sentence depends on a condition."""
        self.inner = False
        """Whether the current clause is a place clause inside another one ("where the A was")."""
        self.neither = self.relative = False
        """Whether the sentence has a "neither", and whether it has a "which"."""
        self.pronominal = False
        """Whether the subject is a pronoun, which cannot start a list."""
        self.gapped = self.verbal = False
        """Whether the subject has a claim without a verb ("the A moves east, the B west"), and
        whether an earlier subject of the sentence had a verb."""
        self._cross_boundary()

    def end(self) -> None:
        self.flush()
        if [tag.tag for tag in self.sentence.tags[-2:]] == ["not", "stop"]:
            # "They look set to meet, but they do not."
            self.claims = [c for c in self.claims if c.kind != "meeting"]

    def _cross_boundary(self) -> None:
        self.negated = self.staying = self.future = self.past = self.slight = False
        self.maybe = self.hypothetical
        self.crossed = True

    # Boundaries.

    def on_comma(self, tag: Tag) -> None:
        if not self.is_incomplete():
            self.flush()
            # "Neither the A, which moves, nor the B, ...": the denied claim about both follows.
            self.hypothetical |= self.neither and self.relative
            self._cross_boundary()
            if self.inner and self.near(1).tag != "break":
                self.subjects, self.group_start, self.inner = [None], 0, False
            self.finite |= self.absolute
            self.absolute = False
            if self.near(1).tag == "region" and self.near(2).tag == "object":
                self._open_clause()

    def on_semicolon(self, tag: Tag) -> None:
        self.flush()
        self._cross_boundary()
        self.finite = bool(self.subjects)
        self._open_clause()

    on_break = on_semicolon

    def on_and(self, tag: Tag) -> None:
        if not self.is_incomplete():
            self.flush()
            self.negated = self.slight = False
            self.crossed = True
            # "Near the left and near the right, the A ..." continues a list.
            listed = self.near(-1).tag == self.near(1).tag == "region"
            if not (listed and self.near(2).tag == "comma"):
                self._open_clause()

    def _open_clause(self) -> None:
        """Drop the subject if the clause opens with a claim about the next one: "and near the top
        is the A", "while moving slowly, the A"."""
        stop = self.sentence.skip(self.at + 1, OPENING)
        opening = self.sentence.tags[self.at + 1 : stop]
        place = any(tag.words == "where" for tag in opening)
        precedes = any(tag.tag in PRECEDING for tag in opening) and opening[-1].tag != "by"
        if precedes and not place and self.sentence[stop].tag == "object":
            self.start_clause([])

    def start_clause(self, subjects: Names, group_start: int = 0) -> None:
        """Begin a clause with new subjects; its verb has not been read."""
        self.subjects, self.group_start = subjects, group_start
        self.finite = self.blocked = self.denied_subject = False

    # Function words.

    def on_not(self, tag: Tag) -> None:
        self.negated = True
        self.neither |= tag.words == "neither"

    on_contrast = on_not

    def on_maybe(self, tag: Tag) -> None:
        self.maybe = True
        self.hypothetical |= "if" in tag.words.split()

    def on_future(self, tag: Tag) -> None:
        self.future = True
        if tag.words == "would" and any(t.tag == "maybe" for t in self.sentence):
            self.maybe = True
        self.record_verb()

    on_expected = on_future

    def on_past(self, tag: Tag) -> None:
        self.past = True
        if tag.words.split()[0] in WAS:
            self.record_verb()

    def on_lack(self, tag: Tag) -> None:
        if tag.words.startswith("without"):
            self.negated = True

    def on_word(self, tag: Tag) -> None:
        if self.near(-1).tag == "object":
            # An unknown word may be a verb of motion.
            self.record_verb()
            self.moved |= str(tag.value).endswith("s")

    def on_be(self, tag: Tag) -> None:
        self.record_verb()

    on_show = on_be

    def on_halts(self, tag: Tag) -> None:
        # "Slows near the top": the object may be elsewhere at the cut and at the target.
        self.record_verb()
        self.maybe = True

    def on_stays(self, tag: Tag) -> None:
        self.staying = True
        self.record_verb()

    def record_verb(self) -> None:
        if self.crossed:
            self.blocked = False
        if self.subjects or self.denied_subject:
            self.finite = True

    # Claims about the subject.

    def add_claim(
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
                if not self.denied_subject:
                    self.pending.append((kind, value, affirmed, when, tag))
                return
            if self.finite:
                subjects = self.subjects
            elif self.near(-1).tag == "object":
                # Before the verb, "the A and the B near the top" may speak of the B alone.
                subjects = self.subjects[-1:]
            else:
                subjects = self.subjects[self.group_start :]
            self.gapped |= not self.finite and (self.verbal or self._is_verbless(kind))
        for name in subjects:
            self.claims.append(self.claim(kind, (name,), value, affirmed, when, tag))
        if affirmed:
            self.share(kind, value, subjects, tag)

    def _is_verbless(self, kind: str) -> bool:
        """Whether the subject has a motion without a verb or participle."""
        previous = self.next_of(BOUNDARIES | {"object", "moving", "moves"}, -1)
        motion = kind in ("direction", "speed", "extent")
        return motion and previous.tag not in ("moving", "moves")
