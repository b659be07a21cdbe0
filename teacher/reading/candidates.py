"""Reads claims about candidates: where they show objects, which objects they lack, add or displace,
and which candidate agrees with the target."""

from __future__ import annotations

from teacher.predicates.relations import KINDS
from teacher.reading.claims import TARGET
from teacher.reading.tagging import BOUNDARIES, RelationPhrase, Tag
from teacher.reading.topics import TopicReader

ERRORS = {"error", "errors", "mistake", "mistakes", "fault", "faults", "flaw", "flaws"}
TOUCHING = {"touching", "touches", "touch", "in contact"}
"""Words for a contact that a frame shows."""


class CandidateReader(TopicReader):
    """Reads sentences about candidates, and records claims about them and their objects."""

    def end(self) -> None:
        if not self.keeps_topic and len(self.letters) == 1 and not self.doubted:
            self._add_choice(self.letters[0])
        for claim in self.drafts:
            if claim.candidate != "":
                self.claims.append(claim)
            elif claim.kind == "region" and not self.keeps_topic:
                # A region that an outcome states before it names a candidate is about the target.
                self.claims.append(claim._replace(candidate=None))

    def _add_choice(self, letter: str) -> None:
        """Record that a candidate agrees if the sentence says nothing else about it, and names no
        other candidate except as wrong."""
        named = {str(t.value) for t in self.sentence if t.name == "candidate"}
        wrong = {c.candidate for c in self.drafts if c.kind == "agrees" and not c.affirmed}
        described = any(c.candidate == letter for c in self.drafts)
        if not described and named <= wrong | {letter}:
            tag = self.topic_tag or self.sentence.tags[-1]
            self.drafts.append(self.claim("agrees", (), "", True, TARGET, tag, letter))

    # Claims about an object in a candidate.

    def on_region(self, tag: Tag) -> None:
        if self.skipped:
            return
        if not self.objects:
            if not (self.expected or self.negated):
                self.add_claim_of_any("region", tag)
            return
        if self.expected or self.negated:
            # The place where the object should be or is not: a claim about the target.
            affirmed = self.contrasted or not (self.expected and self.negated)
            for name in self.objects:
                claim = self.claim("region", [name], str(tag.value), affirmed, TARGET, tag)
                self.drafts.append(claim)
        else:
            self.add_claim("region", str(tag.value), True, tag)

    on_into = on_region

    def on_relation(self, tag: Tag) -> None:
        partners = self.find_partners(tag)
        if possessed := self.find_possessed(tag):
            self.objects, partners = [possessed[0]], possessed[1:]
        if self.skipped or not self.objects or partners is None:
            return
        phrase = tag.value
        assert isinstance(phrase, RelationPhrase)
        kind = KINDS[phrase.value]
        if self.expected and not self.contrasted:
            # Where the object should be: a claim about the target.
            for name in self.objects:
                names = (name, *partners)
                claim = self.claim(kind, names, phrase.value, not self.negated, TARGET, tag)
                self.drafts.append(claim)
        else:
            denied = self.negated or self.contrasted
            self.add_claim(kind, phrase.value, not denied, tag, partners)

    def on_meet(self, tag: Tag) -> None:
        """Read "A shows the cube touching the sphere"; a frame does not show other meetings."""
        if tag.words not in TOUCHING or not self.objects or self.skipped or self.expected:
            return
        if self.near(1).name == "object" or self.near(2).name == "object":
            self.cursor += 1 if self.near(1).name == "object" else 2
            partners = self.read_list(1)
            if None not in partners:
                self.add_claim("gap", "against", not self.negated, tag, tuple(partners))

    def on_direction(self, tag: Tag) -> None:
        if self.near(-1).words != "from" and not self.expected and not self.negated:
            if self.objects:
                self.add_claim("displaced", str(tag.value), True, tag)
            elif self.near(-1).name in ("off", "slight", "clear"):
                self.add_claim_of_any("displaced", tag)

    def on_off(self, tag: Tag) -> None:
        if not self.expected:
            self.add_claim("displaced", "", not self.negated, tag)

    def on_misplace(self, tag: Tag) -> None:
        self.misplacing = not self.negated

    def on_slight(self, tag: Tag) -> None:
        self._add_extent("slightly", tag)

    def on_clear(self, tag: Tag) -> None:
        if tag.words == "clearly":
            self._add_extent("clearly", tag)
        elif tag.words == "far" and self.near(1).name == "off":
            self._add_extent("far", tag)

    def _add_extent(self, extent: str, tag: Tag) -> None:
        beside = (self.near(1).name, self.near(-1).name)
        if not self.expected and not self.negated and {"off", "direction"} & set(beside):
            self.add_claim("displaced", extent, True, tag)

    def on_lack(self, tag: Tag) -> None:
        if not self.negated and not self.skipped:
            self.lacking = True

    def on_no_contact(self, tag: Tag) -> None:
        if tag.words.startswith("miss"):
            self.on_lack(tag)
        elif tag.words.startswith("avoid"):
            self.negated = True

    def on_moves(self, tag: Tag) -> None:
        # "A misses the move of the red cube" does not say that the cube is missing.
        self.lacking = False

    on_moving = on_moves

    def on_future(self, tag: Tag) -> None:
        self.skipped |= tag.words == "would"

    def on_gone(self, tag: Tag) -> None:
        if self.near(1).name == "object":
            self.lacking = not self.negated
        elif not self.expected:
            self.add_claim("lacks", "", not self.negated, tag)

    def on_out(self, tag: Tag) -> None:
        if not self.expected:
            self.add_claim("lacks", "", not self.negated, tag)

    on_hidden = on_out
    on_unseen = on_out

    def on_extra(self, tag: Tag) -> None:
        if self.objects:
            self.add_claim("extra", "", True, tag)
        else:
            self.adding = True

    def on_adds(self, tag: Tag) -> None:
        self.adding = not self.negated

    def on_other_objects(self, tag: Tag) -> None:
        if self.lacking or self.near(1).name in ("region", "off", "direction", "expected"):
            self.lacking = False
        elif not self.skipped:
            self.add_candidate_claim("other objects", not self.negated, tag)
        self.objects, self.adding = [], False

    # Claims about a whole candidate.

    def on_agree(self, tag: Tag) -> None:
        if self.near(1).name == "candidate" and self.is_compared(self.cursor + 1):
            # "D matches B in everything but the red cube."
            self.doubted = True
        elif self._is_choice_ahead():
            self.choosing = not self.negated
        elif not self.letters:
            self.choosing = not self.negated and not (self.keeps_topic and self.objects)
        elif not self.objects and not self._is_partial():
            self.add_candidate_claim("agrees", not (self.negated or self.denies_candidate), tag)

    def _is_choice_ahead(self) -> bool:
        """Return whether the next candidate is said to agree: "the answer is therefore B"."""
        stop = self.sentence.skip(self.cursor + 1, {"be", "word", "break", "future"})
        copula = any(t.name in ("be", "future") for t in self.sentence.tags[self.cursor + 1 : stop])
        return copula and self.sentence[stop].name == "candidate"

    def on_differ(self, tag: Tag) -> None:
        self.doubted = True
        if tag.words.startswith("differ") and self._is_between():
            # "A and B differ in the red cube", "A differs from B in the red cube".
            return
        if self.lacking:
            # "D does not have the error of C."
            self.lacking = False
        elif self.objects and self.near(-1).name == "comma" and tag.words in ERRORS:
            # "It is near the left, an error not seen in B."
            self.objects, self.skipped = [], True
        elif not self.objects and not self.negated:
            self.add_candidate_claim("agrees", False, tag)

    def _is_between(self) -> bool:
        """Return whether candidates are said to differ from each other, not from the target."""
        if self.next_of(BOUNDARIES | {"object", "candidate"}).name == "candidate":
            return True
        return len(self.letters) > 1 and self.near(1).name != "ignore"

    def _is_partial(self) -> bool:
        """Return whether the agreement is limited to some objects or has an exception."""
        rest = {tag.name for tag in self.sentence.tags[self.cursor + 1 :]}
        if rest & {"lack", "gone", "off", "differ", "misplace", "extra"}:
            return True
        limit = self.sentence[self.sentence.skip(self.cursor + 1, {"by", "word", "with"})]
        return limit.name == "object"
