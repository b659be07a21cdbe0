"""Reads sentences about the scene: where its objects are, how they move, and what meets."""

from __future__ import annotations

from itertools import pairwise

from teacher.reading.grounding import BETWEEN, CUT, EITHER, TARGET
from teacher.reading.pairs import RELATIONS, PairReader
from teacher.reading.phrases import COARSE, COLUMNS, MIDDLE, ROWS
from teacher.reading.reader import BOUNDARIES, END, MOST, Names
from teacher.reading.tagging import Tag

VERBS = {"be", "moves", "stays", "rest", "future", "across", "leaves", "enters", "still", "past"}
"""Tags of words that may be a clause's verb."""
STILL_VERBS = {
    *("does", "do", "did", "is", "are", "has", "have", "shows", "show", "keeps", "keep"),
    *("rest", "rests", "stand", "stands", "sit", "sits", "lie", "lies"),
}
"""Opening words of phrases for rest that hold a verb ("does not move", but not "at rest")."""
SAID = {"from", "region", "direction", "speed", "still", "moving", "rest", "out", "hidden"}
"""Tags of what may be said of an object before it is named."""
OPENING = SAID | {"into", "toward", "slight", "word", "by", "be", "comma", "pronoun", "future"}
OPENING |= {"expected"}
"""Tags that may stand between a clause's beginning and a subject that comes late."""
INVERTED = {"be", "still", "rest", "future", "expected", "word"}
"""Tags of a verb before its subject: "near the top is the A"."""
DENYING = {"not", "be", "moves", "moving", "contrast", "still"}
"""Tags between which and a negation a direction is denied: "does not move east"."""
TAKERS = {"by", "close", "meet", "passed", "contact", "between", "course", "show"}
"""Tags before a noun phrase that is no subject."""
ASIDE = {"unlike", "besides", "despite", "except", "excepting", "apart", "beside", "given"}
"""Words before a noun phrase that is only set against the subject."""
WAS = {"was", "were", "had"}
"""Opening words of phrases of the past that are verbs."""
SIDE_WORDS = {*ROWS, *COLUMNS, *MIDDLE}


