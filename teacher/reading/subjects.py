"""Tracks the subjects, partners and pronouns of a sentence about the scene."""

from __future__ import annotations

from itertools import pairwise

from teacher.reading.clauses import ClauseReader
from teacher.reading.pairs import RELATIONS
from teacher.reading.reader import MAX_OBJECTS, Names
from teacher.reading.tagging import BOUNDARIES, Tag

VERBS = {"be", "moves", "stays", "rest", "future", "across", "leaves", "enters", "still", "past"}
"""Tags of possible verbs of a clause."""
INVERTED = {"be", "still", "rest", "future", "expected", "word"}
"""Tags of a verb before its subject: "near the top is the A"."""
BEFORE_COMPLEMENT = {"by", "close", "meet", "passed", "contact", "between", "course", "show"}
"""Tags before a noun phrase that is not a subject."""
ASIDE = {"unlike", "besides", "despite", "except", "excepting", "apart", "beside", "given"}
"""Words before a noun phrase that is only contrasted with the subject."""


class SubjectReader(ClauseReader):
    """Distinguishes the subject of a clause from other objects, if unambiguous."""

    def on_object(self, tag: Tag) -> None:
        previous = self.near(-1)
        relation = self.relation
        if relation and self.is_incomplete():
            names = self.group(2)
            relation.partners += names
            self.last = names[-1:]
            return
        if self._is_complement(previous):
            self._read_complement()
            return
        self.verbal |= self.finite
        if self._is_relative(previous):
            self.flush()
            self.last = self.group()
            self.inner = previous.tag != "which"
            # The claims in "the A, which the B hits" are ambiguous.
            self.start_clause(self.last if self.inner else [None])
            self.gapped, self.pending = False, []
            return
        fresh = self.finite or not self.subjects or self.denied_subject
        fresh |= self.pronominal or self.gapped
        # "Near the top is the A, and the B ..." states the place of the A only.
        names = self.group(1 if self.pending and self._is_clause_next() else MAX_OBJECTS)
        subjects = names if fresh else [*self.subjects, *names][-MAX_OBJECTS:]
        self.start_clause(subjects, max(0, len(subjects) - len(names)))
        self.finite = bool(self.pending) and previous.tag in INVERTED
        self.last = names[-1:]
        self.absolute = previous.tag == "with"
        self.complement = self.pronominal = self.gapped = False
        if relation and not relation.subjects:
            relation.subjects = subjects
        # "Near the top, the A and the B are close" states the place of the pair, not of its
        # objects.
        end = self.next_of({"comma", "semicolon", "break", "stop", "close"})
        self._apply_pending(places=end.tag != "close")

    def _is_relative(self, previous: Tag) -> bool:
        """Whether the noun phrase is the subject of a clause about another object or a place:
        "the A, which the B hits", "where the B was"."""
        if previous.words == "where":
            return True
        antecedent = self.sentence[self.sentence.skip(self.at - 2, {"by", "comma"}, -1)]
        places = ("object", "region", "into", "from")
        return previous.tag == "which" and antecedent.tag in places

    def _apply_pending(self, places: bool) -> None:
        """Apply the claims that precede the subject to it."""
        for pending in self.pending:
            if places or pending[0] != "region":
                self.add_claim(*pending, subjects=self.subjects)
        self.pending = []

    def _is_clause_next(self) -> bool:
        """Whether the text after the object may begin a clause: "the A, and"."""
        return self.near(1).tag == "comma" and self.near(2).tag == "and"

    def _is_complement(self, previous: Tag) -> bool:
        if previous.tag == "with":
            # "With the A near the top, ..." is about the A.
            return self.near(-2).tag not in BOUNDARIES
        if previous.tag == "contrast" and self.subjects:
            # "The A, rather than the B, ..."
            return True
        return previous.tag in BEFORE_COMPLEMENT or previous.words in ASIDE

    def _read_complement(self) -> None:
        start, previous = self.at, self.near(-1)
        # "Meets the A, and the B ...": the B begins a clause.
        names = self.group(1 if self._is_clause_next() else MAX_OBJECTS)
        if len(names) > 1 and self.near(1).tag in VERBS | {"not", "word", "show", "speed"}:
            # "Meets the A and the B stays": the B is a new subject.
            self.at = start
            names = self.group(1)
        if self.relation and not self.relation.partners:
            self.relation.partners = names
        elif previous.tag == "with":
            self.companions = names
        if previous.tag != "contrast":
            self.last = names[-1:]
        self.blocked, self.crossed, self.complement = True, False, True

    def on_which(self, tag: Tag) -> None:
        self.relative = True
        if self.near(-1).tag == "object" or self.near(-2).tag == "object":
            self.flush()
            listed = self.subjects[self.group_start :]
            several = len(listed) > 1 and not self.complement
            if several and self.near(1).words in ("both", "are"):
                # "The A and the B, which both move east."
                self.start_clause(listed)
            else:
                self.start_clause([None] if several else self.last)

    def on_pronoun(self, tag: Tag) -> None:
        previous = self.near(-1)
        if previous.tag in ("by", "with", "close", "meet", "passed", "between", "course"):
            self._read_pronoun_complement(previous)
            return
        # "Pushes the B east, itself going west", "the A pushes it east": the rest is ambiguous.
        aside = tag.words in ("itself", "themselves") and previous.tag == "comma"
        done = previous.tag == "word" and previous.words.endswith(("s", "ed", "ing"))
        if aside or (done and previous.words not in ("joins", "joining")):
            self.subjects, self.group_start = [None], 0
            return
        possessive = tag.words in ("its", "their") or self.near(1).tag == "object"
        if previous.tag == "object" or possessive or (previous.tag in VERBS and self.subjects):
            return
        listed = self._find_listed_pair(previous) if tag.words == "both" else []
        if listed:
            self.subjects, self.group_start, self.blocked = listed, 0, False
            return
        self.verbal |= self.finite
        self.start_clause(
            [None] if self._is_object_ahead() else self._find_antecedents(str(tag.value))
        )
        self.pronominal, self.gapped = True, False
        self._apply_pending(places=False)

    def _find_listed_pair(self, previous: Tag) -> Names:
        """The two listed objects that "both" refers to: "the A and the B, both near the left"."""
        listed = self.subjects[self.group_start :]
        beside = previous.tag == "comma" and self.near(-2).tag == "object"
        safe = len(listed) == 2 and None not in listed and (beside or previous.tag == "which")
        return listed if safe else []

    def _find_antecedents(self, pronoun: str) -> Names:
        """The antecedents of a pronoun, or None if ambiguous."""
        subjects = self.subjects or self.before
        if pronoun == "it":
            return list(subjects) if len(subjects) == 1 and not self.complement else [None]
        if pronoun in ("former", "latter"):
            pair = self.both()
            return [pair[pronoun == "latter"]] if len(pair) == 2 else [None]
        return self.both()

    def _is_object_ahead(self) -> bool:
        """Whether a pronoun may refer to an object that the next clause names: "although it was at
        rest, the A moves"."""
        opening = {tag.tag for tag in self.sentence.tags[: self.at]}
        return bool(opening & {"break", "maybe", "by"}) and "object" not in opening

    def _read_pronoun_complement(self, previous: Tag) -> None:
        """Handle a pronoun that is not a subject."""
        relation = self.relation
        self.complement = True
        if relation and not relation.partners:
            relation.partners = [None]
            if previous.tag == "between":
                pair = self.both()
                relation.partners = pair if len(pair) == 2 else [None, None]

    def on_rest_of(self, tag: Tag) -> None:
        if self._is_complement(self.near(-1)):
            if self.relation:
                self.relation.partners = [None]
            return
        if tag.words.endswith("scene") and self.near(-1).tag in ("word", "across", "moves"):
            # "Has crossed the scene."
            return
        self.start_clause([None])

    def on_all(self, tag: Tag) -> None:
        self.on_rest_of(tag)
        names = list(dict.fromkeys(self.mentioned))
        taken = any(
            t.tag in BEFORE_COMPLEMENT and following.tag == "object"
            for t, following in pairwise(self.sentence)
        )
        if tag.words == "all of them" and None not in names and len(names) > 1 and not taken:
            self.subjects = names

    on_no_other = on_rest_of

    def on_none(self, tag: Tag) -> None:
        if self.near(-1).tag in RELATIONS | {"by", "with"}:
            self.relation = None
            return
        self.subjects, self.denied_subject, self.finite, self.pending = [], True, False, []

    def on_candidate(self, tag: Tag) -> None:
        self.subjects = [None]
