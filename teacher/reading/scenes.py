"""Reads claims about one object of the scene: its place, motion and visibility."""

from __future__ import annotations

from teacher.predicates.relations import CHANGES, KINDS
from teacher.reading.claims import BETWEEN, CUT, EITHER, TARGET
from teacher.reading.pairs import PAIR_TAGS
from teacher.reading.phrases import COARSE
from teacher.reading.subjects import SubjectReader
from teacher.reading.tagging import BOUNDARIES, COLUMNS, MIDDLE, ROWS, RelationPhrase, Tag

STILL_VERBS = {
    *("does", "do", "did", "is", "are", "has", "have", "shows", "show", "keeps", "keep"),
    *("rest", "rests", "stand", "stands", "sit", "sits", "lie", "lies"),
}
"""First words of the phrases of the tag "still" that contain a verb: "does not move", "rests"."""
DENYING = {"not", "be", "moves", "moving", "contrast", "still"}
"""Tags after which a direction in a negated clause is denied, as in "is not moving east"."""
SIDE_WORDS = {*ROWS, *COLUMNS, *MIDDLE}


class SceneReader(SubjectReader):
    """Reads sentences about the scene, and records claims about the subject of each clause."""

    def on_region(self, tag: Tag, when: str = "") -> None:
        event = self.pair_event
        if event:
            if event.kind == "close":
                self.add_close_region(event, tag)
            return
        previous, following = self.near(-1).name, self.near(1).name
        if self.negated and self._is_kept(tag):
            self.add_claim("region", str(tag.value), True, EITHER, tag)
            return
        if self.negated and previous not in ("not", "be", "future", "contrast"):
            return
        if following == "and" and self.near(2).value in SIDE_WORDS:
            # "Near the left and the right are ..." gives each object one place.
            return
        if following == "none" or (following == "be" and tag.words.startswith("the ")):
            # "The top is empty", "near the top nothing remains".
            return
        if self._is_place_left():
            return
        if previous in ("semicolon", "break") and following in ("pronoun", "object"):
            if following == "object":
                self.pending.append(("region", str(tag.value), True, when or self.moment, tag, ()))
            return
        if not when:
            when = TARGET if self.future else CUT if self.past else self.moment
            if self._is_former():
                when = CUT
            elif previous == "object" and self.moment == TARGET:
                # "The red cube near the top will be near the left."
                when = EITHER
        self.add_claim("region", str(tag.value), not self.negated, when, tag)

    def _is_kept(self, tag: Tag) -> bool:
        """Return whether the negation affirms the region: "has not moved from near the top"."""
        previous = self.near(-1)
        if tag.name == "from":
            return previous.name in ("moves", "moving")
        if previous.name == "object":
            return not self.blocked and self.near(-2).words not in ("is", "are", "be")
        return self._is_place_left()

    def _is_place_left(self) -> bool:
        """Return whether an object leaves the region, as in "leaves its place near the top"."""
        verbs = self.sentence.tags[max(0, self.cursor - 3) : self.cursor]
        return any(tag.name == "leaves" and self._is_single_word(tag) for tag in verbs)

    def _is_former(self) -> bool:
        """Return whether the next tag dates the claim earlier, as in "out of view before"."""
        return self.near(1).name == "past" or self.near(1).words == "before"

    def on_relation(self, tag: Tag) -> None:
        if self.pair_event:
            return
        phrase = tag.value
        assert isinstance(phrase, RelationPhrase)
        kind = KINDS[phrase.value]
        partners = self.find_partners(tag)
        if possessed := self.find_possessed(tag):
            self.blocked = False
            self.start_clause([possessed[0]])
            partners = possessed[1:]
        if kind in CHANGES:
            self.record_verb()
        if partners is None:
            return
        if kind in CHANGES:
            when = BETWEEN
        else:
            when = TARGET if self.future else CUT if self.past else self.moment
        self.add_claim(kind, phrase.value, not self.negated, when, tag, partners=partners)

    def on_into(self, tag: Tag) -> None:
        self.on_region(tag, CUT if self.moment == CUT and not self.mentions_motion else TARGET)

    def on_from(self, tag: Tag) -> None:
        self.on_region(tag, CUT)

    def on_direction(self, tag: Tag) -> None:
        previous, following = self.near(-1), self.near(1)
        if self.pair_event or previous.words == "from" or following.words in ("of", "from"):
            return
        if self.negated and previous.name not in DENYING:
            return
        when = self.moment
        if when != CUT:
            # "Toward the east, the red cube shifts slightly" describes the path to the target.
            ahead = not self.subjects and any(t.name in ("slight", "across") for t in self.sentence)
            when = BETWEEN if self.describes_path or ahead else EITHER
        self.add_claim("direction", str(tag.value), not self.negated, when, tag)

    def on_speed(self, tag: Tag) -> None:
        following = self.near(1).name
        moving = self.mentions_motion or following in ("moves", "moving", "across")
        # "The red cube is quick."
        moving |= self.near(-1).name == "be" and following in BOUNDARIES
        if not moving or self.pair_event or following in PAIR_TAGS:
            return
        self.add_claim("speed", str(tag.value), not self.negated, CUT, tag)

    def on_still(self, tag: Tag) -> None:
        if "not" in tag.words.split() and self.near(1).name in ("direction", "speed"):
            # "Does not move east" does not say that the object is still.
            self.negated = self.mentions_motion = True
            self.record_verb()
            return
        if tag.words.split()[0] in STILL_VERBS:
            self.record_verb()
        when = self.still_moment
        if when != CUT and (self.staying or self.future):
            when = BETWEEN
        self.add_claim("still", "", not self.negated, when, tag)

    def on_rest(self, tag: Tag) -> None:
        if self.near(1).name in BOUNDARIES:
            self.record_verb()
        if self.near(-1).name in ("object", "and"):
            self.on_still(tag)

    def on_moves(self, tag: Tag) -> None:
        self.record_verb()
        self.on_moving(tag)

    def on_moving(self, tag: Tag) -> None:
        self.mentions_motion = True
        self.describes_path |= tag.words in ("moved", "traveled", "travelled", "rolled")
        if self.negated and self.near(1).name in BOUNDARIES:
            self.add_claim("still", "", True, self.still_moment, tag)

    def on_off(self, tag: Tag) -> None:
        self.mentions_motion = True

    def on_slight(self, tag: Tag) -> None:
        if self.mentions_motion or self.near(1).name in ("moves", "moving", "off"):
            self.describes_path = True
            self.add_claim("extent", "shifts slightly", not self.negated, BETWEEN, tag)

    def on_across(self, tag: Tag) -> None:
        self.mentions_motion = self.describes_path = True
        self.record_verb()
        self.add_claim("extent", "moves across", not self.negated, BETWEEN, tag)

    def on_in_place(self, tag: Tag) -> None:
        clause = tag.words.split()[0] in ("where", "in", "as", "nearly", "almost", "roughly")
        if not clause or self.staying:
            self.record_verb()
            if self.moment == CUT:
                self.on_still(tag)
                return
            value = COARSE if tag.value == COARSE else "stays"
            self.add_claim("extent", value, not self.negated, BETWEEN, tag)

    def on_leaves(self, tag: Tag) -> None:
        self._add_crossing("leaves", tag, BOUNDARIES)

    def on_enters(self, tag: Tag) -> None:
        self._add_crossing("enters", tag, BOUNDARIES | {"region"})

    def _is_single_word(self, tag: Tag) -> bool:
        """Return whether the tag is one word: "leaves", but not "leaves the view"."""
        return " " not in tag.words

    def _add_crossing(self, kind: str, tag: Tag, ends: set[str]) -> None:
        """Record that the subject leaves or enters the view. A single word such as "leaves" counts
        only if a tag in `ends` follows, because it may have an object ("leaves its place")."""
        self.record_verb()
        if not self._is_single_word(tag) or self.near(1).name in ends:
            # An event that has not happened by the cut may happen later.
            when = CUT if self.negated and self.moment == CUT and not self.future else BETWEEN
            self.add_claim(kind, "", not self.negated, when, tag)

    def on_out(self, tag: Tag) -> None:
        self._add_sight("out of view", tag)

    def on_hidden(self, tag: Tag) -> None:
        self._add_sight("hidden", tag)

    def on_unseen(self, tag: Tag) -> None:
        if tag.words.startswith("cannot"):
            self.record_verb()
        self._add_sight("unseen", tag)

    def on_gone(self, tag: Tag) -> None:
        words = tag.words.split()
        if words[0] in ("is", "are"):
            self.record_verb()
        if words[-1] in ("view", "visible", "seen", "shown"):
            self._add_sight("unseen", tag)

    def _add_sight(self, value: str, tag: Tag) -> None:
        when = TARGET if self.future else self.moment
        if self.past or self.near(-1).name == "by" or self._is_former():
            when = EITHER
        self.add_claim("sight", value, not self.negated, when, tag)
