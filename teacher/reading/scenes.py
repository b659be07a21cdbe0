"""Reads sentences about the scene: the places, motions and meetings of its objects."""

from __future__ import annotations

from dynapix.teacher.predicates.facts import COMPASS, OUT_OF_VIEW
from dynapix.teacher.predicates.relations import CHANGES, KINDS
from dynapix.teacher.reading.claims import BETWEEN, COARSE, CUT, EITHER, TARGET
from dynapix.teacher.reading.clauses import ClauseReader
from dynapix.teacher.reading.reader import ENDS, UnreadableError
from dynapix.teacher.reading.tagging import COLOR_WORDS, MATERIAL_WORDS, Tag

STILL_VERBS = {
    *("is", "are", "was", "do", "does", "did", "have", "has", "show", "shows", "keep", "keeps"),
    *("rest", "rests", "stand", "stands", "sit", "sits", "lie", "lies"),
    *("stay", "stays", "remain", "remains"),
}
"""First words of the phrases of the tag "still" that contain a verb."""
OF_MATERIAL = ("of", "in", "made of", "made from")
AFTER_HAVE = {
    *("moving", "be", "not", "in_place", "stays", "moves", "past", "across", "slight", "both"),
    *("enters", "leaves"),
}
"""Tags after "has" where it is an auxiliary."""
OF_MOTION = {"from", "into", "speed", "direction"}
"""Tags after "comes" where it is a verb of motion."""
SIDES = {"left": "west", "right": "east", "top": "north", "bottom": "south"}


