"""Reads claims about candidates: what each shows, lacks, adds or displaces, and which one
agrees."""

from __future__ import annotations

from teacher.reading.grounding import TARGET
from teacher.reading.tagging import BOUNDARIES, Tag
from teacher.reading.topics import TopicReader

ERRORS = {"error", "errors", "mistake", "mistakes", "fault", "faults", "flaw", "flaws"}


class CandidateReader(TopicReader):
    """Collects claims about candidates and about the objects in them."""

    def end(self) -> None:
        if not self.lasting and len(self.letters) == 1 and not self.doubted:
            self._add_choice(self.letters[0])
        for claim in self.found:
            if claim.candidate != "":
                self.claims.append(claim)
            elif claim.kind == "region" and not self.lasting:
                # Before it names a candidate, an outcome describes the target.
                self.claims.append(claim._replace(candidate=None))

    def _add_choice(self, letter: str) -> None:
        """Record that a candidate agrees if an outcome names it alone and without an error."""
        named = {str(t.value) for t in self.sentence if t.tag == "candidate"}
        wrong = {c.candidate for c in self.found if c.kind == "agrees" and not c.affirmed}
        described = any(c.candidate == letter for c in self.found)
        if not described and named <= wrong | {letter}:
            tag = self.choice or self.sentence.tags[-1]
            self.found.append(self.claim("agrees", (), "", True, TARGET, tag, letter))

    # Claims about an object in a candidate.

    def on_region(self, tag: Tag) -> None:
        if self.skipped:
            return
        if not self.objects:
            if not (self.expected or self.negated):
                self.add_claim_of_any("region", tag)
            return
        if self.expected or self.negated:
            # The place where the object should be or is not, whatever the candidate.
            affirmed = self.contrasted or not (self.expected and self.negated)
            for name in self.objects:
                claim = self.claim("region", [name], str(tag.value), affirmed, TARGET, tag)
                self.found.append(claim)
        else:
            self.add_claim("region", str(tag.value), True, tag)

    on_into = on_region

    def on_direction(self, tag: Tag) -> None:
        if self.near(-1).words != "from" and not self.expected and not self.negated:
            if self.objects:
                self.add_claim("displaced", str(tag.value), True, tag)
            elif self.near(-1).tag in ("off", "slight", "clear"):
                self.add_claim_of_any("displaced", tag)

    def on_off(self, tag: Tag) -> None:
        if not self.expected:
            self.add_claim("displaced", "", not self.negated, tag)

    def on_misplace(self, tag: Tag) -> None:
        self.moving = not self.negated

    def on_slight(self, tag: Tag) -> None:
        self._extent("slightly", tag)

    def on_clear(self, tag: Tag) -> None:
        if tag.words == "clearly":
            self._extent("clearly", tag)

    def _extent(self, extent: str, tag: Tag) -> None:
        beside = (self.near(1).tag, self.near(-1).tag)
        if not self.expected and not self.negated and {"off", "direction"} & set(beside):
            self.add_claim("displaced", extent, True, tag)

    def on_lack(self, tag: Tag) -> None:
        if not self.negated and not self.skipped:
            self.lacking = True

    def on_passed(self, tag: Tag) -> None:
        if tag.words.startswith("miss"):
            self.on_lack(tag)
        elif tag.words.startswith("avoid"):
            self.negated = True

    def on_moves(self, tag: Tag) -> None:
        # "A misses the move of the X."
        self.lacking = False

    on_moving = on_moves

    def on_future(self, tag: Tag) -> None:
        self.skipped |= tag.words == "would"

    def on_gone(self, tag: Tag) -> None:
        if self.near(1).tag == "object":
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

    def on_strangers(self, tag: Tag) -> None:
        if self.lacking or self.near(1).tag in ("region", "off", "direction", "expected"):
            self.lacking = False
        elif not self.skipped:
            self.add_candidate_claim("other objects", not self.negated, tag)
        self.objects, self.adding = [], False

    # Claims about a whole candidate.

    def on_agree(self, tag: Tag) -> None:
        if self.near(1).tag == "candidate" and self.is_compared(self.at + 1):
            # "D matches B in everything but the X."
            self.doubted = True
        elif self._is_choice_ahead():
            self.passing = not self.negated
        elif not self.letters:
            self.passing = not self.negated and not (self.lasting and self.objects)
        elif not self.objects and not self._is_partial():
            self.add_candidate_claim("agrees", not (self.negated or self.refused), tag)

    def _is_choice_ahead(self) -> bool:
        """Whether the candidate named next is the one that agrees: "the answer is therefore B"."""
        stop = self.sentence.skip(self.at + 1, {"be", "word", "break", "future"})
        copula = any(t.tag in ("be", "future") for t in self.sentence.tags[self.at + 1 : stop])
        return copula and self.sentence[stop].tag == "candidate"

    def on_differ(self, tag: Tag) -> None:
        self.doubted = True
        if tag.words.startswith("differ") and self._is_between():
            # "A and B differ in the X", "A differs from B in the X."
            return
        if self.lacking:
            # "D does not have the error of C."
            self.lacking = False
        elif self.objects and self.near(-1).tag == "comma" and tag.words in ERRORS:
            # "It is near the left, an error not seen in B."
            self.objects, self.skipped = [], True
        elif not self.objects and not self.negated:
            self.add_candidate_claim("agrees", False, tag)

    def _is_between(self) -> bool:
        """Whether the candidates differ from each other."""
        if self.next_of(BOUNDARIES | {"object", "candidate"}).tag == "candidate":
            return True
        return len(self.letters) > 1 and self.near(1).tag != "ignore"

    def _is_partial(self) -> bool:
        """Whether an agreement is limited to an object or has an exception."""
        rest = {tag.tag for tag in self.sentence.tags[self.at + 1 :]}
        if rest & {"lack", "gone", "off", "differ", "misplace", "extra"}:
            return True
        limit = self.sentence[self.sentence.skip(self.at + 1, {"by", "word", "with"})]
        return limit.tag == "object"
