"""Decides whether a claim is certain, that is, whether its sentence cannot mean anything else.

A claim is certain if no unknown word lies between its subject and the words that state it, every
other object between them is listed with the subject, and a negation is next to the verb. "The
red cube is near the top" is certain; "the red cube recalls somebody near the top" is not. A claim
that is not certain can be supported by the predicates, but not contradicted.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import dropwhile

from teacher.reading.claims import Claim
from teacher.reading.tagging import BOUNDARIES, Sentence, Tag

PLAIN_WORDS = """
all back both just only quite same too very we see straight directly simply well alike
again already also ever here later now still then there thus where thereby newly expect
hand other contrast turn along down up together even somewhere right farthest area
course direction region time view way lead leads arrived bearing came carried charges
closes closing come comes crawls crossed driven gathered gets got joins knocked nudged
pushed reached rested sent set shown slipped stayed turned unmoved
"""
PLAIN = frozenset(PLAIN_WORDS.split())
"""Words outside phrases.yaml that leave a claim certain: mostly adverbs, nouns of place and
direction, and verbs for moving and being moved. Other words outside phrases.yaml are unknown."""
LISTING = {"and", "comma", "object", "region", "not", "all"}
"""Tags that may lie between a subject and the next listed object."""
BESIDE_NOT = {"be", "future", "moves", "moving", "show", "pronoun", "stays", "past", "by", "close"}
"""Tags that may lie between a negation and the words that it denies."""
KEPT = {"leaves", "moves", "moving", "stays"}
"""Verbs that a negation may deny without denying an affirmed claim after them, as in "has not left
its place near the top"."""
PAIRED = {"meeting", "course", "close", "time", "close region", "place of either"}
"""Kinds of claims about a pair of objects."""
NEEDS_NO_SUBJECT = {"region", "direction", "displaced", "close region", "place of either"}
"""Kinds of claims about an unknown object that are contradicted if they are false of every object
(`truth` in `teacher.reading.claims`). "No pair is on a collision course" needs no object and is
always certain."""
NAMING = {"lack", "gone", "adds", "extra", "misplace", "no_contact"}
"""Tags before an object that a candidate lacks, adds or displaces."""
CLOSING = {"stop", "semicolon", "break", "which", "show", "lack", "adds", "extra", "candidate"}
"""Tags after a list that show that its last object does not begin another clause."""
DISPLACING = {"slight", "clear", "off", "direction"}
"""Tags that turn "gone" and similar words into verbs of motion: "has gone slightly too far"."""


