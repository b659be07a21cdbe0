"""Decides whether the subject of a claim is certain; predicates contradict only certain claims.

A claim is certain in a plain clause: its subject and its predicate are close together, every word
between them is in the vocabulary, every further object is listed with the subject, and a negation,
if any, is next to the verb. Other claims can be supported but never contradicted.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping, Sequence

from teacher.reading.grounding import Claim
from teacher.reading.tagging import Tag

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
ENDS = {"comma", "semicolon", "break", "stop", "and"}
KEPT = {"leaves", "moves", "moving", "stays"}
"""Tags whose negation keeps the stated place: "has not left its place"."""
PAIRED = {"meeting", "course", "close", "time", "close region", "place of either"}
UNBOUND = {"region", "direction", "displaced", "close region", "place of either"}
"""Kinds of claims that may be false whatever their subject is."""
NAMING = {"lack", "gone", "adds", "extra", "misplace", "passed"}
"""Tags after which an object is one that a candidate lacks, adds or displaces."""
CLOSING = {"stop", "semicolon", "break", "which", "show", "lack", "adds", "extra", "candidate"}
"""Tags that may follow a list without ending it before its last object."""
COMPARED = {"slight", "clear", "off", "direction"}
"""Tags after words such as "gone" that make them verbs of motion: "has gone slightly too far"."""


class Sentence:
    """A sentence's tags and the objects that its noun phrases name."""

    def __init__(
        self, text: str, tags: Sequence[Tag], bound: Mapping[int, Sequence[str | None]]
    ) -> None:
        """`bound`: object names by the start of their noun phrase in the text."""
        self.text = text
        self.tags = tags
        self.bound = bound
        self.positions = {tag.start: i for i, tag in enumerate(tags)}
        self.places: dict[str | None, list[int]] = {}
        for start, names in bound.items():
            for name in names:
                self.places.setdefault(name, []).append(self.positions[start])

    def is_certain(self, claim: Claim) -> bool:
        """Whether the subject, candidate and negation of a claim of this sentence are
        unambiguous."""
        at = self.positions[claim.span[0]]
        if claim.kind == "mention":
            return True
        if claim.candidate is not None and not self._is_letter_plain(claim.candidate, at):
            return False
        if claim.kind == "other objects":
            # "The other objects" refers to objects of the scene.
            return not self.text[: claim.span[0]].lower().endswith("the ")
        if claim.kind == "agrees":
            return self._is_verdict_whole(claim, at)
        if not claim.subjects:
            return claim.kind not in UNBOUND or self._is_general(at)
        if claim.kind in PAIRED:
            return self._is_pair_plain(claim, at)
        if self.tags[at].tag == "object":
            return claim.candidate is None or self._is_naming_plain(at)
        return (
            self._is_complete(claim, at)
            and not (claim.candidate and self._is_second(at))
            and self._is_subject_plain(claim.subjects[0], at)
            and self._is_negation_plain(claim, at)
        )

    def _is_letter_plain(self, letter: str, at: int) -> bool:
        """Whether the sentence names the claim's candidate, or no candidate before the claim."""
        before = any(tag.tag == "candidate" for tag in self.tags[:at])
        return not before or any(t.tag == "candidate" and t.value == letter for t in self.tags)

    def _is_verdict_whole(self, claim: Claim, at: int) -> bool:
        """Whether an agreement refers to the candidate named last without a qualification ("in
        placing the A near the left")."""
        if not self._is_named_last(claim.candidate, at):
            return False
        ahead = at + 1
        while ahead < len(self.tags) and self.tags[ahead].tag == "by":
            ahead += 1
        following = self.tags[ahead : ahead + 1]
        return not any(_is_unknown_word(tag) or tag.tag == "show" for tag in following)

    def _is_named_last(self, letter: str | None, at: int) -> bool:
        last = at
        while last >= 0 and self.tags[last].tag != "candidate":
            last -= 1
        named = set()
        while last >= 0 and self.tags[last].tag in ("candidate", "and", "comma"):
            named.add(self.tags[last].value)
            last -= 1
        later = {tag.value for tag in self.tags[at:] if tag.tag == "candidate"}
        return not named or letter in named | later

    def _is_general(self, at: int) -> bool:
        """Whether a claim without a known subject still refers to some object."""
        opening = self.tags[:at]
        steered = any(t.tag in ("not", "contrast", "maybe", "none") for t in opening)
        return not steered and any(t.tag not in ("word", "be") for t in opening)

    def _is_naming_plain(self, at: int) -> bool:
        """Whether the object is named in the clause of a verb such as "lacks" or "adds"."""
        ahead = at
        while self.tags[ahead].tag in ("object", "and", "comma") and ahead + 1 < len(self.tags):
            ahead += 1
        listed = any(t.tag == "object" for t in self.tags[max(0, at - 3) : at])
        if self.tags[ahead].tag in COMPARED or (listed and self.tags[ahead].tag not in CLOSING):
            # "Lacks the A, and both the B and the C are off."
            return False
        back = at
        while back >= 0 and self.tags[back].tag not in NAMING:
            if self.tags[back].tag in ("semicolon", "break") or _is_unknown_word(self.tags[back]):
                return False
            back -= 1
        return True

    def _is_pair_plain(self, claim: Claim, at: int) -> bool:
        spots = [at]
        for name in claim.subjects:
            spots += self._nearest(name, at)
        following = self.tags[max(spots) + 1 : max(spots) + 2]
        if len(claim.subjects) < 2 and any(map(_is_unknown_word, following)):
            # "Touches nothing" and similar phrases.
            return False
        between = self.tags[min(spots) : max(spots) + 1]
        opening = self.tags[: max(spots) + 1]
        return not any(map(_is_unknown_word, between)) and not self._is_pronoun_open(claim, opening)

    def _is_pronoun_open(self, claim: Claim, opening: Sequence[Tag]) -> bool:
        """Whether an "it" may refer to an object outside the claim."""
        names = {name for t in opening for name in self.bound.get(t.start, ())}
        pronoun = any(
            t.tag == "pronoun" and self.text[t.start : t.stop].lower() == "it" for t in opening
        )
        return pronoun and not names <= set(claim.subjects)

    def _is_complete(self, claim: Claim, at: int) -> bool:
        """Whether the claim ends with its phrase ("covered", but not "covered more ground")."""
        following = self.tags[at + 1] if at + 1 < len(self.tags) else None
        if following is None:
            return True
        if claim.kind == "lacks":
            return following.tag not in COMPARED and str(following.value) != "too"
        takes_object = claim.kind == "sight" and following.tag == "object"
        return not (claim.kind in ("region", "sight") and _is_unknown_word(following)) and not (
            takes_object and any(i < at for i in self.places.get(claim.subjects[0], ()))
        )

    def _is_second(self, at: int) -> bool:
        """Whether the clause states an earlier place of its object: "near the left, <...> near the
        top"."""
        back = at - 1
        while back >= 0 and self.tags[back].tag in ("break", "by", "word", "be"):
            back -= 1
        return self.tags[at].tag == self.tags[back].tag == "region"

    def _is_subject_plain(self, name: str, at: int) -> bool:
        before = [i for i in self.places.get(name, []) if i < at]
        after = [i for i in self.places.get(name, []) if i > at]
        if not before and not after:
            # The previous sentence named it, and this one names no other object.
            return not any(t.tag == "object" or _is_unknown_word(t) for t in self.tags[:at])
        return bool(before and self._follows_subject(before[-1], at)) or bool(
            after and self._precedes_subject(at, after[0])
        )

    def _follows_subject(self, spot: int, at: int) -> bool:
        between = _without_aside(self.tags[spot + 1 : at])
        return not any(map(_is_unknown_word, between)) and _is_one_list(between)

    def _precedes_subject(self, at: int, spot: int) -> bool:
        """Whether the claim opens the clause and its subject follows."""
        between = self.tags[at + 1 : spot]
        first = next((i for i, t in enumerate(between) if t.tag == "object"), len(between))
        if any(t.tag in ("semicolon", "stop", "and", "break") for t in between[:first]):
            return False
        return not any(map(_is_unknown_word, between)) and _is_one_list(between)

    def _is_negation_plain(self, claim: Claim, at: int) -> bool:
        if claim.affirmed:
            return not self._is_denied(at, set() if claim.candidate else KEPT)
        if "not" in self.text[slice(*claim.span)].lower().split():
            return True
        back = at - 1
        while back >= 0 and self.tags[back].tag in BESIDE_NOT:
            back -= 1
        while back > 0 and self.tags[back].tag == "object" and self.tags[back - 1].tag == "not":
            back -= 1
        return back >= 0 and (
            self.tags[back].tag in ("not", "contrast") or "not" in self.word(back).split()
        )

    def _is_denied(self, at: int, kept: set[str]) -> bool:
        """Whether the clause that ends here contains a negation: "cannot be near the top yet",
        but not "near the left, not near the top"."""
        back = at - 1
        while back >= 0 and self.tags[back].tag not in ENDS | kept:
            if self.tags[back].tag == "not" and self.word(back) not in ("nor", "no", "hardly"):
                return back > 0 and self.tags[back - 1].tag not in ENDS
            back -= 1
        return False

    def word(self, at: int) -> str:
        return self.text[self.tags[at].start : self.tags[at].stop].lower()

    def _nearest(self, name: str, at: int) -> list[int]:
        """The last position before `at` where an object is named, otherwise the first after it."""
        places = self.places.get(name, [])
        return [i for i in places if i < at][-1:] or places[:1]


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


def _is_one_list(between: Iterable[Tag]) -> bool:
    """Whether every further object is listed with the first."""
    listing = True
    for tag in between:
        if tag.tag == "object" and not listing:
            return False
        listing &= tag.tag in LISTING
    return True
