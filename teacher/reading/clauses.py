"""Follows the clauses of a sentence about the scene: their bounds, verb, negation and moment."""

from __future__ import annotations

from teacher.reading.pairs import PairReader
from teacher.reading.reader import Names
from teacher.reading.tagging import BOUNDARIES, Tag

PRECEDING = {
    "from",
    "region",
    "relation",
    "direction",
    "speed",
    "still",
    "moving",
    "rest",
    "out",
    "hidden",
}
"""Tags of claims that may precede their subject, as in "near the top is the red cube"."""
OPENING = PRECEDING | {"into", "toward", "slight", "word", "by", "be", "comma", "pronoun", "future"}
OPENING |= {"expected"}
"""Tags that may lie between the start of a clause and such a late subject."""
WAS = {"was", "were", "had"}
"""First words of phrases of the tag "past" that contain a verb."""


class ClauseReader(PairReader):
    """Tracks the clauses of a sentence and records claims about their subjects."""

    def begin(self) -> None:
        self.previous_subjects = self.subjects
        """The subjects at the end of the previous sentence."""
        self.begin_pairs()
        self.list_start = 0
        """The index in `subjects` from which claims before the verb are about them: in "the cube
        near the top and the sphere, near the left, are at rest", that of the sphere."""
        self.pending: list[tuple[str, str, bool, str, Tag, tuple[str, ...]]] = []
        """Arguments of `add_claim` for claims that precede their subject."""
        self.has_verb = False
        """Whether the subject has its verb. The next noun phrase is then another subject."""
        self.blocked = self.complement = False
        """Whether the next words may be about an object that is not the subject ("the red cube
        meets the sphere and heads west"), and whether the clause has such an object."""
        self.after_boundary = False
        """Whether a comma or an "and" precedes, after which a verb belongs to the subject again."""
        self.mentions_motion = False
        """Whether the sentence has a word of motion, so that "quickly" is a speed."""
        self.in_with_phrase = False
        """Whether the next comma ends the clause: "with the red cube at rest, the sphere ..."."""
        self.antecedents: Names = []
        """The objects that "which" would refer to."""
        self.hypothetical = False
        """Whether the rest of the sentence depends on a condition such as "if"."""
        self.in_where_clause = False
        """Whether the clause is inside another and names a place: "where the red cube was"."""
        self.has_neither = self.has_which = False
        """Whether the sentence has had a "neither", and whether it has had a "which"."""
        self.is_pronoun = False
        """Whether the subject is a pronoun. Another noun phrase is then not added to it."""
        self.gapped = self.had_verb = False
        """Whether the subject has a claim without a verb, as in "the red cube moves east, the blue
        sphere west", and whether an earlier subject of the sentence had a verb."""
        self._cross_boundary()

    def end(self) -> None:
        self.end_pair_event()
        if [tag.name for tag in self.sentence.tags[-2:]] == ["not", "stop"]:
            # "They look set to meet, but they do not."
            self.claims = [c for c in self.claims if c.kind != "meeting"]

    def _cross_boundary(self) -> None:
        self.negated = self.staying = self.future = self.past = self.describes_path = False
        self.maybe = self.hypothetical
        self.after_boundary = True

    # Boundaries.

    def on_comma(self, tag: Tag) -> None:
        if not self.is_incomplete():
            self.end_pair_event()
            # "Neither the cube, which moves, nor the sphere": a denied claim about both follows.
            self.hypothetical |= self.has_neither and self.has_which
            self._cross_boundary()
            if self.in_where_clause and self.near(1).name != "break":
                self.subjects, self.list_start, self.in_where_clause = [None], 0, False
            self.has_verb |= self.in_with_phrase
            self.in_with_phrase = False
            if self.near(1).name == "region" and self.near(2).name == "object":
                self._open_clause()

    def on_semicolon(self, tag: Tag) -> None:
        self.end_pair_event()
        self._cross_boundary()
        self.has_verb = bool(self.subjects)
        self._open_clause()

    on_break = on_semicolon

    def on_and(self, tag: Tag) -> None:
        if not self.is_incomplete():
            self.end_pair_event()
            self.negated = self.describes_path = False
            self.after_boundary = True
            # "Near the left and near the right, the red cube ..." continues a list.
            listed = self.near(-1).name == self.near(1).name == "region"
            if not (listed and self.near(2).name == "comma"):
                self._open_clause()

    def _open_clause(self) -> None:
        """Drop the subject if the clause opens with a claim about a later subject, as in "and near
        the top is the red cube" and "while moving slowly, the red cube ..."."""
        stop = self.sentence.skip(self.cursor + 1, OPENING)
        opening = self.sentence.tags[self.cursor + 1 : stop]
        place = any(tag.words == "where" for tag in opening)
        precedes = any(tag.name in PRECEDING for tag in opening) and opening[-1].name != "by"
        if precedes and not place and self.sentence[stop].name == "object":
            self.start_clause([])

    def start_clause(self, subjects: Names, list_start: int = 0) -> None:
        """Begin a clause with these subjects and without a verb."""
        self.subjects, self.list_start = subjects, list_start
        self.has_verb = self.blocked = self.denied_subject = False

    # Function words.

    def on_not(self, tag: Tag) -> None:
        self.negated = True
        self.has_neither |= tag.words == "neither"

    on_contrast = on_not

    def on_maybe(self, tag: Tag) -> None:
        self.maybe = True
        self.hypothetical |= "if" in tag.words.split()

    def on_future(self, tag: Tag) -> None:
        self.future = True
        if tag.words == "would" and any(t.name == "maybe" for t in self.sentence):
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
        if self.near(-1).name == "object":
            # "The red cube bounces": an unknown word may be a verb, and one of motion.
            self.record_verb()
            self.mentions_motion |= str(tag.value).endswith("s")

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
        """Record that the clause has its verb."""
        if self.after_boundary:
            self.blocked = False
        if self.subjects or self.denied_subject:
            self.has_verb = True

    # Claims about the subject.

    def add_claim(
        self,
        kind: str,
        value: str,
        affirmed: bool,
        when: str,
        tag: Tag,
        subjects: Names | None = None,
        partners: tuple[str, ...] = (),
    ) -> None:
        """Record a claim, or keep it in `pending` if the clause has no subject yet.

        Args:
            partners: The other objects of a relation.
        """
        if self.maybe or self.blocked:
            return
        if subjects is None:
            if not self.subjects:
                if not self.denied_subject:
                    self.pending.append((kind, value, affirmed, when, tag, partners))
                return
            if self.has_verb:
                subjects = self.subjects
            elif self.near(-1).name == "object":
                # "The cube and the sphere near the top": perhaps only the sphere is near the top.
                subjects = self.subjects[-1:]
            else:
                subjects = self.subjects[self.list_start :]
            self.gapped |= not self.has_verb and (self.had_verb or self._is_verbless(kind))
        for name in subjects:
            names = (name, *partners)
            self.claims.append(self.claim(kind, names, value, affirmed, when, tag))
        if affirmed:
            self.record_shared(kind, value, subjects, tag)

    def _is_verbless(self, kind: str) -> bool:
        """Return whether the claim is a motion stated without a verb or participle."""
        previous = self.next_of(BOUNDARIES | {"object", "moving", "moves"}, -1)
        motion = kind in ("direction", "speed", "extent")
        return motion and previous.name not in ("moving", "moves")
