"""Tracks the candidate that a sentence is about, and the candidate's object."""

from __future__ import annotations

from teacher.reading.grounding import TARGET, Claim, Ground
from teacher.reading.reader import BOUNDARIES, END, Names, Reader
from teacher.reading.tagging import Tag

COMPARED = {"of", "as", "like", "with", "what", "to", "does", "same"}
"""Words before a candidate that serves only as a comparison."""
ASIDE = {"unlike", "like", "than", "besides", "beyond", "except"}
"""Words before a candidate that is never the topic."""
LISTED_AFTER = {"lack", "gone", "show", "stays", "misplace", "adds"}
"""Tags after which an object is one that the candidate shows or lacks."""
COMPARING = {
    *("compared", "comparison", "similar", "similarly", "identical", "equal", "relative", "akin"),
    *("as", "contrasted", "next", "like", "unlike", "than"),
}
"""Words before such a word that do not change the topic."""
EXCEPTING = {"but", "except", "save"}
PARTED = ("in", "from", "by", "for")
"""Words before the candidate that the clause has been about."""


class TopicReader(Reader):
    """Distinguishes the candidate that a clause is about from those it is compared with."""

    shows_extras = True

    def __init__(self, text: str, ground: Ground, lasting: bool) -> None:
        """`lasting`: a candidate stays the topic in later sentences."""
        super().__init__(text, ground)
        self.lasting = lasting
        self.letters: tuple[str, ...] = ()
        self.two: tuple[str, ...] = ()
        """The two candidates that "the former" and "the latter" refer to."""

    def begin(self) -> None:
        if not self.lasting:
            self.letters = ()
        self.found: list[Claim] = []
        self.objects: Names = []
        self.kept: Names = []
        self.clause = 0
        self.lacking = self.adding = self.moving = self.skipped = self.passing = False
        self.choice: Tag | None = None
        self.named_any = False
        self.doubted = False
        self._boundary()

    def _boundary(self) -> None:
        self.negated = self.expected = self.skipped = self.contrasted = self.refused = False
        self.clause = len(self.found)

    # Boundaries and function words.

    def on_comma(self, tag: Tag) -> None:
        # "Unlike A, where it is near the left, ..." is still about A.
        aside = self.skipped and (
            self.near(1).tag in ("which", "put", "ignore")
            or (self.near(1).tag == "word" and self.near(1).value != "there")
        )
        self._boundary()
        self.skipped = aside

    def on_semicolon(self, tag: Tag) -> None:
        self._boundary()

    def on_break(self, tag: Tag) -> None:
        if self.word(tag) != "so" or self.word(self.near(-1)) not in ("do", "does"):
            self._boundary()

    def on_be(self, tag: Tag) -> None:
        # "Had A shown the X, ..."
        self.skipped |= self.near(-1) is END and self.word(tag) == "had"

    def on_leaves(self, tag: Tag) -> None:
        # "B does not leave the X near the top."
        self.skipped |= self.negated

    on_show = on_leaves

    def on_word(self, tag: Tag) -> None:
        if tag.value in ("first", "second") and self.two and self.near(1).tag != "object":
            self._choose_of_two(tag.value == "second")

    def on_and(self, tag: Tag) -> None:
        self._boundary()

    def on_not(self, tag: Tag) -> None:
        self.negated = self.doubted = True
        self.refused = self.near(1).tag == "candidate"

    def on_maybe(self, tag: Tag) -> None:
        self.skipped = True

    def on_expected(self, tag: Tag) -> None:
        self.expected = True

    def on_contrast(self, tag: Tag) -> None:
        self.expected = self.contrasted = True

    # The topic.

    def on_candidate(self, tag: Tag) -> None:
        previous = self.word(self.near(-1)) if self.at else ""
        before = previous.split()[-1] if previous else ""
        start = self.at
        letters = self._letters()
        named, self.named_any = self.named_any, True
        if before in EXCEPTING and self._is_of_all(self._tag_at(start - 2)):
            # "All candidates but B contain an error."
            self.letters, self.skipped = (), True
            return
        if before in ASIDE or (before in COMPARED and self.letters) or self.is_compared(start):
            if all(t.tag != "and" for t in self.sentence[start : self.at]):
                # "Compared with A, B ..." is not a list.
                self.at = start
            self.skipped = True
        elif before in PARTED and self.skipped:
            self.letters = ()
        elif before in PARTED and len(self.found) > self.clause:
            self._put_down_to(letters)
            # After another topic, the rest may be about either candidate.
            self.letters = () if named else letters
        else:
            self.letters, self.choice = letters, tag
            self.two = letters if len(letters) == 2 else ()
            self.kept, self.objects = self.objects, []
            self.lacking = self.adding = self.moving = self.doubted = False
            self.expected = self.contrasted = self.negated = False
            self.clause = len(self.found)
            if self.passing:
                self.add_candidate_claim("agrees", not self.refused, tag)
                self.passing = False

    def _put_down_to(self, letters: tuple[str, ...]) -> None:
        """Assign the clause's earlier claims to the candidates that it names only now."""
        kept, moved = self.found[: self.clause], self.found[self.clause :]
        seen = dict.fromkeys((c.kind, c.subjects, c.value, c.affirmed, c.span) for c in moved)
        whole = [c for c in moved if c.candidate is None and c.kind != "agrees"]
        self.found = kept + whole
        for kind, subjects, value, affirmed, span in seen:
            if any(c.span == span and c.kind == kind for c in whole):
                continue
            self.found += [
                Claim(kind, subjects, value, affirmed, TARGET, letter, span) for letter in letters
            ]

    def is_compared(self, start: int) -> bool:
        """Whether the candidate at `start` is only a comparison for the topic ("D resembles A") or
        for the candidate named next ("as in A, D ...")."""
        back = start - 1
        if self._tag_at(back).tag == "contrast" and self.word(self._tag_at(back)) != "and not":
            return True
        related = self._tag_at(back).tag == "by" or self.word(self._tag_at(back)) == "with"
        if related and self.last_word(self._tag_at(back - 1)) in COMPARING:
            return True
        if self._tag_at(back).tag == "not":
            # "B, not D, has ..."
            enclosed = self._tag_at(back - 1).tag == self.near(1).tag == "comma"
            return enclosed and self._tag_at(back - 2).tag == "candidate"
        while self._tag_at(back).tag not in BOUNDARIES:
            if self._tag_at(back).tag == "candidate":
                return True
            back -= 1
        return False

    def _is_of_all(self, tag: Tag) -> bool:
        general = tag.tag in ("all", "none", "not", "others", "rest of")
        return general or self.word(tag) in ("all", "every", "each", "any")

    def _tag_at(self, index: int) -> Tag:
        return self.sentence[index] if index >= 0 else END

    def _letters(self) -> tuple[str, ...]:
        letters = [str(self.sentence[self.at].value)]
        while True:
            step = 1
            while self.near(step).tag in ("comma", "and"):
                step += 1
            if step == 1 or step > 3 or self.near(step).tag != "candidate":
                return tuple(dict.fromkeys(letters))
            between = self.text[self.sentence[self.at].stop : self.near(step).start].lower()
            alone = self.near(1).tag == "and" and len(self.found) == self.clause
            if "candidate" in between and not alone:
                # "It is in candidate A, and candidate B ..." is not a list.
                return tuple(dict.fromkeys(letters))
            self.at += step
            letters.append(str(self.sentence[self.at].value))

    def on_others(self, tag: Tag) -> None:
        if self.word(self.near(-1)) in PARTED:
            # "It is near the left in the others."
            self.found = self.found[: self.clause]
        self.letters, self.objects, self.choice = (), [], None

    def on_object(self, tag: Tag) -> None:
        if self.contrasted and self.near(-1).tag == "contrast":
            self.group()
            self.objects = []
            return
        denied = self.near(-1).tag == "not" and self.letters != ()
        start, listed = self.at, self.near(-1).tag in LISTED_AFTER
        names, last = self.group()
        if listed and len(names) > 1 and self.near(1).tag in ("be", "stays", "moves", "gone"):
            # "A lacks the X, and the Y is ...": the Y begins a new clause.
            self.at = start
            names, last = self.group(1)
        self.objects = names
        self.expected = self.contrasted = False
        # "A has neither the X near the top nor ..."
        self.skipped |= denied
        if self.skipped:
            return
        if self.lacking:
            self.add_claim("lacks", "", True, last)
            self.objects = []
        elif self.adding and self.near(1).tag not in ("slight", "clear", "off", "direction"):
            self.add_claim("extra", "", True, last)
        elif self.moving:
            self.add_claim("displaced", "", True, last)
        self.lacking = self.adding = self.moving = self.negated = False

    def on_pronoun(self, tag: Tag) -> None:
        if tag.value == "it" and not self.objects and len(self.kept) == 1:
            # "In A the X is near the top, and in B it is near the left."
            self.objects = self.kept

        elif tag.value in ("former", "latter"):
            self._choose_of_two(tag.value == "latter")

    def _choose_of_two(self, last: bool) -> None:
        """Make the first or the last of two candidates, or of two objects, the topic."""
        if len(self.two) == 2 and len(self.objects) < 2:
            self.letters, self.objects = (self.two[last],), []
        elif len(self.objects) == 2 and not self.two:
            self.objects = [self.objects[last]]
        else:
            self.letters, self.objects = (), []

    def on_rest_of(self, tag: Tag) -> None:
        if self.word(self.near(-1)) in PARTED and self.word(tag).endswith("others"):
            self.on_others(tag)
            return
        self.objects, self.lacking = [], False
        self.negated |= self.word(tag).split()[0] in ("nothing", "no")

    def on_all(self, tag: Tag) -> None:
        self.objects, self.lacking = [], False

    def on_none(self, tag: Tag) -> None:
        self.objects, self.lacking, self.negated = [], False, True
        self.refused = self.near(1).tag == "by" and self.near(2).tag == "candidate"
        if self.found and self.found[-1].kind == "agrees":
            # "It differs in nothing."
            self.found = [c for c in self.found if c.kind != "agrees"]

    # Claims about the topic.

    def add_claim(self, kind: str, value: str, affirmed: bool, tag: Tag) -> None:
        if self.skipped or self.refused:
            return
        for name in self.objects:
            for letter in self.letters or ("",):
                self.found.append(self.claim(kind, (name,), value, affirmed, TARGET, tag, letter))
        if len(self.objects) > 1 and affirmed:
            self.shared.append((kind, value, tuple(self.objects), tag))

    def add_claim_of_any(self, kind: str, tag: Tag) -> None:
        """Record a claim about an ambiguous object of a candidate."""
        for letter in () if self.refused or self.skipped else self.letters:
            self.found.append(self.claim(kind, (), str(tag.value), True, TARGET, tag, letter))

    def add_candidate_claim(self, kind: str, affirmed: bool, tag: Tag) -> None:
        if not self.skipped:
            for letter in self.letters:
                self.found.append(self.claim(kind, (), "", affirmed, TARGET, tag, letter))