class SceneReader(ClauseReader):
    """Records claims about the subject of each clause."""

    def on_be(self, tag: Tag) -> None:
        self.verb(tag)

    def on_future(self, tag: Tag) -> None:
        self.verb(tag)
        self.clause.future = True

    on_expected = on_future

    def on_past(self, tag: Tag) -> None:
        self.verb(tag)
        self.clause.past = True

    def on_not(self, tag: Tag) -> None:
        if self.clause.kind != "objects" or self.clause.negated:
            raise UnreadableError
        self.clause.negated = True

    def on_both(self, tag: Tag) -> None:
        count = len({*self.clause.subjects, *self.carried})
        if count < 2 or (tag.words == "both" and count > 2):
            raise UnreadableError

    # Places and motions.

    def on_region(self, tag: Tag) -> None:
        clause = self.clause
        if clause.event == "close":
            self._add_close_region(tag)
        elif clause.kind == "contact":
            self.add("close region", [], tag.value, True, self.moment, tag)
        elif clause.event and self.peek(-2).name == "object":
            # "Meets the red cube near the top": the place of either.
            raise UnreadableError
        else:
            self.state("region", tag.value, self.when, tag)

    def on_into(self, tag: Tag) -> None:
        side = tag.last_word
        if not self.clause.moving:
            value = COARSE + tag.value.lstrip(COARSE) if side in SIDES else tag.value
            self.state("region", value, self.when, tag)
        elif side in SIDES and "near" not in tag.words and "-" not in tag.value:
            self._add_direction(COARSE + SIDES[side], tag)
        else:
            self.state("region", tag.value, TARGET, tag)

    def on_toward(self, tag: Tag) -> None:
        heading = "".join(SIDES.get(word, "") for word in tag.value.replace("-", " ").split())
        if heading not in COMPASS:
            raise UnreadableError
        self._add_direction(COARSE + heading, tag)

    def on_from(self, tag: Tag) -> None:
        if self.clause.negated:
            raise UnreadableError
        self.state("region", tag.value, CUT, tag)

    def on_relation(self, tag: Tag) -> None:
        value, partners = tag.value.value, self.find_partners(tag)
        if value == "passes" and (denial := self.take("no_contact")):
            self.add_event("meeting", denial, self.clause.subjects, partners, False)
            return
        kind, self.last_nouns = KINDS[value], partners
        if kind in CHANGES:
            self.verb(tag._replace(name="moves"))
        if self.clause.kind != "objects":
            raise UnreadableError
        when = BETWEEN if kind in CHANGES else self.when
        self.clause.has_complement = True
        for name in self.clause.subjects:
            self.add(kind, [name, *partners], value, not self.clause.negated, when, tag)

    def on_show(self, tag: Tag) -> None:
        if tag.last_word not in ("has", "have", "having"):
            raise UnreadableError
        self.verb(tag)
        if self.peek().name in AFTER_HAVE:
            # "Has moved" is a path up to the target; "has been near the top" is not.
            self.clause.on_path |= self.peek().name in ("moving", "slight")
        elif possessed := self.read_possession(self.clause.subjects):
            self._add_possession(*possessed)
        else:
            raise UnreadableError

    def _add_possession(self, names: list[str], tag: Tag) -> None:
        value = tag.value.value
        self.add(KINDS[value], names, value, not self.clause.negated, self.when, tag)

    def on_with(self, tag: Tag) -> None:
        if tag.words in OF_MATERIAL and self.peek().name == "word":
            return
        if tag.words in ("toward", "towards") and self.peek().name == "object":
            self.on_approach(tag)
            return
        if tag.words == "to" and self.peek().name in ("moves", "be", "meet", "still", "stays"):
            return
        if tag.words != "with" or self.clause.negated:
            raise UnreadableError
        if possessed := self.read_possession(self.clause.subjects):
            self._add_possession(*possessed)
            return
        self.end_predicate()
        self.begin(self.read_subject())

    def on_word(self, tag: Tag) -> None:
        """Read the color or material in "is gray" and "of rubber"."""
        look = (COLOR_WORDS | MATERIAL_WORDS).get(tag.words)
        if look is None or self.clause.negated:
            raise UnreadableError
        for name in self.clause.subjects:
            named = name if look in name.split() else f"{look} {name}"
            self.add("mention", [named], "", True, CUT, tag)
        self.clause.said.add("mention")

    def on_direction(self, tag: Tag) -> None:
        self._add_direction(tag.value, tag)

    def _add_direction(self, value: str, tag: Tag) -> None:
        clause = self.clause
        when = self.moment
        if clause.past:
            when = CUT
        elif when != CUT or clause.future or clause.on_path:
            when = BETWEEN if clause.on_path or clause.future or clause.slight else EITHER
        self.state("direction", value, when, tag)

    def on_speed(self, tag: Tag) -> None:
        self.state("speed", tag.value, CUT, tag)

    def on_moves(self, tag: Tag) -> None:
        self.verb(tag)
        self.clause.moving = True
        if self.peek().name in ENDS and self.clause.slight is None:
            when = BETWEEN if self.clause.future else CUT if self.moment == CUT else EITHER
            self.state("still", "", when, tag, affirmed=False)

    def on_moving(self, tag: Tag) -> None:
        self.clause.on_path |= tag.value == "path"
        self.on_moves(tag)

    def on_still(self, tag: Tag) -> None:
        if tag.words.split()[0] in STILL_VERBS:
            self.verb(tag._replace(name="stays"))
        if "not" in tag.words and self.peek().name not in ENDS | {"region"}:
            # "Does not move east."
            raise UnreadableError
        later = self.clause.staying or self.clause.future
        when = CUT if self.moment == CUT and not later else BETWEEN if later else EITHER
        self.state("still", "", when, tag)

    def on_still_noun(self, tag: Tag) -> None:
        when = CUT if self.moment == CUT else EITHER
        for name in self.last_nouns:
            self.add("still", [name], "", True, when, tag)

    def on_stays(self, tag: Tag) -> None:
        self.verb(tag)
        self.clause.staying = True

    def on_in_place(self, tag: Tag) -> None:
        self.verb(tag._replace(name="stays"))
        if self.peek().name not in ENDS | {"region"}:
            # "Where it is close to the sphere."
            raise UnreadableError
        if self.moment == CUT and not self.clause.future:
            self.state("still", "", CUT, tag)
        else:
            self.state("extent", COARSE if tag.value == COARSE else "stays", BETWEEN, tag)

    def on_slight(self, tag: Tag) -> None:
        self.clause.slight = tag

    def on_across(self, tag: Tag) -> None:
        self.verb(tag)
        self.clause.moving = self.clause.on_path = True
        self.state("extent", "moves across", BETWEEN, tag)

    # Sight.

    def on_leaves(self, tag: Tag) -> None:
        self.verb(tag)
        # What has not happened by the cut may happen later.
        past = self.clause.negated and self.moment == CUT and not self.clause.future
        self.state(tag.name, "", CUT if past else BETWEEN, tag)

    on_enters = on_leaves

    def on_out(self, tag: Tag) -> None:
        self.state("sight", OUT_OF_VIEW if tag.name == "out" else tag.name, self.when, tag)

    on_hidden = on_out
    on_unseen = on_out

    def on_visible(self, tag: Tag) -> None:
        self.state("sight", "unseen", self.when, tag, affirmed=False)

    # Pairs.

    def on_course(self, tag: Tag) -> None:
        self.verb(tag)
        partners = self.read_list(True) if self.take("with") else self.read_partners("object")
        subjects = self.clause.subjects
        alone = len(subjects) == 1 and not partners
        self.add_event("course", tag, subjects, partners, value=tag.value, alone=alone)

    def on_approach(self, tag: Tag) -> None:
        self.verb(tag._replace(name="moves"))
        partners = self.read_list(True)
        self.add_event("course", tag, self.clause.subjects, partners, value=COARSE)

    def on_meet(self, tag: Tag) -> None:
        self.verb(tag)
        self.take("with")
        partners = self.read_partners("object", "both")
        self.add_event("meeting", tag, self.clause.subjects, partners)

    def on_no_contact(self, tag: Tag) -> None:
        self.verb(tag._replace(name="meet"))
        self.take("with")
        partners = self.read_partners("object")
        self.add_event("meeting", tag, self.clause.subjects, partners, False)

    def on_close(self, tag: Tag) -> None:
        partners = self.read_partners("object")
        self.add_event("close", tag, self.clause.subjects, partners, value=tag.value)

    def on_contact(self, tag: Tag) -> None:
        """Read "on the verge of contact"."""
        if self.clause.time is None:
            raise UnreadableError
        self.add_event("meeting", tag, self.clause.subjects, [])

    def on_occurs(self, tag: Tag) -> None:
        if self.clause.kind == "objects" and self.peek().name in OF_MOTION:
            # "Comes from near the left."
            self.verb(tag._replace(name="moves"))
            self.clause.moving = True
        elif self.clause.kind != "contact":
            raise UnreadableError
        self.clause.has_verb = True

    def on_time(self, tag: Tag) -> None:
        clause = self.clause
        clause.time = tag
        if clause.event == "meeting":
            for pair in clause.pairs:
                self.add("time", pair, tag.value, True, BETWEEN, tag)

    def _add_close_region(self, tag: Tag) -> None:
        """Record the region of a close pair, as in "they are very close near the top"."""
        if len(self.clause.pairs) != 1:
            raise UnreadableError
        when = TARGET if self.moment == TARGET or self.clause.future else EITHER
        after_object = self.peek(-2).name != "close"
        kind = "place of either" if after_object else "close region"
        self.add(kind, self.clause.pairs[0], tag.value, True, when, tag)
