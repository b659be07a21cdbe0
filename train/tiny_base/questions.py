"""Questions that teach the tiny base the words for what it sees, and their answers.

The oracle determines the answers, in the phrases of the built-in narrator. The kinds of questions
(`KINDS`) ask for

    parse      the objects at the end of a clip, and their motion
    predict    statements that will be true at the target
    describe   statements about three of four candidates
    compare    for each of three statements, which candidates agree with it

None of them is the selection task: no answer says which candidate is the target, and statements are
chosen at random, not because they decide the item.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from data.records import SelectionItem
from teacher.deciding import Decision
from teacher.predicates.facts import Relation, RelationalPredicates, View
from teacher.predicates.relations import CHANGES, SYMMETRIC, flip_relation, normalize_relation
from teacher.writers.paper import Detail, join_sentences
from teacher.writers.relational import RelationalWriter

PARSE = "Describe the scene, and how its objects move."
PREDICT = "Say what will be true of the scene."
DESCRIBE = "Describe candidates."
COMPARE = "Compare the candidates with predictions."
QUESTIONS = (PARSE, PREDICT, DESCRIBE, COMPARE)
DETAIL = Detail(parsed=6, analysed=4, predicted=6, pairs=2, relations=2)
PREDICTED, DESCRIBED, COMPARED = 7, 4, 3
"""Maximum numbers of statements in a prediction, about each described candidate, and compared with
all candidates."""

WEIGHTS = {
    "region": 8, "gap": 4, "side": 2, "height": 2, "nearer": 2, "sight": 1, "between": 1,
    "extreme": 1,
}  # fmt: skip
"""Relative frequencies of the kinds of statements, close to those in rationales."""


@dataclass(frozen=True)
class Question:
    """A question about an item, and its answer.

    Attributes:
        clip, candidates: Whether the prompt shows the clip, and the candidates.
    """

    text: str
    answer: str
    clip: bool = True
    candidates: bool = True


def parse(p: RelationalPredicates, item: SelectionItem, rng: np.random.Generator) -> Question:
    """Ask for the scene at the end of the clip, and for the motion."""
    statements = sample_statements(p.target, rng, DETAIL.relations)
    writer = make_writer(p, item, rng, statements)
    answer = (
        f"Scene parse: {join_sentences(writer.scene_parse())}\n"
        f"Motion analysis: {join_sentences(writer.motion_analysis())}"
    )
    return Question(PARSE, answer, candidates=False)


def predict(p: RelationalPredicates, item: SelectionItem, rng: np.random.Generator) -> Question:
    """Ask for statements that are true of the target."""
    statements = sample_statements(p.target, rng, PREDICTED)
    writer = make_writer(p, item, rng, statements)
    parts = [writer.statement(s, "will be") for s in statements]
    parts[0] = f"{p.moment}, {parts[0]}"
    return Question(PREDICT, f"Prediction: {join_sentences(parts)}", candidates=False)


def describe(p: RelationalPredicates, item: SelectionItem, rng: np.random.Generator) -> Question:
    """Ask for statements about candidates."""
    lines = []
    for k in rng.permutation(len(p.views))[:3]:
        statements = sample_statements(p.views[k], rng, DESCRIBED)
        writer = make_writer(p, item, rng, ())
        parts = [writer.statement(s, "is") for s in statements]
        lines.append(f"Candidate {p.views[k].letter}: {join_sentences(parts)}")
    return Question(DESCRIBE, "\n".join(lines), clip=False)


def compare(p: RelationalPredicates, item: SelectionItem, rng: np.random.Generator) -> Question:
    """Ask which candidates agree with statements, each true of some candidate but not of all."""
    named = {o.object for o in p.objects}
    blocks = []
    for k in rng.permutation(len(p.views))[:COMPARED]:
        options = [s for s in sample_statements(p.views[k], rng, 12) if named.issuperset(s.objects)]
        agreeing = {s: [normalize_relation(s) in v.statements for v in p.views] for s in options}
        options = [s for s in options if not all(agreeing[s])] or options
        if not options:
            continue
        writer = make_writer(p, item, rng, options[:1])
        (statement,) = writer.statements
        shown = (
            "no " + statement.objects[0] if statement.kind == "sight" else writer.shown(statement)
        )
        judgements = [
            f"shows {shown}, and agrees" if agrees else writer.contrast(statement, view)
            for agrees, view in zip(agreeing[options[0]], p.views, strict=True)
        ]
        parts = [f"candidate {v.letter} {j}" for v, j in zip(p.views, judgements, strict=True)]
        blocks.append(
            f"Prediction: {join_sentences([writer.statement(statement, 'will be')])}\n"
            f"Candidate analysis: {join_sentences(parts)}"
        )
    return Question(COMPARE, "\n".join(blocks))


Kind = Callable[[RelationalPredicates, SelectionItem, np.random.Generator], Question]
KINDS: dict[str, Kind] = {
    "parse": parse, "predict": predict, "describe": describe, "compare": compare,
}  # fmt: skip


def make_writer(
    p: RelationalPredicates,
    item: SelectionItem,
    rng: np.random.Generator,
    statements: tuple[Relation, ...] | list[Relation],
) -> RelationalWriter:
    """Return a writer of the narrator's phrases about the given statements."""
    decision = Decision(tuple(statements), ())
    return RelationalWriter(p, decision, DETAIL, item.item_id, int(rng.integers(2**31)))


def sample_statements(view: View, rng: np.random.Generator, count: int) -> list[Relation]:
    """Sample up to `count` different statements that are true of a frame, of its kinds with the
    frequencies `WEIGHTS`; either of two objects may be the subject."""
    by_kind: dict[str, list[Relation]] = {}
    for statement in sorted(view.statements):
        if statement.kind not in CHANGES:
            by_kind.setdefault(statement.kind, []).append(statement)
    kinds = [*by_kind]
    weights = np.array([WEIGHTS.get(kind, 1) for kind in kinds], dtype=float)
    chosen: dict[Relation, None] = {}
    for _ in range(count):
        options = by_kind[kinds[rng.choice(len(kinds), p=weights / weights.sum())]]
        chosen[options[rng.integers(len(options))]] = None
    return [flip_relation(s) if s.kind in SYMMETRIC and rng.random() < 0.5 else s for s in chosen]