class CertaintyCheck:
    """Decides which claims of one sentence are certain."""

    def __init__(self, sentence: Sentence, names_at: Mapping[int, Sequence[str | None]]) -> None:
        """`names_at`: the objects of each noun phrase, by its start in the text."""
        self.sentence = sentence
        self.tags = sentence.tags
        self.names_at = names_at
        self.index_at = {tag.start: i for i, tag in enumerate(self.tags)}
        self.indexes_of: dict[str | None, list[int]] = defaultdict(list)
        """The indexes of the tags that name each object."""
        for start, names in names_at.items():
            for name in names:
                self.indexes_of[name].append(self.index_at[start])

    def is_certain(self, claim: Claim) -> bool:
        """Return whether the subject, candidate and negation of a claim are unambiguous."""
        at = self.index_at[claim.span[0]]
        if claim.kind == "mention":
            return True
        if claim.candidate is not None and not self._is_letter_plain(claim.candidate, at):
            return False
        if claim.kind == "other objects":
            # "The other objects" refers to objects of the scene.
            return not self.sentence.text[: claim.span[0]].lower().endswith("the ")
        if claim.kind == "agrees":
            return self._is_verdict_plain(claim.candidate, at)
        if not claim.subjects:
            return claim.kind not in NEEDS_NO_SUBJECT or self._is_general(at)
        if claim.kind in PAIRED:
            return self._is_pair_plain(claim, at)
        if self.tags[at].name == "object":
            return claim.candidate is None or self._is_naming_plain(at)
        return (
            self._is_complete(claim, at)
            and not (claim.candidate and self._is_second_region(at))
            and self._is_subject_plain(claim.subjects[0], at)
            and self._is_negation_plain(claim, at)
        )

    def _is_letter_plain(self, letter: str, at: int) -> bool:
        """Return whether the sentence names this candidate, or none before the claim."""
        before = any(tag.name == "candidate" for tag in self.tags[:at])
        return not before or any(t.name == "candidate" and t.value == letter for t in self.tags)

    def _is_verdict_plain(self, letter: str | None, at: int) -> bool:
        """Return whether "agrees" is stated of the last candidates before it or of a later one,
        without a limitation such as "in placing the red cube"."""
        last = self.sentence.find(at, {"candidate"}, -1)
        first = self.sentence.skip(last, {"candidate", "and", "comma"}, -1) + 1
        named = {tag.value for tag in self.tags[first : last + 1]}
        later = {tag.value for tag in self.tags[at:] if tag.name == "candidate"}
        following = self.sentence[self.sentence.skip(at + 1, {"by"})]
        qualified = _is_unknown_word(following) or following.name == "show"
        return not qualified and (not named or letter in named | later)

    def _is_general(self, at: int) -> bool:
        """Return whether a claim without a known subject must be about an object: no word of
        negation or doubt precedes it, and some listed word other than "be" does."""
        before = {tag.name for tag in self.tags[:at]}
        return not before & {"not", "contrast", "maybe", "none"} and not before <= {"word", "be"}

    def _is_naming_plain(self, at: int) -> bool:
        """Return whether the object is named in the clause of a verb such as "lacks" or "adds"."""
        following = self.sentence[self.sentence.skip(at, {"object", "and", "comma"})]
        listed = any(t.name == "object" for t in self.tags[max(0, at - 3) : at])
        if following.name in DISPLACING or (listed and following.name not in CLOSING):
            # "Lacks the red cube, and both the blue cube and the gray cube are off."
            return False
        between = self.tags[self.sentence.find(at, NAMING, -1) + 1 : at]
        return not any(t.name in ("semicolon", "break") or _is_unknown_word(t) for t in between)

    def _is_pair_plain(self, claim: Claim, at: int) -> bool:
        """Return whether no unknown word lies between the claim and the nearest names of its pair,
        and no "it" before them may be an object outside the pair."""
        indexes = [at]
        for name in claim.subjects:
            found = self.indexes_of[name]
            indexes += [i for i in found if i < at][-1:] or found[:1]
        first, last = min(indexes), max(indexes)
        if len(claim.subjects) < 2 and _is_unknown_word(self.sentence[last + 1]):
            # "The red cube touches somebody."
            return False
        opening = self.tags[: last + 1]
        names = {name for t in opening for name in self.names_at.get(t.start, ())}
        open_pronoun = any(t.name == "pronoun" and t.words == "it" for t in opening)
        return not any(map(_is_unknown_word, opening[first:])) and not (
            open_pronoun and not names <= set(claim.subjects)
        )

    def _is_complete(self, claim: Claim, at: int) -> bool:
        """Return whether nothing continues the phrase: "is covered", but not "covered a lot"."""
        following = self.sentence[at + 1]
        if claim.kind == "lacks":
            return following.name not in DISPLACING and following.value != "too"
        if claim.kind in ("region", "sight") and _is_unknown_word(following):
            return False
        takes_object = claim.kind == "sight" and following.name == "object"
        return not (takes_object and any(i < at for i in self.indexes_of[claim.subjects[0]]))

    def _is_second_region(self, at: int) -> bool:
        """Return whether a region precedes this one, as in "near the left but near the top"."""
        before = self.sentence.skip(at - 1, {"break", "by", "word", "be"}, -1)
        return self.tags[at].name == self.sentence[before].name == "region"

    def _is_subject_plain(self, name: str, at: int) -> bool:
        """Return whether the subject of the tag at `at` is certainly the object `name`."""
        before = [i for i in self.indexes_of[name] if i < at]
        after = [i for i in self.indexes_of[name] if i > at]
        if not before and not after:
            # The previous sentence named it, and this one names no other object.
            return not any(t.name == "object" or _is_unknown_word(t) for t in self.tags[:at])
        if before and _is_plain_list(_without_aside(self.tags[before[-1] + 1 : at])):
            return True
        return bool(after) and self._precedes_subject(at, after[0])

    def _precedes_subject(self, at: int, subject: int) -> bool:
        """Return whether its subject follows the claim, as in "near the top is the red cube"."""
        opening = self.tags[at + 1 : self.sentence.find(at + 1, {"object"})]
        if any(t.name in ("semicolon", "stop", "and", "break") for t in opening):
            return False
        return _is_plain_list(self.tags[at + 1 : subject])

    def _is_negation_plain(self, claim: Claim, at: int) -> bool:
        """Return whether a negation is next to a denied claim, or absent for an affirmed claim."""
        if claim.affirmed:
            return not self._is_denied(at, set() if claim.candidate else KEPT)
        if "not" in self.tags[at].words.split():
            return True
        back = self.sentence.skip(at - 1, BESIDE_NOT, -1)
        if self.sentence[back].name == "object" and self.sentence[back - 1].name == "not":
            return True
        denial = self.sentence[back]
        return denial.name in ("not", "contrast") or "not" in denial.words.split()

    def _is_denied(self, at: int, kept: set[str]) -> bool:
        """Return whether a negation denies the tag: it precedes the tag in its clause, as in "it
        cannot be near the top". A "not" directly after a comma begins a contrast and does not
        count. A tag in `kept` also begins a clause."""
        opening = self.sentence.find(at - 1, BOUNDARIES | kept, -1) + 1
        for i in range(at - 1, opening - 1, -1):
            tag = self.tags[i]
            if tag.name == "not" and tag.words not in ("nor", "no", "hardly"):
                return self.sentence[i - 1].name not in BOUNDARIES
        return False


def _is_unknown_word(tag: Tag) -> bool:
    return tag.name == "word" and tag.value not in PLAIN


def _without_aside(between: Sequence[Tag]) -> Sequence[Tag]:
    """Drop a part between commas after a subject: "the red cube, struck by the sphere, moves"."""
    if between and between[0].name == "comma":
        for i, tag in enumerate(between[1:], 1):
            if tag.name == "semicolon":
                break
            if tag.name == "comma":
                return between[i + 1 :]
    return between


def _is_plain_list(between: Sequence[Tag]) -> bool:
    """Return whether there is no unknown word, and every object is part of a list at the start."""
    unlisted = dropwhile(lambda tag: tag.name in LISTING, between)
    return not any(map(_is_unknown_word, between)) and all(t.name != "object" for t in unlisted)
