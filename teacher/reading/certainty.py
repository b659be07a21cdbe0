"""Decides whether the subject of a claim is certain; predicates contradict only certain claims.

A claim is certain in a plain clause: its subject and its predicate are close together, every word
between them is in the vocabulary, every further object is listed with the subject, and a negation,
if any, is next to the verb. Other claims can be supported but never contradicted.
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping, Sequence
from itertools import dropwhile

from teacher.reading.grounding import Claim
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
"""Words outside the vocabulary that keep a clause plain: adverbs, nouns of place and direction,
verbs of moving and of being moved."""
LISTING = {"and", "comma", "object", "region", "not", "all"}
"""Tags allowed between the objects of a list."""
BESIDE_NOT = {"be", "future", "moves", "moving", "show", "pronoun", "stays", "past", "by", "close"}
"""Tags allowed between a negation and what it denies."""
KEPT = {"leaves", "moves", "moving", "stays"}
"""Tags whose negation keeps the stated place: "has not left its place"."""
PAIRED = {"meeting", "course", "close", "time", "close region", "place of either"}
UNBOUND = {"region", "direction", "displaced", "close region", "place of either"}
"""Kinds of claims that may be false whatever their subject is."""
NAMING = {"lack", "gone", "adds", "extra", "misplace", "passed"}
"""Tags after which an object is one that a candidate lacks, adds or displaces."""
CLOSING = {"stop", "semicolon", "break", "which", "show", "lack", "adds", "extra", "candidate"}
"""Tags behind a list that do not make its last object the subject of another clause."""
COMPARED = {"slight", "clear", "off", "direction"}
"""Tags after words such as "gone" that make them verbs of motion: "has gone slightly too far"."""


class CertaintyCheck:
    """Decides which claims of one sentence are certain."""

    def __init__(self, sentence: Sentence, bound: Mapping[int, Sequence[str | None]]) -> None:
        """`bound`: object names by the start of their noun phrase in the text."""
        self.sentence = sentence
        self.tags = sentence.tags
        self.bound = bound
        self.indexes = {tag.start: i for i, tag in enumerate(self.tags)}
        self.named_at: dict[str | None, list[int]] = defaultdict(list)
        """The indexes of the tags that name each object."""
        for start, names in bound.items():
            for name in names:
                self.named_at[name].append(self.indexes[start])

    def is_certain(self, claim: Claim) -> bool:
        """Whether the subject, candidate and negation of a claim are unambiguous."""
        at = self.indexes[claim.span[0]]
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
            return claim.kind not in UNBOUND or self._is_general(at)
        if claim.kind in PAIRED:
            return self._is_pair_plain(claim, at)
        if self.tags[at].tag == "object":
            return claim.candidate is None or self._is_naming_plain(at)
        return (
            self._is_complete(claim, at)
            and not (claim.candidate and self._is_second_region(at))
            and self._is_subject_plain(claim.subjects[0], at)
            and self._is_negation_plain(claim, at)
        )

    def _is_letter_plain(self, letter: str, at: int) -> bool:
        """Whether the sentence names the claim's candidate, or no candidate before the claim."""
        before = any(tag.tag == "candidate" for tag in self.tags[:at])
        return not before or any(t.tag == "candidate" and t.value == letter for t in self.tags)

    def _is_verdict_plain(self, letter: str | None, at: int) -> bool:
        """Whether an agreement is that of a candidate named last or later, without a qualification
        ("in placing the A near the left")."""
        last = self.sentence.find(at, {"candidate"}, -1)
        first = self.sentence.skip(last, {"candidate", "and", "comma"}, -1) + 1
        named = {tag.value for tag in self.tags[first : last + 1]}
        later = {tag.value for tag in self.tags[at:] if tag.tag == "candidate"}
        following = self.sentence[self.sentence.skip(at + 1, {"by"})]
        qualified = _is_unknown_word(following) or following.tag == "show"
        return not qualified and (not named or letter in named | later)

    def _is_general(self, at: int) -> bool:
        """Whether a claim without a known subject still refers to some object."""
        before = {tag.tag for tag in self.tags[:at]}
        return not before & {"not", "contrast", "maybe", "none"} and not before <= {"word", "be"}

    def _is_naming_plain(self, at: int) -> bool:
        """Whether the object is named in the clause of a verb such as "lacks" or "adds"."""
        following = self.sentence[self.sentence.skip(at, {"object", "and", "comma"})]
        listed = any(t.tag == "object" for t in self.tags[max(0, at - 3) : at])
        if following.tag in COMPARED or (listed and following.tag not in CLOSING):
            # "Lacks the A, and both the B and the C are off."
            return False
        between = self.tags[self.sentence.find(at, NAMING, -1) + 1 : at]
        return not any(t.tag in ("semicolon", "break") or _is_unknown_word(t) for t in between)

    def _is_pair_plain(self, claim: Claim, at: int) -> bool:
        """Whether nothing between the claim and the nearest names of its pair is unknown, and no
        "it" may be an object outside the pair."""
        indexes = [at]
        for name in claim.subjects:
            found = self.named_at[name]
            indexes += [i for i in found if i < at][-1:] or found[:1]
        first, last = min(indexes), max(indexes)
        if len(claim.subjects) < 2 and _is_unknown_word(self.sentence[last + 1]):
            # "Touches nothing" and similar phrases.
            return False
        opening = self.tags[: last + 1]
        names = {name for t in opening for name in self.bound.get(t.start, ())}
        open_pronoun = any(t.tag == "pronoun" and t.words == "it" for t in opening)
        return not any(map(_is_unknown_word, opening[first:])) and not (
            open_pronoun and not names <= set(claim.subjects)
        )

    def _is_complete(self, claim: Claim, at: int) -> bool:
        """Whether the claim ends with its phrase ("covered", but not "covered more ground")."""
        following = self.sentence[at + 1]
        if claim.kind == "lacks":
            return following.tag not in COMPARED and following.value != "too"
        if claim.kind in ("region", "sight") and _is_unknown_word(following):
            return False
        takes_object = claim.kind == "sight" and following.tag == "object"
        return not (takes_object and any(i < at for i in self.named_at[claim.subjects[0]]))

    def _is_second_region(self, at: int) -> bool:
        """Whether the clause states an earlier place of its object: "near the left, <...> near the
        top"."""
        before = self.sentence.skip(at - 1, {"break", "by", "word", "be"}, -1)
        return self.tags[at].tag == self.sentence[before].tag == "region"

    def _is_subject_plain(self, name: str, at: int) -> bool:
        before = [i for i in self.named_at[name] if i < at]
        after = [i for i in self.named_at[name] if i > at]
        if not before and not after:
            # The previous sentence named it, and this one names no other object.
            return not any(t.tag == "object" or _is_unknown_word(t) for t in self.tags[:at])
        if before and _is_plain_list(_without_aside(self.tags[before[-1] + 1 : at])):
            return True
        return bool(after) and self._precedes_subject(at, after[0])

    def _precedes_subject(self, at: int, subject: int) -> bool:
        """Whether the claim opens the clause and its subject follows."""
        opening = self.tags[at + 1 : self.sentence.find(at + 1, {"object"})]
        if any(t.tag in ("semicolon", "stop", "and", "break") for t in opening):
            return False
        return _is_plain_list(self.tags[at + 1 : subject])

    def _is_negation_plain(self, claim: Claim, at: int) -> bool:
        if claim.affirmed:
            return not self._is_denied(at, set() if claim.candidate else KEPT)
        if "not" in self.tags[at].words.split():
            return True
        back = self.sentence.skip(at - 1, BESIDE_NOT, -1)
        if self.sentence[back].tag == "object" and self.sentence[back - 1].tag == "not":
            return True
        denial = self.sentence[back]
        return denial.tag in ("not", "contrast") or "not" in denial.words.split()

    def _is_denied(self, at: int, kept: set[str]) -> bool:
        """Whether the clause that ends here contains a negation: "cannot be near the top yet",
        but not "near the left, not near the top"."""
        opening = self.sentence.find(at - 1, BOUNDARIES | kept, -1) + 1
        for i in range(at - 1, opening - 1, -1):
            tag = self.tags[i]
            if tag.tag == "not" and tag.words not in ("nor", "no", "hardly"):
                return self.sentence[i - 1].tag not in BOUNDARIES
        return False


def _is_unknown_word(tag: Tag) -> bool:
    return tag.tag == "word" and tag.value not in PLAIN


def _without_aside(between: Sequence[Tag]) -> Sequence[Tag]:
    """The text after a subject without a part between commas: "the A, struck by the B, moves"."""
    if between and between[0].tag == "comma":
        for i, tag in enumerate(between[1:], 1):
            if tag.tag == "semicolon":
                break
            if tag.tag == "comma":
                return between[i + 1 :]
    return between


def _is_plain_list(between: Sequence[Tag]) -> bool:
    """Whether every word is known and every object is listed at the beginning."""
    unlisted = dropwhile(lambda tag: tag.tag in LISTING, between)
    return not any(map(_is_unknown_word, between)) and all(t.tag != "object" for t in unlisted)