class SceneReader(PairReader):
    """Follows the subject through a sentence, and holds what is said of it."""

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

    # Who is spoken of.

    def on_object(self, tag: Tag) -> None:
        previous = self.near(-1)
        relation = self.relation
        if relation and relation.between and len(relation.partners) < 2:
            names, _ = self.group(2)
            relation.partners += names
            self.last = names[-1:]
            return
        if self._is_complement(previous):
            self._complement()
            return
        self.verbal |= self.finite
        if self._is_relative(previous):
            self.flush()
            self.last = self.group()[0]
            self.inner = previous.tag != "which"
            # What is done to "the A, which the B hits" is not told apart.
            self.subjects, self.group_start = self.last if self.inner else [None], 0
            self.finite = self.blocked = self.nobody = self.gapped = False
            self.pending = []
            return
        fresh = self.finite or not self.subjects or self.nobody
        fresh |= self.pronominal or self.gapped
        # "Near the top is the A, and the B ..." places the A alone.
        names, _ = self.group(1 if self.pending and self._parted() else MOST)
        self.subjects = names if fresh else [*self.subjects, *names][-MOST:]
        self.group_start = 0 if fresh else max(0, len(self.subjects) - len(names))
        self.last = names[-1:]
        # "With the A at rest, the B ...": the A's part ends with the comma.
        self.absolute = previous.tag == "with"
        inverted = bool(self.pending) and previous.tag in INVERTED
        self.finite, self.blocked, self.nobody, self.complement = inverted, False, False, False
        self.pronominal = self.gapped = False
        if relation and not relation.subjects:
            relation.subjects = self.subjects
        # "Near the top, the A and the B are close" places the pair, not its objects.
        self._settle(places=not self._is_pair_ahead())

    def _is_relative(self, previous: Tag) -> bool:
        """Whether the noun phrase is the subject of a clause about another object or a place:
        "the A, which the B hits", "where the B was"."""
        if self.word(previous) == "where":
            return True
        step = -2
        while self.near(step).tag in ("by", "comma"):
            step -= 1
        places = ("object", "region", "into", "from")
        return previous.tag == "which" and self.near(step).tag in places

    def _settle(self, places: bool) -> None:
        """Tell of the subject what was said before it was named."""
        for pending in self.pending:
            if places or pending[0] != "region":
                self._tell(*pending, subjects=self.subjects)
        self.pending = []

    def _is_pair_ahead(self) -> bool:
        step = 1
        while self.near(step).tag not in ("comma", "semicolon", "break", "stop", "close"):
            step += 1
        return self.near(step).tag == "close"

    def _parted(self) -> bool:
        return self.near(1).tag == "comma" and self.near(2).tag == "and"

    def _is_complement(self, previous: Tag) -> bool:
        if previous.tag == "with":
            # "With the A near the top, ..." tells of the A.
            return self.near(-2) is not END and self.near(-2).tag not in BOUNDARIES
        if previous.tag == "contrast" and self.subjects:
            # "The A, rather than the B, ..."
            return True
        return previous.tag in TAKERS or self.word(previous) in ASIDE

    def _complement(self) -> None:
        start = self.at
        # "Meets the A, and the B ...": the B begins a clause.
        names, _ = self.group(1 if self._parted() else MOST)
        if len(names) > 1 and self.near(1).tag in VERBS | {"not", "word", "show", "speed"}:
            # "meets the A and the B stays": the B is a subject of its own.
            self.at = start
            names, _ = self.group(1)
        if self.relation and not self.relation.partners:
            self.relation.partners = names
        elif self.near(-1).tag == "with" or self.sentence[start - 1].tag == "with":
            self.companions = names
        if self.sentence[start - 1].tag != "contrast":
            self.last = names[-1:]
        self.blocked, self.crossed, self.complement = True, False, True

    def on_which(self, tag: Tag) -> None:
        self.relative = True
        if self.near(-1).tag == "object" or self.near(-2).tag == "object":
            self.flush()
            several = len(self.subjects) - self.group_start > 1 and not self.complement
            self.subjects = [None] if several else self.last
            self.finite = self.blocked = False
            self.group_start = 0

    def on_pronoun(self, tag: Tag) -> None:
        previous = self.near(-1)
        if previous.tag in ("by", "with", "close", "meet", "passed", "between", "course"):
            self._refer(previous, tag)
            return
        if self.word(tag) in ("itself", "themselves") and previous.tag == "comma":
            # "Pushes the B east, itself going west."
            self.subjects, self.group_start = [None], 0
            return
        done = previous.tag == "word" and self.word(previous).endswith(("s", "ed", "ing"))
        if done and self.word(previous) not in ("joins", "joining"):
            # "The A pushes it east": what follows is of another than the A.
            self.subjects, self.group_start = [None], 0
            return
        possessive = self.word(tag) in ("its", "their") or self.near(1).tag == "object"
        if previous.tag == "object" or possessive or (previous.tag in VERBS and self.subjects):
            return
        self.verbal |= self.finite
        self.subjects = [None] if self._is_ahead() else self._antecedent(str(tag.value))
        self.pronominal, self.gapped = True, False
        self.group_start = 0
        self.finite = self.blocked = self.nobody = False
        self._settle(places=False)

    def _antecedent(self, pronoun: str) -> Names:
        """Whom a pronoun stands for where that is safe to say, else None."""
        subjects = self.subjects or self.before
        if pronoun == "it":
            return list(subjects) if len(subjects) == 1 and not self.complement else [None]
        if pronoun in ("former", "latter"):
            pair = self.both()
            return [pair[pronoun == "latter"]] if len(pair) == 2 else [None]
        return self.both()

    def _is_ahead(self) -> bool:
        """Whether a pronoun may stand for whom the next clause names: "although it was at rest,
        the A moves"."""
        opening = self.sentence[: self.at]
        subordinate = any(t.tag in ("break", "maybe", "by") for t in opening)
        return subordinate and all(t.tag != "object" for t in opening)

    def _refer(self, previous: Tag, tag: Tag) -> None:
        """A pronoun that is no subject."""
        relation = self.relation
        self.complement = True
        if relation and not relation.partners:
            relation.partners = [None]
            if previous.tag == "between":
                pair = self.both()
                relation.partners = pair if len(pair) == 2 else [None, None]

    def on_rest_of(self, tag: Tag) -> None:
        if self._is_complement(self.near(-1)):
            if self.relation:
                self.relation.partners = [None]
            return
        if self.word(tag).endswith("scene") and self.near(-1).tag in ("word", "across", "moves"):
            # "Has crossed the scene."
            return
        self.subjects, self.group_start = [None], 0
        self.finite = self.blocked = self.nobody = False

    def on_all(self, tag: Tag) -> None:
        self.on_rest_of(tag)
        names = list(dict.fromkeys(self.mentioned))
        taken = any(
            t.tag in TAKERS and following.tag == "object"
            for t, following in pairwise(self.sentence)
        )
        if self.word(tag) == "all of them" and None not in names and len(names) > 1 and not taken:
            self.subjects = names

    on_no_other = on_rest_of

    def on_none(self, tag: Tag) -> None:
        if self.near(-1).tag in RELATIONS | {"by", "with"}:
            self.relation = None
            return
        self.subjects, self.nobody, self.finite, self.pending = [], True, False, []

    def on_candidate(self, tag: Tag) -> None:
        self.subjects = [None]

    # What is said of one object.

    def on_region(self, tag: Tag, when: str = "") -> None:
        relation = self.relation
        if relation:
            if relation.kind == "close":
                self.close_region(relation, tag)
            return
        if self.negated and self._is_kept(tag):
            self._tell("region", str(tag.value), True, EITHER, tag)
            return
        if self.negated and self.near(-1).tag not in ("not", "be", "future", "contrast"):
            return
        if self.near(1).tag == "and" and self.near(2).value in SIDE_WORDS:
            # "Near the left and the right are ..." gives each its own.
            return
        unplaced = self.near(1).tag == "be" and self.word(tag).startswith("the ")
        if unplaced or self.near(1).tag == "none":
            # "The top is empty", "near the top nothing remains."
            return
        if any(self.near(-k).tag == "leaves" and self._is_bare(self.near(-k)) for k in (1, 2, 3)):
            # "Leaves the area near the top."
            return
        ahead = self.near(1).tag
        if self.near(-1).tag in ("semicolon", "break") and ahead in ("pronoun", "object"):
            if ahead == "object":
                self.pending.append(("region", str(tag.value), True, when or self.moment, tag))
            return
        if not when:
            when = TARGET if self.future else CUT if self.past else self.moment
            if self._is_former():
                when = CUT
            elif self.near(-1).tag == "object" and self.moment == TARGET:
                # "The A near the top will be near the left."
                when = EITHER
        self._tell("region", str(tag.value), not self.negated, when, tag)

    def _is_kept(self, tag: Tag) -> bool:
        """Whether a negation leaves a region standing: "has not moved from near the top", "does
        not leave its place near the top", "nor has the A near the top"."""
        previous = self.near(-1)
        if tag.tag == "from":
            return previous.tag in ("moves", "moving")
        if previous.tag == "object":
            return not self.blocked and self.word(self.near(-2)) not in ("is", "are", "be")
        return any(
            self.near(-k).tag == "leaves" and self._is_bare(self.near(-k)) for k in (1, 2, 3)
        )

    def _is_former(self) -> bool:
        """Whether a word after the current one puts it before the target: "out of view before"."""
        return self.near(1).tag == "past" or self.word(self.near(1)) == "before"

    def on_into(self, tag: Tag) -> None:
        self.on_region(tag, CUT if self.moment == CUT and not self.moved else TARGET)

    def on_from(self, tag: Tag) -> None:
        self.on_region(tag, CUT)

    def on_direction(self, tag: Tag) -> None:
        if self.word(self.near(-1)) == "from" or self.word(self.near(1)) in ("of", "from"):
            return
        if self.relation:
            return
        if self.negated and self.near(-1).tag not in DENYING:
            return
        when = self.moment
        if when != CUT:
            # "Toward the east, the A shifts slightly" tells the way from cut to target.
            ahead = not self.subjects and any(t.tag in ("slight", "across") for t in self.sentence)
            when = BETWEEN if self.slight or ahead else EITHER
        self._tell("direction", str(tag.value), not self.negated, when, tag)

    def on_speed(self, tag: Tag) -> None:
        following = self.near(1).tag
        moving = self.moved or following in ("moves", "moving", "across")
        if not moving or self.relation or following in RELATIONS:
            return
        self._tell("speed", str(tag.value), not self.negated, CUT, tag)

    def on_still(self, tag: Tag) -> None:
        if "not" in self.word(tag).split() and self.near(1).tag in ("direction", "speed"):
            # "Does not move east."
            self.negated = self.moved = True
            self.verb()
            return
        if self.word(tag).split()[0] in STILL_VERBS:
            self.verb()
        when = self.moment
        if when != CUT and (self.staying or self.future):
            when = BETWEEN
        elif when == TARGET:
            when = EITHER
        self._tell("still", "", not self.negated, when, tag)

    def on_rest(self, tag: Tag) -> None:
        if self.near(1).tag in BOUNDARIES:
            self.verb()
        if self.near(-1).tag == "object" or self.near(-1).tag == "and":
            self.on_still(tag)

    def on_moves(self, tag: Tag) -> None:
        self.moved = True
        self.verb()
        self.on_moving(tag)

    def on_moving(self, tag: Tag) -> None:
        self.moved = True
        self.slight |= self.word(tag) in ("moved", "traveled", "travelled", "rolled")
        if self.negated and self.near(1).tag in BOUNDARIES:
            when = CUT if self.moment == CUT else EITHER
            self._tell("still", "", True, when, tag)

    def on_off(self, tag: Tag) -> None:
        self.moved = True

    def on_slight(self, tag: Tag) -> None:
        if self.moved or self.near(1).tag in ("moves", "moving", "off"):
            self.slight = True
            self._tell("extent", "shifts slightly", not self.negated, BETWEEN, tag)

    def on_across(self, tag: Tag) -> None:
        self.moved = self.slight = True
        self.verb()
        self._tell("extent", "moves across", not self.negated, BETWEEN, tag)

    def on_put(self, tag: Tag) -> None:
        clause = self.word(tag).split()[0] in ("where", "in", "as", "nearly", "almost", "roughly")
        if not clause or self.staying:
            self.verb()
            if self.moment == CUT:
                self.on_still(tag)
                return
            value = COARSE if tag.value == COARSE else "stays"
            self._tell("extent", value, not self.negated, BETWEEN, tag)

    def on_leaves(self, tag: Tag) -> None:
        self.verb()
        if not self._is_bare(tag) or self.near(1).tag in BOUNDARIES:
            self._event("leaves", tag)

    def _is_bare(self, tag: Tag) -> bool:
        """Whether "leaves" or its like stands without what is left."""
        return " " not in self.word(tag)

    def _event(self, kind: str, tag: Tag) -> None:
        # What has not happened by the cut may happen later.
        when = CUT if self.negated and self.moment == CUT and not self.future else BETWEEN
        self._tell(kind, "", not self.negated, when, tag)

    def on_enters(self, tag: Tag) -> None:
        self.verb()
        if not self._is_bare(tag) or self.near(1).tag in (*BOUNDARIES, "region"):
            self._event("enters", tag)

    def on_out(self, tag: Tag) -> None:
        self._sight("out of view", tag)

    def on_hidden(self, tag: Tag) -> None:
        self._sight("hidden", tag)

    def on_unseen(self, tag: Tag) -> None:
        if self.word(tag).startswith("cannot"):
            self.verb()
        self._sight("unseen", tag)

    def on_gone(self, tag: Tag) -> None:
        words = self.word(tag).split()
        if words[0] in ("is", "are", "cannot"):
            self.verb()
        if words[-1] in ("view", "visible", "seen", "shown"):
            self._sight("unseen", tag)

    def _sight(self, value: str, tag: Tag) -> None:
        when = TARGET if self.future else self.moment
        if self.past or self.near(-1).tag == "by" or self._is_former():
            when = EITHER
        self._tell("sight", value, not self.negated, when, tag)

    def _tell(
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
