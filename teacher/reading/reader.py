"""The base of the sentence readers: a cursor over tags, noun phrases and the extracted claims."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Container, Sequence

from teacher.reading.certainty import CertaintyCheck
from teacher.reading.grounding import CUT, EITHER, Claim, Ground
from teacher.reading.tagging import Noun, Sentence, Tag

MAX_OBJECTS = 9
"""The largest number of objects tracked at a time."""

Names = list[str | None]
"""Names of objects; None if it is ambiguous which object is meant."""


class Reader:
    """Reads sentences tag by tag and calls the method `on_<tag>` where it exists."""

    shows_extras = False
    """Whether the text may name objects that only a candidate shows."""
    still_when = EITHER
    """The moment at which "the stationary A" is stationary."""

    def __init__(self, ground: Ground) -> None:
        self.ground = ground

    def read(self, sentence: Sentence) -> list[Claim]:
        """The claims of a sentence, without verdicts."""
        self.sentence = sentence
        self.at = 0
        self.claims: list[Claim] = []
        self.mentioned: Names = []
        self.bound: dict[int, Names] = {}
        """The objects that a noun phrase names, by its start in the text."""
        self.shared: dict[tuple[str, tuple[str | None, ...]], dict[tuple[int, int], str]] = (
            defaultdict(dict)
        )
        """The values that a list of objects shares, by kind and objects, then by span."""
        self.begin()
        while self.at < len(sentence.tags):
            tag = sentence[self.at]
            if handler := getattr(self, f"on_{tag.tag}", None):
                handler(tag)
            self.at += 1
        self.end()
        check = CertaintyCheck(sentence, self.bound)
        return [c._replace(certain=check.is_certain(c)) for c in self._distribute(self.claims)]

    def begin(self) -> None:
        raise NotImplementedError

    def end(self) -> None:
        raise NotImplementedError

    def near(self, offset: int) -> Tag:
        """The tag at an offset from the current one; END outside the sentence."""
        return self.sentence[self.at + offset]

    def next_of(self, wanted: Container[str], step: int = 1) -> Tag:
        """The next tag that is in `wanted` (before the current one if `step` is -1), or END."""
        return self.sentence[self.sentence.find(self.at + step, wanted, step)]

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
        """A claim that `tag` states. If a subject is ambiguous, it names none and stays unknown."""
        names = () if None in subjects else tuple(subjects)
        return Claim(kind, names, value, affirmed, when, candidate, (tag.start, tag.stop))

    def group(self, most: int = MAX_OBJECTS) -> Names:
        """The listed objects from the current tag on; moves the cursor to the last of them.
        "The A, the B and the C" is a list, "the A, the B" is not."""
        ends, complete = [self.at], False
        while len(ends) < most and not complete:
            step = ends[-1] + 1
            comma = self.sentence[step].tag == "comma"
            if comma and self.sentence[step + 1].tag == "and":
                step += 1
            complete = self.sentence[step].tag == "and" or self.sentence[step].words == "nor"
            if not (comma or complete) or self.sentence[step + 1].tag != "object":
                complete = False
                break
            ends.append(step + 1)
        names: Names = []
        for index in ends if complete else ends[:1]:
            self.at = index
            tag = self.sentence[index]
            names += self.bound.setdefault(tag.start, self._find_objects(tag))
        return names

    def share(self, kind: str, value: str, subjects: Names, tag: Tag) -> None:
        """Record a value that the text states of several objects at once."""
        exclusive = kind in ("region", "direction", "speed", "displaced")
        if len(subjects) > 1 and exclusive and value not in ("", "slightly", "clearly"):
            self.shared[kind, tuple(subjects)][tag.start, tag.stop] = value

    def _distribute(self, claims: list[Claim]) -> list[Claim]:
        """The claims without those that give several objects several values of one kind, since each
        value then belongs to one object ("near the top and near the left, respectively")."""
        for (kind, subjects), values in self.shared.items():
            if len(set(values.values())) < 2:
                continue
            owners = (
                dict(zip(values, subjects, strict=True)) if len(values) == len(subjects) else {}
            )
            claims = [
                c
                for c in claims
                if c.kind != kind or c.span not in values or c.subjects == (owners.get(c.span),)
            ]
        return claims

    def _find_objects(self, tag: Tag) -> Names:
        """The objects that a noun phrase names; records claims that they exist."""
        noun = tag.value
        assert isinstance(noun, Noun)
        known = [*self.ground.objects, *(self.ground.extras if self.shows_extras else ())]
        fitting = [name for name in known if noun.fits(name)]
        previous = self.near(-1).words
        if len(fitting) > 1 and not (noun.color or noun.material or noun.plural or noun.others):
            # "The A cube and the B sphere move, the cube quickly."
            fitting = [name for name in fitting if name in self.mentioned] or fitting
        if not fitting and not noun.others and previous != "no":
            when = EITHER if self.shows_extras else CUT
            self.claims.append(self.claim("mention", [noun.phrase], "", True, when, tag))
            return [None]
        if noun.plural and len(fitting) == 2 and previous == "both":
            self.mentioned += fitting
            return fitting
        if noun.plural or noun.others or len(fitting) != 1:
            self.mentioned.append(None)
            return [None]
        self.mentioned += fitting
        self.claims.append(self.claim("mention", fitting, "", True, EITHER, tag))
        if noun.still and fitting[0] in self.ground.objects:
            self.claims.append(self.claim("still", fitting, "", True, self.still_when, tag))
        return fitting
