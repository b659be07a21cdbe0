"""The base class of the readers: the loop over tags, noun phrases, and lists of objects."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Sequence

from teacher.predicates.relations import EXTENTS
from teacher.reading.certainty import CertaintyCheck
from teacher.reading.claims import CUT, EITHER, Claim, IndexedPredicates
from teacher.reading.tagging import Noun, RelationPhrase, Sentence, Tag

MAX_OBJECTS = 9
"""Maximum number of objects in a list, and in the subject of a clause."""
POSSESSIVES = {"with", "has", "have", "having"}
"""Last words before the object in "the cube has the sphere left of it"."""

Names = list[str | None]
"""Names of objects, such as "red metal cube"; None for an object that the text leaves open."""


class Reader:
    """Calls `begin`, then the method `on_<name>` for each tag of a sentence if there is one, such
    as `on_region` for "near the left", then `end`. Methods may move the cursor over tags."""

    allows_extras = False
    """Whether the text may name objects of candidates that the scene does not have."""
    still_moment = EITHER
    """The moment at which the object of "the stationary red cube" is stationary."""

    def __init__(self, predicates: IndexedPredicates) -> None:
        self.predicates = predicates

    def read(self, sentence: Sentence) -> list[Claim]:
        """Return the claims of a sentence, without verdicts."""
        self.sentence = sentence
        self.cursor = 0
        """The index of the current tag."""
        self.claims: list[Claim] = []
        self.mentioned: Names = []
        """The objects that the sentence has named so far."""
        self.names_at: dict[int, Names] = {}
        """The objects that each noun phrase names, by its start in the text."""
        self.shared_values: dict[tuple[str, tuple[str | None, ...]], dict[tuple[int, int], str]] = (
            defaultdict(dict)
        )
        """Values stated of several objects, by kind and objects, then by span."""
        self.begin()
        while self.cursor < len(sentence.tags):
            tag = sentence[self.cursor]
            if handler := getattr(self, f"on_{tag.name}", None):
                handler(tag)
            self.cursor += 1
        self.end()
        check = CertaintyCheck(sentence, self.names_at)
        return [c._replace(certain=check.is_certain(c)) for c in self._assign_shared(self.claims)]

    def begin(self) -> None:
        raise NotImplementedError

    def end(self) -> None:
        raise NotImplementedError

    def near(self, offset: int) -> Tag:
        """Return the tag at an offset from the current one; END outside the sentence."""
        return self.sentence[self.cursor + offset]

    def next_of(self, wanted: Container[str], step: int = 1) -> Tag:
        """Return the next (`step` 1) or previous (-1) tag with a name in `wanted`, or END."""
        return self.sentence[self.sentence.find(self.cursor + step, wanted, step)]

    def claim(
        self,
        kind: str,
        subjects: Sequence[str | None],
        value: str,
        affirmed: bool,
        when: str,
        tag: Tag,
        candidate: str | None = None,
    ) -> Claim:
        """Return the claim that `tag` states, without subjects if one of them is None. It can then
        be contradicted only if it is false of every object."""
        names = () if None in subjects else tuple(subjects)
        return Claim(kind, names, value, affirmed, when, candidate, (tag.start, tag.stop))

    def read_list(self, most: int = MAX_OBJECTS) -> Names:
        """Return the objects of the list that begins at the current tag, and move the cursor to the
        last; only the first if no "and" or "nor" precedes the last of at most `most` objects."""
        ends, complete = [self.cursor], False
        while len(ends) < most and not complete:
            step = ends[-1] + 1
            comma = self.sentence[step].name == "comma"
            if comma and self.sentence[step + 1].name == "and":
                step += 1
            complete = self.sentence[step].name == "and" or self.sentence[step].words == "nor"
            if not (comma or complete) or self.sentence[step + 1].name != "object":
                complete = False
                break
            ends.append(step + 1)
        names: Names = []
        for index in ends if complete else ends[:1]:
            self.cursor = index
            tag = self.sentence[index]
            names += self.names_at.setdefault(tag.start, self._find_objects(tag))
        return names

    def record_shared(self, kind: str, value: str, subjects: Names, tag: Tag) -> None:
        """Record a value stated of several objects, if an object has only one value of the kind."""
        exclusive = kind in ("region", "direction", "speed", "displaced")
        if len(subjects) > 1 and exclusive and value not in ("", *EXTENTS):
            self.shared_values[kind, tuple(subjects)][tag.start, tag.stop] = value

    def _assign_shared(self, claims: list[Claim]) -> list[Claim]:
        """Return the claims with one value for each object: in "the cube and the sphere are near
        the top and near the left", the cube keeps the first value and the sphere the second. If
        the numbers of objects and values differ, these claims are dropped."""
        for (kind, subjects), values in self.shared_values.items():
            if len(set(values.values())) < 2:
                continue
            matched = len(values) == len(subjects)
            owners = dict(zip(values, subjects, strict=True)) if matched else {}
            claims = [
                c
                for c in claims
                if c.kind != kind or c.span not in values or c.subjects == (owners.get(c.span),)
            ]
        return claims

    def find_partners(self, tag: Tag) -> tuple[str, ...] | None:
        """Return the other objects of a relation; None if one is a pronoun or not a known one."""
        phrase = tag.value
        assert isinstance(phrase, RelationPhrase)
        partners: list[str] = []
        for noun in phrase.nouns:
            names = [None] if noun is None else self._find_objects(tag, noun)
            if len(names) != 1 or names[0] is None:
                return None
            partners.append(names[0])
        return tuple(partners)

    def find_possessed(self, tag: Tag) -> tuple[str, str] | None:
        """Return the sphere and the cube in "the cube has the sphere left of it" and "the cube with
        the sphere left of it", where `tag` is the relation; None if the text is different."""
        assert isinstance(tag.value, RelationPhrase)
        verb, thing = self.near(-2), self.near(-1)
        possessed = thing.name == "object" and verb.last_word in POSSESSIVES
        if tag.value.nouns != (None,) or not possessed:
            return None
        index = self.cursor - 1
        while self.sentence[index - 1].last_word in POSSESSIVES:
            # "The cube with the sphere left of it and with the cylinder near it": the cube.
            index = self.sentence.find(index - 1, {"object"}, -1)
        owner = self.sentence[index]
        names = [self.names_at.get(start, ()) for start in (thing.start, owner.start)]
        if any(len(found) != 1 or None in found for found in names):
            return None
        return str(names[0][0]), str(names[1][0])

    def _find_objects(self, tag: Tag, noun: Noun | None = None) -> Names:
        """Return the objects that a noun phrase names, and record the claim that they exist.

        Args:
            noun: The noun phrase, if it is a part of the tag.
        """
        noun = noun or tag.value
        assert isinstance(noun, Noun)
        known = [*self.predicates.objects, *(self.predicates.extras if self.allows_extras else ())]
        fitting = [name for name in known if noun.fits(name)]
        previous = self.near(-1).words
        if len(fitting) > 1 and not (noun.color or noun.material or noun.plural or noun.is_other):
            # "The red cube and the blue sphere move, the cube quickly."
            fitting = [name for name in fitting if name in self.mentioned] or fitting
        if not fitting and not noun.is_other and previous != "no":
            self.claims.append(self.claim("mention", [noun.phrase], "", True, CUT, tag))
            return [None]
        if noun.plural and len(fitting) == 2 and previous == "both":
            self.mentioned += fitting
            return fitting
        if noun.plural or noun.is_other or len(fitting) != 1:
            self.mentioned.append(None)
            return [None]
        self.mentioned += fitting
        self.claims.append(self.claim("mention", fitting, "", True, EITHER, tag))
        if noun.still and fitting[0] in self.predicates.objects:
            self.claims.append(self.claim("still", fitting, "", True, self.still_moment, tag))
        return fitting
