"""Finds the subjects, complements and pronouns of a sentence about the scene."""

from __future__ import annotations

from itertools import pairwise

from teacher.reading.clauses import ClauseReader
from teacher.reading.pairs import PAIR_TAGS
from teacher.reading.reader import MAX_OBJECTS, Names
from teacher.reading.tagging import BOUNDARIES, Tag

VERBS = {"be", "moves", "stays", "rest", "future", "across", "leaves", "enters", "still", "past"}
"""Tags that may be the verb of a clause."""
INVERTED = {"be", "still", "rest", "future", "expected", "word"}
"""Tags that may be a verb before its subject, as in "near the top is the red cube"."""
BEFORE_COMPLEMENT = {"by", "close", "meet", "no_contact", "contact", "between", "course", "show"}
"""Tags after which a noun phrase is a complement (not a subject), as in "hits the red cube"."""
ASIDE = {"unlike", "besides", "despite", "except", "excepting", "apart", "beside", "given"}
"""Words after which a noun phrase is only contrasted with the subject."""


class SubjectReader(ClauseReader):
    """Distinguishes the subject of a clause from its other objects."""

    def on_object(self, tag: Tag) -> None:
        previous = self.near(-1)
        event = self.pair_event
        if event and self.is_incomplete():
            names = self.read_list(2)
            event.partners += names
            self.antecedents = names[-1:]
            return
        if self._is_complement(previous):
            self._read_complement()
            return
        self.had_verb |= self.has_verb
        if self._is_relative(previous):
            self.end_pair_event()
            self.antecedents = self.read_list()
            self.in_where_clause = previous.name != "which"
            # In "the red cube, which the blue sphere hits", either may be the subject.
            self.start_clause(self.antecedents if self.in_where_clause else [None])
            self.gapped, self.pending = False, []
            return
        fresh = self.has_verb or not self.subjects or self.denied_subject
        fresh |= self.is_pronoun or self.gapped
        # "Near the top is the red cube, and the sphere ..." states only the place of the cube.
        names = self.read_list(1 if self.pending and self._is_clause_next() else MAX_OBJECTS)
        subjects = names if fresh else [*self.subjects, *names][-MAX_OBJECTS:]
        self.start_clause(subjects, max(0, len(subjects) - len(names)))
        self.has_verb = bool(self.pending) and previous.name in INVERTED
        self.antecedents = names[-1:]
        self.in_with_phrase = previous.name == "with"
        self.complement = self.is_pronoun = self.gapped = False
        if event and not event.subjects:
            event.subjects = subjects
        # "Near the top, the cube and the sphere are close" states the place of the pair only.
        end = self.next_of({"comma", "semicolon", "break", "stop", "close"})
        self._apply_pending(places=end.name != "close")

    def _is_relative(self, previous: Tag) -> bool:
        """Return whether the noun phrase is the subject of a clause about another object or a
        place: "the red cube, which the sphere hits", "where the sphere was"."""
        if previous.words == "where":
            return True
        antecedent = self.sentence[self.sentence.skip(self.cursor - 2, {"by", "comma"}, -1)]
        places = ("object", "region", "into", "from")
        return previous.name == "which" and antecedent.name in places

    def _apply_pending(self, places: bool) -> None:
        """Record the pending claims for the subject; those of regions only if `places` is true."""
        for pending in self.pending:
            if places or pending[0] != "region":
                *claim, partners = pending
                self.add_claim(*claim, subjects=self.subjects, partners=partners)
        self.pending = []

    def _is_clause_next(self) -> bool:
        """Return whether the object may end a clause: "the red cube, and"."""
        return self.near(1).name == "comma" and self.near(2).name == "and"

    def _is_complement(self, previous: Tag) -> bool:
        """Return whether a noun phrase after `previous` is not the subject."""
        if previous.name == "with":
            # "With the red cube near the top, ..." is about the cube.
            return self.near(-2).name not in BOUNDARIES
        if previous.name == "contrast" and self.subjects:
            # "The red cube, rather than the blue sphere, ..."
            return True
        return previous.name in BEFORE_COMPLEMENT or previous.words in ASIDE

    def _read_complement(self) -> None:
        """Read a noun phrase that is not the subject, such as the partners of a pair event."""
        start, previous = self.cursor, self.near(-1)
        # "Meets the red cube, and the sphere ...": the sphere begins a clause.
        names = self.read_list(1 if self._is_clause_next() else MAX_OBJECTS)
        if len(names) > 1 and self.near(1).name in VERBS | {"not", "word", "show", "speed"}:
            # "Meets the red cube and the sphere stays": the sphere is a new subject.
            self.cursor = start
            names = self.read_list(1)
        if self.pair_event and not self.pair_event.partners:
            self.pair_event.partners = names
        elif previous.name == "with":
            self.companions = names
        if previous.name != "contrast":
            self.antecedents = names[-1:]
        self.blocked, self.after_boundary, self.complement = True, False, True

    def on_which(self, tag: Tag) -> None:
        self.has_which = True
        if self.near(-1).name == "object" or self.near(-2).name == "object":
            self.end_pair_event()
            listed = self.subjects[self.list_start :]
            several = len(listed) > 1 and not self.complement
            if several and self.near(1).words in ("both", "are"):
                # "The red cube and the blue sphere, which both move east."
                self.start_clause(listed)
            else:
                self.start_clause([None] if several else self.antecedents)

    def on_pronoun(self, tag: Tag) -> None:
        previous = self.near(-1)
        if previous.name in ("by", "with", "close", "meet", "no_contact", "between", "course"):
            self._read_pronoun_complement(previous)
            return
        # "Pushes the cube east, itself going west", "pushes it east": the rest is ambiguous.
        aside = tag.words in ("itself", "themselves") and previous.name == "comma"
        done = previous.name == "word" and previous.words.endswith(("s", "ed", "ing"))
        if aside or (done and previous.words not in ("joins", "joining")):
            self.subjects, self.list_start = [None], 0
            return
        possessive = tag.words in ("its", "their") or self.near(1).name == "object"
        if previous.name == "object" or possessive or (previous.name in VERBS and self.subjects):
            return
        listed = self._find_listed_pair(previous) if tag.words == "both" else []
        if listed:
            self.subjects, self.list_start, self.blocked = listed, 0, False
            return
        self.had_verb |= self.has_verb
        open_subject = self._is_object_ahead()
        self.start_clause([None] if open_subject else self._find_antecedents(str(tag.value)))
        self.is_pronoun, self.gapped = True, False
        self._apply_pending(places=False)

    def _find_listed_pair(self, previous: Tag) -> Names:
        """Return the pair in "the cube and the sphere, both near the left"; [] if there is none."""
        listed = self.subjects[self.list_start :]
        beside = previous.name == "comma" and self.near(-2).name == "object"
        safe = len(listed) == 2 and None not in listed and (beside or previous.name == "which")
        return listed if safe else []

    def _find_antecedents(self, pronoun: str) -> Names:
        """Return the objects that a pronoun refers to, or [None] if it is ambiguous."""
        subjects = self.subjects or self.previous_subjects
        if pronoun == "it":
            return list(subjects) if len(subjects) == 1 and not self.complement else [None]
        if pronoun in ("former", "latter"):
            pair = self.find_both()
            return [pair[pronoun == "latter"]] if len(pair) == 2 else [None]
        return self.find_both()

    def _is_object_ahead(self) -> bool:
        """Return whether "it" may be a later object: "although it was at rest, the cube moves"."""
        opening = {tag.name for tag in self.sentence.tags[: self.cursor]}
        return bool(opening & {"break", "maybe", "by"}) and "object" not in opening

    def _read_pronoun_complement(self, previous: Tag) -> None:
        """Read a pronoun that is not a subject, such as the partner of a pair event."""
        event = self.pair_event
        self.complement = True
        if event and not event.partners:
            event.partners = [None]
            if previous.name == "between":
                pair = self.find_both()
                event.partners = pair if len(pair) == 2 else [None, None]

    def on_unnamed(self, tag: Tag) -> None:
        if self._is_complement(self.near(-1)):
            if self.pair_event:
                self.pair_event.partners = [None]
            return
        if tag.words.endswith("scene") and self.near(-1).name in ("word", "across", "moves"):
            # "Has crossed the scene": the scene is not an object.
            return
        self.start_clause([None])

    def on_all(self, tag: Tag) -> None:
        self.on_unnamed(tag)
        names = list(dict.fromkeys(self.mentioned))
        taken = any(
            t.name in BEFORE_COMPLEMENT and following.name == "object"
            for t, following in pairwise(self.sentence)
        )
        if tag.words == "all of them" and None not in names and len(names) > 1 and not taken:
            self.subjects = names

    on_no_other = on_unnamed

    def on_none(self, tag: Tag) -> None:
        if self.near(-1).name in PAIR_TAGS | {"by", "with"}:
            self.pair_event = None
            return
        self.subjects, self.denied_subject, self.has_verb, self.pending = [], True, False, []

    def on_candidate(self, tag: Tag) -> None:
        self.subjects = [None]
