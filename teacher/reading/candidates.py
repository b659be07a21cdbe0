"""Reads sentences about candidates: where they show objects, which objects they lack, add or
displace, and which candidate agrees with the target."""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

from dynapix.data.records import LETTERS
from dynapix.teacher.predicates.relations import KINDS
from dynapix.teacher.reading.claims import EITHER, TARGET, Claim, IndexedPredicates
from dynapix.teacher.reading.reader import SEPARATORS, VERBS, Reader, UnreadableError
from dynapix.teacher.reading.scenes import SceneReader
from dynapix.teacher.reading.tagging import Tag

CHOOSING = {
    *("agree", "be", "visible", "which", "with", "expected", "future", "show", "break", "comma"),
}
"""Tags between "this layout" or "the answer" and the candidate."""
TOUCHING = {"touching", "touches", "touch", "in contact"}
"""Words for a contact that a frame shows."""
PLACING = {"in", "from", "for", "of"}
"""Prepositions between an object and the candidate that shows or lacks it."""


class CandidateReader(Reader):
    """Records claims about candidates and their objects. In the candidate analysis, the topic stays
    until another candidate is named."""

    def __init__(self, predicates: IndexedPredicates, keeps_topic: bool, known: list[str]) -> None:
        super().__init__(predicates, TARGET if not keeps_topic else EITHER, known)
        self.extras = predicates.extras
        self.keeps_topic = keeps_topic
        self.letters: list[str] = []
        """The candidates that are the topic."""

    def read_sentence(self) -> None:
        if not self.keeps_topic:
            self.letters = []
        self.objects: list[str] = []
        """The object of which the candidate shows something, and whether nothing was said yet."""
        self.unplaced: Tag | None = None
        self.lacking = self.adding = False
        while True:
            separators = self.skip(SEPARATORS)
            if self.peek().name == "stop":
                break
            self._read_candidate_clause(separators)
        self._end_object()

    def forget(self) -> None:
        self.letters = []

    def _read_candidate_clause(self, separators: Sequence[str]) -> None:
        self.denied = self.contrasted = self.expected = self.correct = False
        self.extent: Tag | None = None
        if self.peek(1).name == "candidate":
            self.take("both")
        first = self.peek()
        self.lacking &= first.name == "object" and self.peek(1).name not in VERBS | {"region"}
        if first.name == "with" and self.peek(1).name == "candidate":
            self.at += 1
            self._begin_topic(self._read_letters())
            if self.peek().name in SEPARATORS | {"stop"}:
                return
        elif first.name == "candidate":
            self._begin_topic(self._read_letters())
            if self.peek().name in SEPARATORS:
                return
        elif first.name == "other_candidates":
            self.at += 1
            named = {tag.value for tag in self.tags if tag.name == "candidate"}
            self._begin_topic([letter for letter in LETTERS if letter not in named])
        elif first.name == "pronoun" and first.value == "it":
            self.at += 1
        elif first.name == "agree" and not self.letters:
            self._read_choice()
            return
        elif trailing := self._find_trailing():
            self._begin_topic(trailing)
        elif not self.letters:
            self._read_scene_clauses()
            return
        if not self.read_tags():
            raise UnreadableError

    def _begin_topic(self, letters: list[str]) -> None:
        self._end_object()
        self.letters, self.objects, self.adding = letters, [], False

    def _read_letters(self) -> list[str]:
        letters = []
        while tag := self.take("candidate"):
            letters.append(tag.value)
            end = self.at
            self.skip({"comma", "and"})
        self.at = end
        return letters

    def _find_trailing(self) -> list[str]:
        """Return the candidate of a clause such as "the red cube is missing from candidate A", if
        it has one."""
        for before, tag in pairwise(self.tags[self.at : self.stop]):
            if {before.name, tag.name} & {"stop", "semicolon", "break", "comma", "agree"}:
                break
            if tag.name == "candidate":
                return [tag.value] if before.words in PLACING else []
        return []

    def _read_choice(self) -> None:
        """Read "this layout is that of candidate B"."""
        tag = self.peek()
        self.skip(CHOOSING)
        if self.peek().name != "candidate":
            raise UnreadableError
        self._begin_topic(self._read_letters())
        self._agree(True, tag)

    def _read_scene_clauses(self) -> None:
        """Read the clauses of an outcome before the first that names a candidate; they are about
        the target."""
        named = [k for k in range(self.at, self.stop) if self.tags[k].name == "candidate"]
        ends = [k for k in range(self.at, min(named, default=0)) if self.tags[k].name in SEPARATORS]
        if self.keeps_topic or not ends:
            raise UnreadableError
        scene = SceneReader(self.predicates, TARGET, self.known)
        claims = scene.read(self.tags[self.at : ends[-1]])
        if any(claim.kind == "unreadable" for claim in claims):
            raise UnreadableError
        self.claims += [claim for claim in claims if claim.kind != "mention"]
        self.at = ends[-1]

    # Objects.

    def show(self, kind: str, value: str, tag: Tag, partners: Sequence[str] = ()) -> None:
        """Record what the candidates of the topic show of the current object."""
        if not self.objects or not self.letters or self.lacking:
            raise UnreadableError
        self.unplaced = None
        for letter in self.letters:
            for name in self.objects:
                names = [name, *partners]
                self.add(kind, names, value, not self.denied, TARGET, tag, letter)

    def expect(self, kind: str, value: str, tag: Tag, partners: Sequence[str] = ()) -> None:
        """Record where the current object should be."""
        self.unplaced = None
        for name in self.objects:
            self.add(kind, [name, *partners], value, True, TARGET, tag)

    def _end_object(self) -> None:
        """Record that a candidate shows an object of which nothing else was said."""
        if self.unplaced is not None and not self.adding:
            tag, self.unplaced = self.unplaced, None
            for letter in self.letters:
                for name in self.objects:
                    self.add("lacks", [name], "", False, TARGET, tag, letter)
        self.unplaced = None

    def on_object(self, tag: Tag) -> None:
        if self.contrasted or self.expected:
            raise UnreadableError
        self.at -= 1
        self._end_object()
        if self.denied or self.lacking:
            # An object that is lacking need not be known.
            noun = tag.value
            if len(self.find_fitting(noun)) == 1:
                self.objects = self.read_noun()
                for letter in self.letters:
                    self.add("lacks", self.objects, "", True, TARGET, tag, letter)
            else:
                self.at += 1
                self.objects = []
            self.denied, self.lacking = False, True
            return
        self.objects = self.read_noun() if self.peek(-1).name == "and" else self.read_list()
        self.unplaced = tag
        if self.adding:
            self.show("extra", "", tag)

    def on_region(self, tag: Tag) -> None:
        if self.denied and self.unplaced is not None:
            # "In candidate A, the cube is not near the top."
            self.show("region", tag.value, tag)
        elif self.denied or self.contrasted or self.expected:
            # "Shows the cube near the left, not near the top": it should be near the top.
            if not self.objects or (self.denied and self.expected):
                raise UnreadableError
            self.expect("region", tag.value, tag)
        else:
            self.show("region", tag.value, tag)
            if self.correct:
                self.expect("region", tag.value, tag)

    on_into = on_region

    def on_relation(self, tag: Tag) -> None:
        partners, value = self.find_partners(tag), tag.value.value
        if self.expected and not self.denied:
            self.expect(KINDS[value], value, tag, partners)
        else:
            self.denied |= self.contrasted
            self.show(KINDS[value], value, tag, partners)

    def on_meet(self, tag: Tag) -> None:
        if tag.words not in TOUCHING or len(self.objects) != 1:
            raise UnreadableError
        self.take("with")
        self.show("gap", "against", tag, self.read_noun())

    def on_with(self, tag: Tag) -> None:
        if self.peek().name == "other_objects":
            return
        if tag.words in PLACING and self.peek().name == "candidate":
            self.at += 1
            return
        if tag.words not in ("with", "at", "in"):
            raise UnreadableError
        owner = self.objects
        if possessed := self.read_possession(owner):
            names, relation = possessed
            self.objects = names[:1]
            value = relation.value.value
            self.show(KINDS[value], value, relation, names[1:])
            self.objects = owner

    def on_pronoun(self, tag: Tag) -> None:
        if tag.value != "it" or len(self.objects) != 1:
            raise UnreadableError

    def on_off(self, tag: Tag) -> None:
        self.show("displaced", "", tag)
        if self.extent is not None:
            value = "slightly" if self.extent.name == "slight" else self.extent.words
            self.show("displaced", value, self.extent)
            self.extent = None

    def on_slight(self, tag: Tag) -> None:
        if self.peek().name not in ("off", "direction", "moving"):
            raise UnreadableError
        self.extent = tag
        if self.peek().name == "direction":
            self.on_off(tag)

    on_clear = on_slight

    def on_moving(self, tag: Tag) -> None:
        if tag.words != "shifted":
            raise UnreadableError
        self.on_off(tag)

    def on_direction(self, tag: Tag) -> None:
        if not any(c.kind == "displaced" for c in self.claims):
            raise UnreadableError
        self.show("displaced", tag.value, tag)

    def on_lack(self, tag: Tag) -> None:
        if self.denied:
            raise UnreadableError
        self._end_object()
        self.lacking, self.adding = True, False

    def on_no_contact(self, tag: Tag) -> None:
        if not tag.words.startswith("miss"):
            raise UnreadableError
        self.on_lack(tag)

    def on_gone(self, tag: Tag) -> None:
        if self.expected:
            raise UnreadableError
        if self.peek().name == "object":
            self.on_lack(tag)
        elif self.peek().name in ("slight", "clear", "off", "direction"):
            # "Has gone too far."
            raise UnreadableError
        else:
            self.show("lacks", "", tag)

    on_out = on_gone
    on_hidden = on_gone
    on_unseen = on_gone

    def on_extra(self, tag: Tag) -> None:
        self.show("extra", "", tag)

    def on_adds(self, tag: Tag) -> None:
        self.adding = True

    def on_other_objects(self, tag: Tag) -> None:
        for letter in self.letters:
            self.add("other objects", (), "", not self.denied, TARGET, tag, letter)

    # Whole candidates.

    def _agree(self, agrees: bool, tag: Tag, names: Sequence[str] = ()) -> None:
        for letter in self.letters:
            self.add("agrees", names, "", agrees, TARGET, tag, letter)

    def on_agree(self, tag: Tag, names: Sequence[str] = ()) -> None:
        if not self.letters or self.peek().name == "object":
            raise UnreadableError
        self._agree(not self.denied, tag, names)
        self.skip({"agree"})
        self.take("prediction")

    def on_closest(self, tag: Tag) -> None:
        self.unplaced = None
        self.on_agree(tag, self.objects if len(self.objects) == 1 else ())

    def on_differ(self, tag: Tag) -> None:
        self._agree(self.denied, tag)
        self.take("prediction")

    # Function words.

    def on_show(self, tag: Tag) -> None:
        if self.denied:
            raise UnreadableError
        self.lacking = self.adding = False
        if self.peek().name == "agree":
            self.on_agree(self.tags[self.at])
            self.at += 1

    def on_stays(self, tag: Tag) -> None:
        """Read "keeps the red cube near the top" and "leaves it there"."""
        if self.peek().name != "object" or self.denied:
            raise UnreadableError
        self.on_show(tag)

    on_leaves = on_stays
    on_moves = on_stays

    def on_not(self, tag: Tag) -> None:
        if tag.words in ("neither", "nor") or self.denied:
            raise UnreadableError
        self.denied = True

    def on_correctly(self, tag: Tag) -> None:
        self.correct = True

    def on_contrast(self, tag: Tag) -> None:
        self.contrasted = True

    def on_expected(self, tag: Tag) -> None:
        self.expected = True

    def on_be(self, tag: Tag) -> None:
        pass

    on_visible = on_be
    on_both = on_be

    def on_future(self, tag: Tag) -> None:
        if tag.words == "would":
            raise UnreadableError

    def on_prediction(self, tag: Tag) -> None:
        """Read "the prediction puts it near the top"."""
        if not self.take("show"):
            raise UnreadableError
        self.expected = True

    def on_which(self, tag: Tag) -> None:
        if self.peek().name not in ("agree", "differ", "be", "expected", "show"):
            raise UnreadableError


def read_answer(text: str, start: int, stop: int) -> list[Claim]:
    """Return the claim of the section "Answer"."""
    letter = text[start:stop].strip()
    if len(letter) != 1:
        return []
    position = text.index(letter, start)
    return [Claim("agrees", (), "", True, TARGET, letter, (position, position + 1))]
