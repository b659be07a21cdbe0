"""The base of the sentence readers: a cursor over tags, noun phrases and the extracted claims."""

from __future__ import annotations

from collections.abc import Callable
from functools import cache

from teacher.reading.certainty import Sentence
from teacher.reading.grounding import CUT, EITHER, Claim, Ground
from teacher.reading.tagging import Noun, Tag

BOUNDARIES = {"comma", "semicolon", "and", "break", "stop"}
END = Tag("stop", "", 0, 0)
MAX_OBJECTS = 9
"""The largest number of objects tracked at a time."""

Names = list[str | None]


class Reader:
    """Reads sentences tag by tag and calls the method `on_<tag>` where it exists."""

    def __init__(self, text: str, ground: Ground) -> None:
        self.text = text
        self.ground = ground
        self.claims: list[Claim] = []
        self.sentence: list[Tag] = []
        self.at = 0
        self.shared: list[tuple[str, str, tuple[str | None, ...], Tag]] = []

    def read(self, sentence: list[Tag]) -> list[Claim]:
        """The claims of a sentence, without verdicts."""
        self.claims = []
        self.sentence, self.at, self.shared = sentence, 0, []
        self.mentioned: list[str | None] = []
        self.bound: dict[int, Names] = {}
        self.begin()
        while self.at < len(sentence):
            tag = sentence[self.at]
            handler = _handler(type(self), tag.tag)
            if handler:
                handler(self, tag)
            self.at += 1
        self.end()
        whole = Sentence(self.text, sentence, self.bound)
        return [c._replace(certain=whole.is_certain(c)) for c in self.distributed(self.claims)]

    def begin(self) -> None:
        raise NotImplementedError

    def end(self) -> None:
        raise NotImplementedError

    def near(self, offset: int) -> Tag:
        """The tag at an offset from the current one; a full stop outside the sentence."""
        index = self.at + offset
        return self.sentence[index] if 0 <= index < len(self.sentence) else END

    def word(self, tag: Tag) -> str:
        return self.text[tag.start : tag.stop].lower()

    def last_word(self, tag: Tag) -> str:
        return self.word(tag).split()[-1] if tag is not END else ""

    def claim(
        self,
        kind: str,
        subjects: tuple[str | None, ...],
        value: str,
        affirmed: bool,
        when: str,
        span: Tag,
        candidate: str | None = None,
    ) -> Claim:
        # A claim with an ambiguous subject names none and stays unknown.
        names = () if None in subjects else subjects
        return Claim(kind, names, value, affirmed, when, candidate, (span.start, span.stop))

    def group(self, most: int = MAX_OBJECTS) -> tuple[list[str | None], Tag]:
        """The listed objects from the current tag on, and the last tag; moves the cursor there.
        "The A, the B and the C" is a list, "the A, the B" is not."""
        ends = [self.at]
        joined = False
        while len(ends) < most:
            step, last = self._joint(ends[-1] + 1)
            if not step or self._tag(ends[-1] + 1 + step).tag != "object":
                break
            ends.append(ends[-1] + 1 + step)
            if last:
                joined = True
                break
        if not joined:
            ends = ends[:1]
        names: list[str | None] = []
        for index in ends:
            self.at = index
            names += self.bound.setdefault(
                self.sentence[index].start, self.named(self.sentence[index])
            )
        return names, self.sentence[self.at]

    def _tag(self, index: int) -> Tag:
        return self.sentence[index] if index < len(self.sentence) else END

    def _joint(self, index: int) -> tuple[int, bool]:
        """The number of tags that join two listed objects, and whether the next object is the
        last."""
        tag, following = self._tag(index), self._tag(index + 1)
        if tag.tag == "and" or (tag.tag == "not" and self.word(tag) == "nor"):
            return 1, True
        if tag.tag == "comma" and following.tag == "and":
            return 2, True
        return (1, False) if tag.tag == "comma" else (0, False)

    def distributed(self, claims: list[Claim]) -> list[Claim]:
        """The claims without those that give several objects several values of one kind, since each
        value then belongs to one object ("near the top and near the left, respectively")."""
        for kind in {s[0] for s in self.shared} & {"region", "direction", "speed", "displaced"}:
            several = [
                s for s in self.shared if s[0] == kind and s[1] not in ("", "slightly", "clearly")
            ]
            for subjects in {s[2] for s in several}:
                values = [s for s in several if s[2] == subjects]
                if len({s[1] for s in values}) < 2:
                    continue
                spans = {(s[3].start, s[3].stop): i for i, s in enumerate(values)}
                matched = len(values) == len(subjects)
                claims = [
                    c
                    for c in claims
                    if c.kind != kind
                    or c.span not in spans
                    or (matched and c.subjects == (subjects[spans[c.span]],))
                ]
        return claims

    def named(self, tag: Tag) -> list[str | None]:
        """The objects that a noun phrase names (None if ambiguous); records claims that they
        exist."""
        noun = tag.value
        assert isinstance(noun, Noun)
        known = [*self.ground.objects, *(self.ground.extras if self.shows_extras else ())]
        fitting = [name for name in known if _fits(noun, name)]
        if len(fitting) > 1 and not (noun.color or noun.material or noun.plural or noun.others):
            # "The A cube and the B sphere move, the cube quickly."
            fitting = [name for name in fitting if name in self.mentioned] or fitting
        if not fitting and not noun.others and self.word(self.near(-1)) != "no":
            when = EITHER if self.shows_extras else CUT
            self.claims.append(
                Claim("mention", (noun.phrase,), "", True, when, None, (tag.start, tag.stop))
            )
            return [None]
        if noun.plural and len(fitting) == 2 and self.word(self.near(-1)) == "both":
            self.mentioned += fitting
            return list(fitting)
        if noun.plural or noun.others or len(fitting) != 1:
            self.mentioned.append(None)
            return [None]
        self.mentioned.append(fitting[0])
        self.claims.append(
            Claim("mention", (fitting[0],), "", True, EITHER, None, (tag.start, tag.stop))
        )
        if noun.still and fitting[0] in self.ground.objects:
            self.claims.append(
                Claim(
                    "still", (fitting[0],), "", True, self.still_when, None, (tag.start, tag.stop)
                )
            )
        return [fitting[0]]

    shows_extras = False
    """Whether the text may name objects that only a candidate shows."""
    still_when = EITHER
    """The moment at which "the stationary A" is stationary."""


@cache
def _handler(reader: type[Reader], tag: str) -> Callable[[Reader, Tag], None] | None:
    return getattr(reader, f"on_{tag.replace(' ', '_')}", None)


def _fits(noun: Noun, name: str) -> bool:
    words = name.split()
    return (
        (not noun.color or noun.color in words)
        and (not noun.material or noun.material in words)
        and (not noun.shape or noun.shape in words)
    )
