"""Finds the topic of a clause, that is, the candidates that it is about, and their objects. In
"unlike B, A lacks the red cube", the topic is A."""

from __future__ import annotations

from teacher.reading.claims import TARGET, Claim, IndexedPredicates
from teacher.reading.reader import Names, Reader
from teacher.reading.tagging import BOUNDARIES, Tag

UNLIKE = {"unlike", "like", "than", "besides", "beyond", "except"}
"""Words after which a candidate is never the topic."""
COMPARED = {"of", "as", "like", "with", "what", "to", "does", "same"}
"""Words after which a candidate is not the topic if there already is one."""
BEFORE_OBJECT = {"lack", "gone", "show", "stays", "misplace", "adds"}
"""Tags after which an object is one that the candidate shows, lacks, adds or displaces."""
COMPARING = {
    *("compared", "comparison", "similar", "similarly", "identical", "equal", "relative", "akin"),
    *("as", "contrasted", "next", "like", "unlike", "than"),
}
"""Words after which a preposition and a candidate do not change the topic: "similar to A"."""
EXCEPTING = {"but", "except", "save"}
PLACING = ("in", "from", "by", "for")
"""Words after which a candidate is the topic of the words before: "the cube is missing from A"."""


class TopicReader(Reader):
    """Distinguishes the candidates that a clause is about from those they are compared with."""

    allows_extras = True

    def __init__(self, predicates: IndexedPredicates, keeps_topic: bool) -> None:
        """`keeps_topic`: whether the topic continues in the next sentence."""
        super().__init__(predicates)
        self.keeps_topic = keeps_topic
        self.letters: tuple[str, ...] = ()
        """The candidates that are the topic."""
        self.pair: tuple[str, ...] = ()
        """The two candidates that "the former" and "the latter" refer to."""

    def begin(self) -> None:
        if not self.keeps_topic:
            self.letters = ()
        self.drafts: list[Claim] = []
        """Claims that may still be assigned to other candidates. Their candidate is "" if there is
        no topic yet, and None if they are about the target."""
        self.objects: Names = []
        """The objects that the clause is about."""
        self.earlier_objects: Names = []
        """The objects of the previous topic, to which "it" may refer."""
        self.lacking = self.adding = self.misplacing = False
        """Whether the next object is one that the candidate lacks, adds or displaces."""
        self.choosing = False
        """Whether the next candidate is said to agree with the target: "the answer is B"."""
        self.doubted = False
        """Whether something was denied or called an error since the topic was named."""
        self.named_any = False
        """Whether the sentence has named a candidate."""
        self.topic_tag: Tag | None = None
        self._start_clause()

    def _start_clause(self) -> None:
        self.clause_start = len(self.drafts)
        self.negated = False
        self.expected = self.contrasted = False
        """Whether the clause describes where an object should be, and whether this follows words
        such as "instead of"."""
        self.skipped = self.denies_candidate = False
        """Whether the clause states nothing about the topic, and whether it denies its statement of
        the next candidate ("not B", "none of B")."""

    # Boundaries and function words.

    def on_comma(self, tag: Tag) -> None:
        # "Unlike A, where it is near the left, ..." is still about A.
        aside = self.skipped and (
            self.near(1).name in ("which", "in_place", "ignore")
            or (self.near(1).name == "word" and self.near(1).value != "there")
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
        # "Had A shown the red cube, ..."
        self.skipped |= self.cursor == 0 and tag.words == "had"

    def on_leaves(self, tag: Tag) -> None:
        # "B does not leave the red cube near the top."
        self.skipped |= self.negated

    on_show = on_leaves

    def on_word(self, tag: Tag) -> None:
        if tag.value in ("first", "second") and self.pair and self.near(1).name != "object":
            self._choose_of_two(tag.value == "second")

    def on_not(self, tag: Tag) -> None:
        self.negated = self.doubted = True
        self.denies_candidate = self.near(1).name == "candidate"

    def on_maybe(self, tag: Tag) -> None:
        self.skipped = True

    def on_expected(self, tag: Tag) -> None:
        self.expected = True

    def on_contrast(self, tag: Tag) -> None:
        self.expected = self.contrasted = True

    # The topic.

    def on_candidate(self, tag: Tag) -> None:
        before, start = self.near(-1).last_word, self.cursor
        letters = self._read_letters()
        named, self.named_any = self.named_any, True
        if before in EXCEPTING and self._is_of_all(self.sentence[start - 2]):
            # "All candidates but B contain an error."
            self.letters, self.skipped = (), True
            return
        if before in UNLIKE or (before in COMPARED and self.letters) or self.is_compared(start):
            if all(t.name != "and" for t in self.sentence.tags[start : self.cursor]):
                # "Compared with A, B ..." is not a list.
                self.cursor = start
            self.skipped = True
        elif before in PLACING and self.skipped:
            self.letters = ()
        elif before in PLACING and len(self.drafts) > self.clause_start:
            self._assign_to(letters)
            # After another topic, the rest may be about either candidate.
            self.letters = () if named else letters
        else:
            self.letters, self.topic_tag = letters, tag
            self.pair = letters if len(letters) == 2 else ()
            self.earlier_objects, self.objects = self.objects, []
            self.lacking = self.adding = self.misplacing = self.doubted = False
            self.expected = self.contrasted = self.negated = False
            self.clause_start = len(self.drafts)
            if self.choosing:
                self.add_candidate_claim("agrees", not self.denies_candidate, tag)
                self.choosing = False

    def _assign_to(self, letters: tuple[str, ...]) -> None:
        """Assign the claims of the clause to the candidates that it names after them."""
        earlier, claims = self.drafts[: self.clause_start], self.drafts[self.clause_start :]
        of_target = [c for c in claims if c.candidate is None and c.kind != "agrees"]
        stated = {(c.kind, c.span) for c in of_target}
        others = [c._replace(candidate=None) for c in claims if (c.kind, c.span) not in stated]
        assigned = [c._replace(candidate=k) for c in dict.fromkeys(others) for k in letters]
        self.drafts = earlier + of_target + assigned

    def is_compared(self, start: int) -> bool:
        """Return whether the candidate at the index `start` is only a comparison for the topic ("D
        resembles A") or for the next candidate ("as in A, D ...")."""
        third, second, previous = (self.sentence[start - k] for k in (3, 2, 1))
        if previous.name == "contrast" and previous.words != "and not":
            return True
        if (previous.name == "by" or previous.words == "with") and second.last_word in COMPARING:
            return True
        if previous.name == "not":
            # "B, not D, has ..."
            enclosed = second.name == self.near(1).name == "comma"
            return enclosed and third.name == "candidate"
        opening = self.sentence.find(start - 1, BOUNDARIES | {"candidate"}, -1)
        return self.sentence[opening].name == "candidate"

    def _is_of_all(self, tag: Tag) -> bool:
        """Return whether the tag refers to all or no candidates, as in "all but B"."""
        general = tag.name in ("all", "none", "not", "other_candidates", "unnamed")
        return general or tag.words in ("all", "every", "each", "any")

    def _read_letters(self) -> tuple[str, ...]:
        """Return the list of candidates at the cursor, and move the cursor to the last of them."""
        letters = [str(self.sentence[self.cursor].value)]
        while True:
            following = self.sentence.skip(self.cursor + 1, {"comma", "and"})
            joined = 1 < following - self.cursor <= 3
            if not joined or self.sentence[following].name != "candidate":
                return tuple(dict.fromkeys(letters))
            between = self.sentence.text[self.near(0).stop : self.sentence[following].start]
            alone = self.near(1).name == "and" and len(self.drafts) == self.clause_start
            if "candidate" in between.lower() and not alone:
                # "It is in candidate A, and candidate B ..." is not a list.
                return tuple(dict.fromkeys(letters))
            self.cursor = following
            letters.append(str(self.near(0).value))

    def on_other_candidates(self, tag: Tag) -> None:
        if self.near(-1).words in PLACING:
            # "It is near the left in the others."
            self.drafts = self.drafts[: self.clause_start]
        self.letters, self.objects, self.topic_tag = (), [], None

    def on_object(self, tag: Tag) -> None:
        if self.contrasted and self.near(-1).name == "contrast":
            self.read_list()
            self.objects = []
            return
        denied = self.near(-1).name == "not" and self.letters != ()
        start, listed = self.cursor, self.near(-1).name in BEFORE_OBJECT
        self.objects = self.read_list()
        verb = self.near(1).name in ("be", "stays", "moves", "gone")
        if listed and len(self.objects) > 1 and verb:
            # "A lacks the red cube, and the sphere is ...": the sphere begins a new clause.
            self.cursor = start
            self.objects = self.read_list(1)
        last = self.near(0)
        self.expected = self.contrasted = False
        # "A has neither the red cube near the top nor ..."
        self.skipped |= denied
        if self.skipped:
            return
        placed = self.near(1).name == "relation"
        if self.lacking and placed:
            # "A does not show the red cube left of the sphere" denies the relation.
            self.lacking, self.negated = False, True
            return
        if self.lacking:
            self.add_claim("lacks", "", True, last)
            self.objects = []
        elif self.adding and self.near(1).name not in ("slight", "clear", "off", "direction"):
            self.add_claim("extra", "", True, last)
        elif self.misplacing:
            self.add_claim("displaced", "", True, last)
        self.lacking = self.adding = self.misplacing = self.negated = False

    def on_pronoun(self, tag: Tag) -> None:
        if tag.value == "it" and not self.objects and len(self.earlier_objects) == 1:
            # "In A the red cube is near the top, and in B it is near the left."
            self.objects = self.earlier_objects
        elif tag.value in ("former", "latter"):
            self._choose_of_two(tag.value == "latter")

    def _choose_of_two(self, last: bool) -> None:
        """Restrict the topic or the objects to the first of two, or to the last one."""
        if len(self.pair) == 2 and len(self.objects) < 2:
            self.letters, self.objects = (self.pair[last],), []
        elif len(self.objects) == 2 and not self.pair:
            self.objects = [self.objects[last]]
        else:
            self.letters, self.objects = (), []

    def on_unnamed(self, tag: Tag) -> None:
        if self.near(-1).words in PLACING and tag.words.endswith("others"):
            self.on_other_candidates(tag)
            return
        self.objects, self.lacking = [], False
        self.negated |= tag.words.split()[0] in ("nothing", "no")

    def on_all(self, tag: Tag) -> None:
        self.objects, self.lacking = [], False

    def on_none(self, tag: Tag) -> None:
        self.objects, self.lacking, self.negated = [], False, True
        self.denies_candidate = self.near(1).name == "by" and self.near(2).name == "candidate"
        if self.drafts and self.drafts[-1].kind == "agrees":
            # "It differs in nothing."
            self.drafts = [c for c in self.drafts if c.kind != "agrees"]

    # Claims about the topic.

    def add_claim(
        self, kind: str, value: str, affirmed: bool, tag: Tag, partners: tuple[str, ...] = ()
    ) -> None:
        """Record a claim about the current objects in each candidate of the topic.

        Args:
            partners: The other objects of a relation.
        """
        if self.skipped or self.denies_candidate:
            return
        for name in self.objects:
            names = (name, *partners)
            for letter in self.letters or ("",):
                self.drafts.append(self.claim(kind, names, value, affirmed, TARGET, tag, letter))
        if affirmed:
            self.record_shared(kind, value, self.objects, tag)

    def add_claim_of_any(self, kind: str, tag: Tag) -> None:
        """Record a claim about an unknown object in each candidate of the topic."""
        if not self.denies_candidate:
            self.add_candidate_claim(kind, True, tag, str(tag.value))

    def add_candidate_claim(self, kind: str, affirmed: bool, tag: Tag, value: str = "") -> None:
        """Record a claim without objects about each candidate of the topic."""
        if not self.skipped:
            for letter in self.letters:
                self.drafts.append(self.claim(kind, (), value, affirmed, TARGET, tag, letter))
