"""Reads the clauses of a sentence about the scene: their subjects, verbs and meetings."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, field
from itertools import product

from dynapix.teacher.predicates.facts import OUT_OF_VIEW
from dynapix.teacher.reading.claims import BETWEEN, CUT, EITHER, TARGET
from dynapix.teacher.reading.reader import ENDS, SEPARATORS, Reader, UnreadableError
from dynapix.teacher.reading.tagging import Tag

SUBJECT_STARTS = {"object", "both", "pronoun", "unnamed", "all", "none", "paths", "other_objects"}
"""Tags that may begin a subject."""
FRONTED = {
    *("region", "from", "direction", "speed", "still", "moving", "out", "hidden", "be", "slight"),
    *("across", "toward", "into"),
}
"""Tags that may precede their subject, as in "near the top is the red cube"."""
OF_CONTACT = {"be", "future", "expected", "time", "occurs", "region"}
"""Tags of the clause after "the contact between the cube and the sphere"."""
PLURAL = {"are", "were", "do", "have", "move", "meet", "collide", "stay", "remain"}
FINITE = {
    *("be", "moves", "stays", "future", "across", "leaves", "enters", "show", "past", "expected"),
}
OPENING = ("once ", "when ", "after ")
"""First words of the phrases for a contact that precede their subject."""


@dataclass
class Clause:
    """The subject of a clause, and what its words have said of it so far."""

    subjects: list[str]
    kind: str = "objects"
    """"all" for "all objects" and "the other objects", "none" for "no pair", and "contact" for "the
    contact between the cube and the sphere"."""
    has_verb: bool = False
    negated: bool = False
    future: bool = False
    past: bool = False
    staying: bool = False
    moving: bool = False
    on_path: bool = False
    """Whether the clause is about the path up to the target."""
    slight: Tag | None = None
    time: Tag | None = None
    event: str = ""
    """The kind of the last claim about a pair, and the pairs."""
    pairs: list[tuple[str, ...]] = field(default_factory=list)
    said: set[str] = field(default_factory=set)
    """The kinds of the claims about the subjects."""
    has_complement: bool = False
    """Whether the last words were about another object, too, so that the next may be about it."""


