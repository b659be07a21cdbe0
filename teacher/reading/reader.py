"""The base class of the readers: the tags of a sentence, noun phrases, and lists of objects."""

from __future__ import annotations

from collections.abc import Collection, Container, Sequence
from itertools import pairwise

from dynapix.teacher.reading.claims import CUT, EITHER, JOINT, Claim, IndexedPredicates
from dynapix.teacher.reading.tagging import END, Noun, Tag

SEPARATORS = {"comma", "semicolon", "and", "break", "moment"}
"""Tags that may lie between clauses."""
ENDS = SEPARATORS | {"stop"}
"""Tags that end a clause."""
VERBS = {
    *("be", "moves", "stays", "future", "expected", "still", "show", "across", "leaves", "enters"),
    *("past", "meet", "not", "in_place"),
}
"""Tags that may be the verb of the last noun phrase before them."""
DENIALS = {"not", "none", "no_contact", "lack", "gone"}
"""Tags that deny something. In a sentence with one of them, "A or B" means neither; in any other,
it leaves open which is true, and the sentence is unreadable."""
LACKING = {"no", "lack", "gone"}
"""Words or tags before an object that need not exist."""


class UnreadableError(Exception):
    """No rule explains the next words of a sentence."""


class Reader:
    """Reads sentences of one section. For each tag, the method `on_<name>` is called, such as
    `on_region` for "near the top". A sentence with a tag that has no method, or that stands where
    its method does not expect it, is unreadable and makes no claim but "unreadable"."""

    extras: Collection[str] = ()
    """Objects that the text may name although the scene does not have them."""

    def __init__(self, predicates: IndexedPredicates, moment: str, known: list[str]) -> None:
        """Args:
        moment: The moment that the present tense of the section refers to.
        known: The objects that the text has named; the reader adds those of its section.
        """
        self.predicates = predicates
        self.moment = moment
        self.known = known
        self.last_nouns: list[str] = []
        """The objects of the last noun phrase."""

    def read(self, tags: Sequence[Tag]) -> list[Claim]:
        """Return the claims of a sentence, without verdicts."""
        self.tags = _leave_out_fillers(tags)
        self.at, self.stop = 0, len(self.tags)
        """The indexes of the current tag and of the tag before which reading stops."""
        self.claims: list[Claim] = []
        mentions = self._find_mentions()
        if all(tag.name == "stop" for tag in self.tags):
            return []
        try:
            if any(tag.words == "or" for tag in tags) and not DENIALS & {tag.name for tag in tags}:
                raise UnreadableError
            self.read_sentence()
        except UnreadableError:
            self.forget()
            if any(claim.when == CUT for claim in mentions):
                # An object that does not exist is reason enough.
                return mentions
            span = tags[0].start, tags[-1].stop
            return [*mentions, Claim("unreadable", (), "", True, self.moment, None, span)]
        return [*mentions, *self.claims]

    def read_sentence(self) -> None:
        raise NotImplementedError

    def forget(self) -> None:
        """Forget what the next sentence could refer to, since this one could not be read."""
        raise NotImplementedError

    # The current tag.

    def peek(self, offset: int = 0) -> Tag:
        """Return the tag at an offset from the current one; END outside the readable tags."""
        index = self.at + offset
        return self.tags[index] if 0 <= index < self.stop else END

    def take(self, *names: str) -> Tag | None:
        """Return the current tag and move on if it has one of these names."""
        tag = self.peek()
        if tag.name not in names:
            return None
        self.at += 1
        return tag

    def skip(self, names: Container[str]) -> list[str]:
        """Move over tags with these names, and return the names."""
        start = self.at
        while self.peek().name in names:
            self.at += 1
        return [tag.name for tag in self.tags[start : self.at]]

    def read_tags(self) -> int:
        """Read the tags up to the next separator or stop, and return their number."""
        start = self.at
        while self.peek().name not in ENDS:
            self.read_tag()
        return self.at - start

    def read_tag(self) -> None:
        """Move on, and call the method of the tag."""
        tag = self.peek()
        self.at += 1
        handler = getattr(self, f"on_{tag.name}", None)
        if handler is None:
            raise UnreadableError
        handler(tag)

    def add(
        self,
        kind: str,
        names: Sequence[str],
        value: str,
        affirmed: bool,
        when: str,
        tag: Tag,
        candidate: str | None = None,
    ) -> None:
        """Record the claim that `tag` states."""
        span = (tag.start, tag.stop)
        self.claims.append(Claim(kind, tuple(names), value, affirmed, when, candidate, span))

    # Noun phrases.

    def find_fitting(self, noun: Noun) -> list[str]:
        """Return the names of the objects that have the stated attributes."""
        return [name for name in (*self.predicates.objects, *self.extras) if noun.fits(name)]

    def _find_mentions(self) -> list[Claim]:
        """Return a claim for each object that the sentence names: that it exists."""
        found: list[Claim] = []
        for previous, tag in pairwise((END, *self.tags)):
            if not isinstance(noun := tag.value, Noun):
                continue
            fitting, span = self.find_fitting(noun), (tag.start, tag.stop)
            if len(fitting) == 1 and not noun.plural:
                found.append(Claim("mention", (*fitting,), "", True, EITHER, None, span))
            elif noun.plural and (previous.name == "and" or " " not in tag.words):
                # "The red and blue spheres", "it blocks".
                continue
            elif len(fitting) < 1 + noun.plural and not {previous.words, previous.name} & LACKING:
                phrase = f"{noun.phrase}s" if noun.plural else noun.phrase
                found.append(Claim("mention", (phrase,), "", True, CUT, None, span))
        return found

    def find_objects(self, noun: Noun) -> list[str]:
        """Return the objects that a noun phrase names. If it leaves open which one it means, and
        the text has not named just one of them, the names are joined by `JOINT`.

        Raises:
            UnreadableError: There is none, or the plural leaves open which ones are meant.
        """
        fitting = self.find_fitting(noun)
        named = [name for name in fitting if name in self.known]
        if noun.plural and named not in ([], fitting):
            # "The cubes": all, or those that the text has named.
            raise UnreadableError
        if (len(fitting) < 2 or noun.still) if noun.plural else not fitting:
            raise UnreadableError
        if len(fitting) > 1 and not noun.plural:
            if len({*named}) != 1:
                return [JOINT.join(fitting)]
            fitting = named
        self.known += fitting
        return fitting

    def read_noun(self) -> list[str]:
        """Return the objects of the noun phrase at the current tag, and move on."""
        tag = self.take("object")
        if tag is None:
            raise UnreadableError
        self.last_nouns = self.find_objects(tag.value)
        if tag.value.still:
            self.on_still_noun(tag)
        return self.last_nouns

    def on_still_noun(self, tag: Tag) -> None:
        """Record that the object of "the stationary red cube" is at rest."""
        raise UnreadableError

    def read_list(self, is_complement: bool = False) -> list[str]:
        """Return the objects of a list such as "the cube, the sphere and the cylinder", and move
        on; only the first if no "and" precedes the last.

        Args:
            is_complement: Whether the list follows its verb. An object before another verb is then
                no part of it: "hits the red cube, and the sphere stays".
        """
        self.take("both")
        places, complete = [self.at], False
        while not complete:
            self.at = places[-1] + 1
            separators = self.skip({"comma", "and"})
            last = "and" in separators
            if is_complement and last and self.peek().words in ("to", "with"):
                # "Close to the cube and to the sphere."
                self.at += 1
            is_joined = separators in (["comma"], ["and"], ["comma", "and"])
            if self.peek().name != "object" or not is_joined:
                break
            places.append(self.at)
            complete = last
        if is_complement and self.peek(1).name in VERBS:
            complete = False
        names: list[str] = []
        for place in places if complete else places[:1]:
            self.at = place
            names += self.read_noun()
        self.last_nouns = names
        return names

    def find_partners(self, tag: Tag) -> list[str]:
        """Return the other objects of a relation."""
        if None in tag.value.nouns:
            raise UnreadableError
        return [name for noun in tag.value.nouns for name in self.find_objects(noun)]

    def read_possession(self, owner: Sequence[str]) -> tuple[list[str], Tag] | None:
        """Read "the sphere left of it" after "the cube has" or "with", and return the objects of
        the relation and its tag; None, without moving on, if other words follow.

        Args:
            owner: The objects to which "it" refers.
        """
        start = self.at
        if self.peek().name == "object":
            things = self.read_noun()
            self.take("be")
            tag = self.take("relation")
            if tag is not None and tag.value.nouns == (None,) and len(things) == len(owner) == 1:
                return [*things, *owner], tag
        self.at = start
        return None


def _leave_out_fillers(tags: Sequence[Tag]) -> list[Tag]:
    """Return the tags of a sentence without words that state nothing, such as the "toward" before a
    direction. "Still" is such a word unless it ends its clause."""
    kept: list[Tag] = []
    for tag, following in zip(tags, (*tags[1:], END), strict=True):
        if tag.name == "word" and tag.words == "still":
            if following.name in ENDS:
                kept.append(tag._replace(name="still"))
        elif tag.name != "filler" and (tag.name, following.name) != ("with", "direction"):
            kept.append(tag)
    return kept
