"""Tracks the candidate that a sentence is about, and the candidate's object."""

from __future__ import annotations

from teacher.reading.grounding import TARGET, Claim, Ground
from teacher.reading.reader import Names, Reader
from teacher.reading.tagging import BOUNDARIES, Tag

ASIDE = {"unlike", "like", "than", "besides", "beyond", "except"}
"""Words before a candidate that is never the topic."""
COMPARED = {"of", "as", "like", "with", "what", "to", "does", "same"}
"""Words before a candidate that is not the topic if there already is one."""
LISTED_AFTER = {"lack", "gone", "show", "stays", "misplace", "adds"}
"""Tags after which an object is one that the candidate shows or lacks."""
COMPARING = {
    *("compared", "comparison", "similar", "similarly", "identical", "equal", "relative", "akin"),
    *("as", "contrasted", "next", "like", "unlike", "than"),
}
"""Words whose preposition leaves the topic as it is: "similar to A"."""
EXCEPTING = {"but", "except", "save"}
PLACING = ("in", "from", "by", "for")
"""Words before the candidate that the clause has been about: "the X is missing from A"."""


class TopicReader(Reader):
    """Distinguishes the candidate that a clause is about from those it is compared with."""

    shows_extras = True

    def __init__(self, ground: Ground, lasting: bool) -> None:
        """`lasting`: a candidate stays the topic in later sentences."""
        super().__init__(ground)
        self.lasting = lasting
        self.letters: tuple[str, ...] = ()
        self.pair: tuple[str, ...] = ()
        """The two candidates that "the former" and "the latter" refer to."""

    def begin(self) -> None:
        if not self.lasting:
            self.letters = ()
        self.found: list[Claim] = []
        """Claims that may still be assigned to another candidate; their candidate is "" if the
        sentence has named none."""
        self.objects: Names = []
        """The objects that the clause is about."""
        self.earlier_objects: Names = []
        """The objects of the previous candidate, to which "it" may refer."""
        self.lacking = self.adding = self.moving = False
        """Whether the next object is one that the candidate lacks, adds or displaces."""
        self.passing = False
        """Whether the next candidate is the one that agrees."""
        self.doubted = False
        """Whether the sentence denies something or names an error."""
        self.named_any = False
        """Whether the sentence has named a candidate."""
        self.choice: Tag | None = None
        """The last candidate that became the topic."""
        self._start_clause()

    def _start_clause(self) -> None:
        self.clause_start = len(self.found)
        self.negated = False
        self.expected = self.contrasted = False
        """Whether the clause describes where an object should be, and whether after "instead of" or
        a similar phrase."""
        self.skipped = self.refused = False
        """Whether the clause states nothing about the topic, and whether it is about candidates
        other than the topic ("not B", "none of B")."""

    # Boundaries and function words.

    def on_comma(self, tag: Tag) -> None:
        # "Unlike A, where it is near the left, ..." is still about A.
        aside = self.skipped and (
            self.near(1).tag in ("which", "put", "ignore")
            or (self.near(1).tag == "word" and self.near(1).value != "there")
        )
        self._start_clause()
        self.skipped = aside

    def on_semicolon(self, tag: Tag) -> None:
        self._start_clause()

    on_and = on_semicolon

    def on_break(self, tag: Tag) -> None:
        if tag.words != "so" or self.near(-1).words not in ("do", "does"):
            self._start_clause()

    def on_be(self, tag: Tag) -> None:
        # "Had A shown the X, ..."
        self.skipped |= self.at == 0 and tag.words == "had"

    def on_leaves(self, tag: Tag) -> None:
        # "B does not leave the X near the top."
        self.skipped |= self.negated

    on_show = on_leaves

    def on_word(self, tag: Tag) -> None:
        if tag.value in ("first", "second") and self.pair and self.near(1).tag != "object":
            self._choose_of_two(tag.value == "second")

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
        before, start = self.near(-1).last_word, self.at
        letters = self._letters()
        named, self.named_any = self.named_any, True
        if before in EXCEPTING and self._is_of_all(self.sentence[start - 2]):
            # "All candidates but B contain an error."
            self.letters, self.skipped = (), True
            return
        if before in ASIDE or (before in COMPARED and self.letters) or self.is_compared(start):
            if all(t.tag != "and" for t in self.sentence.tags[start : self.at]):
                # "Compared with A, B ..." is not a list.
                self.at = start
            self.skipped = True
        elif before in PLACING and self.skipped:
            self.letters = ()
        elif before in PLACING and len(self.found) > self.clause_start:
            self._assign_to(letters)
            # After another topic, the rest may be about either candidate.
            self.letters = () if named else letters
        else:
            self.letters, self.choice = letters, tag
            self.pair = letters if len(letters) == 2 else ()
            self.earlier_objects, self.objects = self.objects, []
            self.lacking = self.adding = self.moving = self.doubted = False
            self.expected = self.contrasted = self.negated = False
            self.clause_start = len(self.found)
            if self.passing:
                self.add_candidate_claim("agrees", not self.refused, tag)
                self.passing = False

    def _assign_to(self, letters: tuple[str, ...]) -> None:
        """Assign the clause's earlier claims to the candidates that it names only now."""
        earlier, claims = self.found[: self.clause_start], self.found[self.clause_start :]
        of_target = [c for c in claims if c.candidate is None and c.kind != "agrees"]
        stated = {(c.kind, c.span) for c in of_target}
        others = [c._replace(candidate=None) for c in claims if (c.kind, c.span) not in stated]
        assigned = [c._replace(candidate=k) for c in dict.fromkeys(others) for k in letters]
        self.found = earlier + of_target + assigned

    def is_compared(self, start: int) -> bool:
        """Whether the candidate at `start` is only a comparison for the topic ("D resembles A") or
        for the candidate named next ("as in A, D ...")."""
        third, second, previous = (self.sentence[start - k] for k in (3, 2, 1))
        if previous.tag == "contrast" and previous.words != "and not":
            return True
        if (previous.tag == "by" or previous.words == "with") and second.last_word in COMPARING:
            return True
        if previous.tag == "not":
            # "B, not D, has ..."
            enclosed = second.tag == self.near(1).tag == "comma"
            return enclosed and third.tag == "candidate"
        opening = self.sentence.find(start - 1, BOUNDARIES | {"candidate"}, -1)
        return self.sentence[opening].tag == "candidate"

    def _is_of_all(self, tag: Tag) -> bool:
        general = tag.tag in ("all", "none", "not", "others", "rest_of")
        return general or tag.words in ("all", "every", "each", "any")

    def _letters(self) -> tuple[str, ...]:
        """The listed candidates from the current tag on; moves the cursor to the last of them."""
        letters = [str(self.sentence[self.at].value)]
        while True:
            following = self.sentence.skip(self.at + 1, {"comma", "and"})
            joined = 1 < following - self.at <= 3
            if not joined or self.sentence[following].tag != "candidate":
                return tuple(dict.fromkeys(letters))
            between = self.sentence.text[self.near(0).stop : self.sentence[following].start]
            alone = self.near(1).tag == "and" and len(self.found) == self.clause_start
            if "candidate" in between.lower() and not alone:
                # "It is in candidate A, and candidate B ..." is not a list.
                return tuple(dict.fromkeys(letters))
            self.at = following
            letters.append(str(self.near(0).value))

    def on_others(self, tag: Tag) -> None:
        if self.near(-1).words in PLACING:
            # "It is near the left in the others."
            self.found = self.found[: self.clause_start]
        self.letters, self.objects, self.choice = (), [], None

    def on_object(self, tag: Tag) -> None:
        if self.contrasted and self.near(-1).tag == "contrast":
            self.group()
            self.objects = []
            return
        denied = self.near(-1).tag == "not" and self.letters != ()
        start, listed = self.at, self.near(-1).tag in LISTED_AFTER
        self.objects = self.group()
        verb = self.near(1).tag in ("be", "stays", "moves", "gone")
        if listed and len(self.objects) > 1 and verb:
            # "A lacks the X, and the Y is ...": the Y begins a new clause.
            self.at = start
            self.objects = self.group(1)
        last = self.near(0)
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
        if tag.value == "it" and not self.objects and len(self.earlier_objects) == 1:
            # "In A the X is near the top, and in B it is near the left."
            self.objects = self.earlier_objects
        elif tag.value in ("former", "latter"):
            self._choose_of_two(tag.value == "latter")

    def _choose_of_two(self, last: bool) -> None:
        """Make the first or the last of two candidates, or of two objects, the topic."""
        if len(self.pair) == 2 and len(self.objects) < 2:
            self.letters, self.objects = (self.pair[last],), []
        elif len(self.objects) == 2 and not self.pair:
            self.objects = [self.objects[last]]
        else:
            self.letters, self.objects = (), []

    def on_rest_of(self, tag: Tag) -> None:
        if self.near(-1).words in PLACING and tag.words.endswith("others"):
            self.on_others(tag)
            return
        self.objects, self.lacking = [], False
        self.negated |= tag.words.split()[0] in ("nothing", "no")

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
        if affirmed:
            self.share(kind, value, self.objects, tag)

    def add_claim_of_any(self, kind: str, tag: Tag) -> None:
        """Record a claim about an ambiguous object of a candidate."""
        if not self.refused:
            self.add_candidate_claim(kind, True, tag, str(tag.value))

    def add_candidate_claim(self, kind: str, affirmed: bool, tag: Tag, value: str = "") -> None:
        if not self.skipped:
            for letter in self.letters:
                self.found.append(self.claim(kind, (), value, affirmed, TARGET, tag, letter))