class ClauseReader(Reader):
    """Divides a sentence into clauses, and finds the subject of each."""

    clause: Clause | None = None
    previous: Clause | None = None

    def read_sentence(self) -> None:
        self.previous, self.clause = self.clause or self.previous, None
        self.carried: list[str] = []
        """The subjects of clauses without a verb, which may share the next verb: "the cube near the
        top and the sphere near the left are at rest"."""
        self.frame: list[str] = []
        """The pair of "between the cube and the sphere, the cube moves west"."""
        self.opening: Tag | None = None
        """The moment with which the sentence opens."""
        self.is_bare = self.was_verbal = False
        """Whether nothing was said of the last subject; whether an earlier clause had a verb."""
        while True:
            separators = self.skip(SEPARATORS)
            if self.peek().name == "stop":
                break
            self._read_clause(separators)
        if self.is_bare or self.clause is None:
            raise UnreadableError

    def forget(self) -> None:
        self.clause = self.previous = None

    # Subjects.

    def _read_clause(self, separators: Sequence[str]) -> None:
        self._read_opening()
        is_there = self._read_there()
        if self.take("between"):
            self.frame = self.read_list()
            return
        if which := self.take("which"):
            self.on_which(which)
            self.is_bare = False
            return
        is_struck = self.peek().words.startswith(OPENING)
        self._begin_clause(separators, is_there)
        is_said = is_struck or self.clause.event or self.clause.said
        self.is_bare = not self._read_predicate() and not is_said

    def _read_opening(self) -> None:
        """Read "at the target moment," or "soon,"."""
        follows = self.peek(1).name in SUBJECT_STARTS | {"comma", "contact"}
        if follows and (tag := self.take("future", "time", "past", "expected")):
            self.take("comma")
            self.opening = tag

    def _read_there(self) -> bool:
        """Read "there is" and "there will be", and return whether the clause begins with it."""
        if not self.take("there"):
            return False
        self.take("future", "expected")
        self.skip({"be"})
        if self.peek(1).name == "contact":
            self.opening = self.take("time") or self.opening
        return True

    def _begin_clause(self, separators: Sequence[str], is_there: bool) -> None:
        """Read the subject of the clause, and what precedes it. Without one, the clause is about
        the last subject."""
        tag = self.peek()
        if tag.words.startswith(OPENING):
            # "Once struck, the cube moves west."
            self.at += 1
            self.take("comma")
            self.begin(self.read_subject())
            self.on_struck(tag)
            self.clause.event = ""
        elif tag.words == "with":
            self.at += 1
            self.begin(self.read_subject())
        elif self._read_fronted(separators, nominal=is_there):
            return
        elif tag.name in SUBJECT_STARTS or tag.words == "neither":
            if self.clause is None and tag.name == "pronoun" and "break" in separators:
                # "As it moves west, the cube leaves": "it" is the cube.
                raise UnreadableError
            self.begin(self.read_subject())
        elif tag.name in ("contact", "no_contact", "course") and (
            self.clause is None or self.peek(1).name in ("between", "links", "be", "occurs")
        ):
            self._read_contact()
        elif self.clause is None or is_there or self.peek(-1).words == "or":
            raise UnreadableError
        else:
            self.clause.negated = False
            self.clause.event = self.clause.event if self.clause.event == "close" else ""

    def begin(self, clause: Clause) -> None:
        """Begin a clause with another subject."""
        if self.clause is not None:
            self.was_verbal |= self.clause.has_verb
            self.carried = [] if self.clause.has_verb else [*self.carried, *self.clause.subjects]
        if self.frame and not {*clause.subjects} <= {*self.frame}:
            raise UnreadableError
        self.clause = clause
        if self.opening is not None:
            clause.past = self.opening.name == "past"
            clause.future = not clause.past
            clause.time = self.opening if self.opening.name == "time" else None

    def read_subject(self) -> Clause:
        tag = self.peek()
        if tag.words == "neither":
            self.at += 1
            names = self.read_noun()
            self.take("comma")
            if (joint := self.take("not")) is None or joint.words != "nor":
                raise UnreadableError
            return Clause([*names, *self.read_noun()], negated=True)
        if tag.name == "object" or (tag.name == "both" and self.peek(1).name == "object"):
            return Clause(self.read_list())
        self.at += 1
        if tag.name == "paths":
            # "The paths of the cube and the sphere lead to a collision."
            self.take("with", "between")
            return Clause(self.read_list())
        if tag.name in ("pronoun", "both"):
            return Clause(self._find_antecedents(tag.value))
        if tag.name == "none":
            return Clause([], "none")
        if tag.name != "all":
            # Which objects "the others" are depends on those that the text leaves out.
            return Clause([], "all")
        # The built-in narrator says nothing of objects that are out of view at the cut.
        objects = self.predicates.objects.values()
        return Clause([o.object for o in objects if o.sight != OUT_OF_VIEW], "all")

    def _find_antecedents(self, pronoun: str) -> list[str]:
        """Return the objects that a pronoun refers to."""
        last = self.clause or self.previous
        if last is None or (len(last.subjects) == 1) != (pronoun == "it"):
            raise UnreadableError
        if not last.subjects or not {*self.last_nouns} <= {*last.subjects}:
            # "The cube hits the sphere. It moves west": either may.
            raise UnreadableError
        return last.subjects

    def _read_fronted(self, separators: Sequence[str], nominal: bool) -> bool:
        """Read words that precede their subject, also as in "there is a slight shift of the cube"
        if `nominal` is true, and the subject. Return False, without moving on, if there are none.
        """
        start = self.at
        self.skip(FRONTED | {"moves"} if nominal else FRONTED)
        end = self.at
        if nominal and self.peek().words == "of":
            self.at += 1
        elif end > start and (self.clause is None or separators[-1:] in (["break"], ["semicolon"])):
            self.take("comma")
        if self.at == start or self.peek().name not in SUBJECT_STARTS:
            self.at = start
            return False
        self.begin(self.read_subject())
        resume, last = self.at, self.stop
        self.at, self.stop = start, end
        self._read_predicate()
        self.at, self.stop = resume, last
        return True

    def _read_contact(self) -> None:
        """Read "the contact between the cube and the sphere" as a subject."""
        tag, last = self.peek(), self.clause or self.previous
        self.at += 1
        self.begin(Clause([], "contact"))
        if self.take("between", "with", "links"):
            kind = "course" if tag.name == "course" else "meeting"
            self.add_event(kind, tag, self.read_list(), [], tag.name != "no_contact")
        elif tag.name != "contact":
            raise UnreadableError
        elif last is not None and (last.pairs or len(last.subjects) == 2):
            # "They are on a collision course, and contact is imminent."
            self.add_event("meeting", tag, [*(last.pairs or [last.subjects])[0]], [])

    # Predicates.

    def _read_predicate(self) -> int:
        """Read what the clause says of its subject, and return the number of tags."""
        count = self.read_tags()
        self.end_predicate()
        return count

    def end_predicate(self) -> None:
        clause = self.clause
        if clause.slight is not None:
            if not clause.moving:
                raise UnreadableError
            self.state("extent", "shifts slightly", BETWEEN, clause.slight)
            clause.slight = None

    def state(self, kind: str, value: str, when: str, tag: Tag, affirmed: bool = True) -> None:
        """Record a claim about each subject of the clause."""
        clause = self.clause
        about_rest = kind in ("extent", "still") and (clause.has_verb or clause.kind == "objects")
        if clause.kind != "objects" and not (clause.kind == "all" and about_rest):
            raise UnreadableError
        if clause.event == "meeting" or clause.has_complement:
            # "Is knocked out of view", "meets the sphere near the top".
            raise UnreadableError
        if len(clause.subjects) > 1 and kind in clause.said:
            # "The cube and the sphere are near the top and near the left."
            raise UnreadableError
        clause.said.add(kind)
        for name in clause.subjects:
            self.add(kind, [name], value, affirmed != clause.negated, when, tag)

    def verb(self, tag: Tag) -> None:
        """Note the verb of the clause. A plural verb is also that of earlier subjects."""
        clause = self.clause
        clause.has_complement &= tag.name not in FINITE | {"meet"}
        first = tag.words.split()[0]
        if clause.kind == "contact" and tag.name not in OF_CONTACT:
            raise UnreadableError
        if not clause.has_verb and tag.name in FINITE | {"meet"}:
            plural = first in PLURAL
            if self.was_verbal and self.carried and plural and len(clause.subjects) == 1:
                # "The cube moves west, the sphere east, and the cylinder are at rest."
                raise UnreadableError
            # "Passes" is singular, "pass" is not.
            singular = first.endswith("s") and not first.endswith("ss")
            if not (self.was_verbal or singular):
                clause.subjects = [*dict.fromkeys([*self.carried, *clause.subjects])]
            self.carried = []
            clause.has_verb = True

    @property
    def when(self) -> str:
        """The moment of a statement about a state."""
        clause = self.clause
        if self.moment == TARGET and not clause.has_verb and not clause.future:
            # "The red cube near the top will be near the left."
            return EITHER
        return TARGET if clause.future else CUT if clause.past else self.moment

    # Clauses within clauses, and pairs.

    def on_which(self, tag: Tag) -> None:
        """Read a relative clause about the object before it."""
        outer, names = self.clause, self.last_nouns
        if len(names) > 1 and self.peek().words not in ("are", "both"):
            names = []
        before = self.tags[self.at - 2].name if self.at > 1 else ""
        if outer is None or not names or before not in ("object", "comma", "relation"):
            raise UnreadableError
        self.clause = Clause([*names])
        start, count = self.at, len(self.claims)
        while self.peek().name not in ENDS or self._continues():
            verbs = self.clause.has_verb and self.at > start + 1
            if verbs and self.peek().name in FINITE and self.peek(-1).name not in FINITE | {"not"}:
                break
            self.take("and")
            self.read_tag()
        self.end_predicate()
        if len(self.claims) == count:
            raise UnreadableError
        self.clause = outer

    def _continues(self) -> bool:
        """Return whether "and" continues a relative clause, as in "which stops and rests"."""
        return self.peek().name == "and" and self.peek(1).name not in {
            *(*SUBJECT_STARTS, *SEPARATORS, "region", "from"),
        }

    def read_partners(self, *starts: str) -> list[str]:
        """Return the objects after a verb if a tag with one of these names follows, else none."""
        return self.read_list(True) if self.peek().name in starts else []

    def on_struck(self, tag: Tag) -> None:
        partners = self.read_list(True) if self.take("with") else []
        self.add_event("meeting", tag, self.clause.subjects, partners, alone=not partners)

    def add_event(
        self,
        kind: str,
        tag: Tag,
        subjects: list[str],
        partners: list[str],
        affirmed: bool = True,
        value: str = "",
        alone: bool = False,
    ) -> None:
        """Record a claim about pairs: each subject with each partner or, without partners, both
        subjects. With `alone`, a subject meets an object that is not named."""
        clause = self.clause
        if clause.kind == "none" and kind != "close" and not partners:
            pairs: list[tuple[str, ...]] = [()]
            affirmed = not affirmed
        elif partners:
            pairs = [*product(subjects, partners)]
        else:
            pairs = [(name,) for name in subjects] if alone else [tuple(subjects)]
        sizes = {len({*pair}) for pair in pairs}
        if (sizes != {2} and not alone and clause.kind != "none") or clause.kind == "all":
            raise UnreadableError
        affirmed = affirmed != clause.negated
        limited = self.moment == TARGET and not affirmed
        if kind == "close":
            when = TARGET if clause.future or self.moment == TARGET else self.moment
        elif self.moment == CUT and not clause.future:
            when = CUT
        else:
            when = TARGET if limited else BETWEEN
        for pair in pairs:
            self.add(kind, pair, value, affirmed, when, tag)
            if clause.time and affirmed and kind == "meeting":
                self.add("time", pair, clause.time.value, True, BETWEEN, clause.time)
        clause.event, clause.pairs = kind, pairs if affirmed else []
        clause.has_complement = bool(partners)
