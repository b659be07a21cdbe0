"""Questions that teach the tiny base the words for what it sees, and their answers.

The oracle determines the answers, in the phrases of the built-in narrator. The kinds of questions
(`KINDS`) ask for

    parse      the objects at the end of a clip, and their motion
    predict    where each object will be at the target, and relations between the objects then
    describe   where each candidate shows each object, and relations between them
    compare    for each of two candidates, the statements that tell it apart from the others, what
               the candidates show instead, and which other candidate is closest to it
    explain    the steps of a rationale, with another frame of the scene instead of the target
    narrate    a whole rationale with its answer, without any picture

None of them is the selection task: if an answer names the candidate that agrees with a prediction,
its pictures do not include the target. `compare` supposes that a candidate, sampled at random, is
the target. Its statements are chosen as those that decide an item, so that the model learns to find
the objects that tell candidates apart, and how far apart their places are. In `explain`, the
prediction is true of the target, but another frame is shown instead of it, so that the model has to
derive the prediction from the clip. In both, the outcome names the candidate that shows an object
closest to a given place: that in the supposed target, or in `explain` the predicted one. `narrate`
teaches the language of rationales, in both vocabularies, and how an answer follows from what a text
says of the candidates.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dynapix.data.oracle.displacement import frame_displacements
from dynapix.data.records import Candidate, Scene, SelectionItem
from dynapix.models.student.prompts import build_response
from dynapix.teacher.narrator import write_match_lines, write_rationale
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.facts import Relation, RelationalPredicates, View
from dynapix.teacher.predicates.relations import (
    CHANGES,
    SYMMETRIC,
    find_topic,
    flip_relation,
    normalize_relation,
)
from dynapix.teacher.predicates.statement_choice import Decision, choose_statements
from dynapix.teacher.writers.paper import Detail, join_sentences
from dynapix.teacher.writers.relational import RelationalWriter, leave_out_unseen

PARSE = "Describe the scene, and how its objects move."
PREDICT = "Say what will be true of the scene."
DESCRIBE = "Describe the candidates."
COMPARE = "Suppose that a candidate is the target, and compare the candidates."
EXPLAIN = (
    "Check a prediction step by step: scene parse, motion analysis, prediction, candidate analysis "
    "and outcome."
)
NARRATE = "Write an example of a rationale."
QUESTIONS = (PARSE, PREDICT, DESCRIBE, COMPARE, EXPLAIN, NARRATE)
FULL = Detail(parsed=6, analysed=4, predicted=6, pairs=2, relations=2)
SPARSE = Detail(parsed=3, analysed=2, predicted=1, pairs=1)
PREDICTED, DESCRIBED, COMPARED = 3, 2, 2
"""Maximum numbers of relations in an answer to `predict`, of relations about each candidate in one
to `describe`, and of candidates that `compare` supposes to be the target."""
SUPPOSED_PATH = 0.2
"""Path of objects to a supposed target, as a share of the image; a typical path to the target."""
SUBSTITUTES, SUBSTITUTE_DISPLACEMENT = 12, 34.0
"""The frame that is shown instead of the target is one of this many frames that are nearest to the
target in time, of those that differ from the target and from each distractor of the same scene by
at least this displacement of an object (px at 336 x 336), as candidates of the tiny benchmarks do.
"""

WEIGHTS = {
    "region": 10, "gap": 2, "side": 2, "height": 2, "nearer": 1, "sight": 1, "between": 1,
    "extreme": 1,
}  # fmt: skip
"""Relative frequencies of the kinds of statements, close to those in rationales."""
PLACES = ("region", "sight")
"""Kinds of statements that say where a single object is."""


@dataclass(frozen=True)
class Question:
    """A question about an item, and its answer.

    Attributes:
        clip, candidates: Whether the prompt shows the clip, and the candidates.
        predicts_target: Whether the answer's predictions are true of the target.
        false_spans: Spans of the answer that are false on purpose (see
            `research.tiny_base.samples`).
        instead: The frame that is shown instead of the target, if any.
    """

    text: str
    answer: str
    clip: bool = True
    candidates: bool = True
    predicts_target: bool = True
    false_spans: tuple[tuple[int, int], ...] = ()
    instead: Candidate | None = None


def ask_parse(p: RelationalPredicates, item: SelectionItem, rng: np.random.Generator) -> Question:
    """Ask for the scene at the end of the clip, and for the motion.

    The objects and relations that the answer mentions are those of sampled statements that are true
    of the target. What the answer says of relations is true at the end of the clip.
    """
    statements = sample_statements(leave_out_unseen(p), p.target, rng, FULL.relations)
    writer = make_statement_writer(p, item, rng, statements)
    answer = (
        f"Scene parse: {join_sentences(writer.scene_parse())}\n"
        f"Motion analysis: {join_sentences(writer.motion_analysis())}"
    )
    return Question(PARSE, answer, candidates=False)


def ask_predict(p: RelationalPredicates, item: SelectionItem, rng: np.random.Generator) -> Question:
    """Ask for the place of each object at the target, and for relations."""
    writer = make_statement_writer(p, item, rng)
    parts = [writer.expected(o) for o in writer.order(writer.ranked)]
    relations = sample_statements(writer.facts, p.target, rng, PREDICTED, without=PLACES)
    parts += [writer.statement(s, "will be") for s in relations]
    parts[0] = f"{p.moment}, {parts[0]}"
    return Question(PREDICT, f"Prediction: {join_sentences(parts)}", candidates=False)


def ask_describe(
    p: RelationalPredicates, item: SelectionItem, rng: np.random.Generator
) -> Question:
    """Ask for the place of each object in each candidate, and for relations. Those of the first
    candidate are chosen at random; the others follow it in the same respects."""
    writer = make_statement_writer(p, item, rng)
    shown = {s.objects[0] for v in p.views for s in v.statements if s.kind == "region"}
    subjects = rng.permutation([o.object for o in p.objects if o.object in shown]).tolist()
    topics = sample_statements(p, p.views[0], rng, DESCRIBED, without=PLACES)
    lines = []
    for view in p.views:
        places = {s.objects[0]: s for s in view.statements if s.kind in PLACES}
        parts = [writer.statement(places[name], "is") for name in subjects if name in places]
        relations = [
            topic
            if normalize_relation(topic) in view.statements
            else find_topic(topic, view.relations)
            for topic in topics
        ]
        parts += [writer.statement(s, "is") for s in relations if s is not None]
        lines.append(f"Candidate {view.letter}: {join_sentences(parts)}")
    return Question(DESCRIBE, "\n".join(lines), clip=False)


def ask_compare(p: RelationalPredicates, item: SelectionItem, rng: np.random.Generator) -> Question:
    """Ask for the statements that would decide the item if a candidate were the target, what the
    candidates show instead, and which other candidate is closest to it, for two candidates."""
    blocks = []
    for k in rng.permutation(len(p.views))[:COMPARED]:
        supposed = suppose_target(p, p.views[k].letter)
        statements = choose_statements(supposed).statements
        if not statements:
            continue
        writer = make_statement_writer(supposed, item, rng, statements)
        predicted = [writer.statement(s, "will be") for s in writer.statements]
        views = supposed.views
        analysed = [f"candidate {view.letter} {writer.comparison(view)}" for view in views]
        blocks.append(
            f"Supposition: candidate {supposed.answer} is the target.\n"
            f"Prediction: {join_sentences(predicted)}\n"
            f"Candidate analysis: {join_sentences(analysed)}\n"
            f"Outcome: {join_sentences([state_closest_other(writer, supposed)])}"
        )
    return Question(COMPARE, "\n".join(blocks), predicts_target=False)


def ask_explain(
    p: RelationalPredicates,
    shown: Sequence[View],
    item: SelectionItem,
    rng: np.random.Generator,
) -> Question:
    """Ask for the steps of a rationale; for the first two if no statement excludes a shown frame.

    The prediction is that of a rationale, but no picture shows the target. So the answer does not
    say which candidate is the target.

    Args:
        shown: What the prompt shows: the distractors, and another frame instead of the target.
    """
    statements = choose_statements(p, shown).statements
    if not statements:
        return ask_first_steps(p, item, rng)
    writer = make_statement_writer(p, item, rng, statements, SPARSE)
    sections = {
        "Scene parse": writer.scene_parse(),
        "Motion analysis": writer.motion_analysis(),
        "Prediction": writer.prediction(),
        "Candidate analysis": [f"candidate {v.letter} {writer.comparison(v)}" for v in shown],
        "Outcome": [writer.conclusion(shown)],
    }
    lines = [f"{title}: {join_sentences(parts)}" for title, parts in sections.items()]
    return Question(EXPLAIN, "\n".join(lines))


def ask_first_steps(
    p: RelationalPredicates, item: SelectionItem, rng: np.random.Generator
) -> Question:
    """Ask for the scene parse and the motion analysis of a rationale."""
    return replace(ask_parse(p, item, rng), text=EXPLAIN, candidates=True)


def ask_narrate(p: RelationalPredicates, item: SelectionItem, rng: np.random.Generator) -> Question:
    """Ask for a rationale, in one of the vocabularies, and its answer. No picture is shown."""
    predicates = p if rng.random() < 0.5 else p.without_relations()
    rationale = write_rationale(predicates, item, int(rng.integers(2**31)))
    lines = write_match_lines(predicates, item)
    answer = build_response(rationale, lines, item.letter, "reasoning", "cot")
    return Question(NARRATE, answer, clip=False, candidates=False)


ASK: dict[
    str, Callable[[RelationalPredicates, SelectionItem, np.random.Generator], Question]
] = {
    "parse": ask_parse, "predict": ask_predict, "describe": ask_describe,
    "compare": ask_compare, "narrate": ask_narrate,
}  # fmt: skip
KINDS = ("parse", "predict", "describe", "compare", "explain", "narrate")


def make_question(
    kind: str, item: SelectionItem, scene_of: Callable[[str], Scene], rng: np.random.Generator
) -> Question:
    """Return a question of a kind about an item.

    Args:
        scene_of: Returns a scene by its id.
    """
    scene = scene_of(item.scene_id)
    predicates = extract_predicates(item, scene, scene_of)
    if kind != "explain":
        return ASK[kind](predicates, item, rng)
    other = replace_target(item, scene, rng)
    if other is None:
        return ask_first_steps(predicates, item, rng)
    shown = extract_predicates(other, scene, scene_of).views
    question = ask_explain(predicates, shown, item, rng)
    return replace(question, instead=other.candidates[item.answer])


def replace_target(
    item: SelectionItem, scene: Scene, rng: np.random.Generator
) -> SelectionItem | None:
    """Return an item with another frame of its scene as its target (see `SUBSTITUTES`); None if no
    frame differs enough from all candidates."""
    others = [c.frame for c in item.candidates if c.scene_id == item.scene_id]
    frames = np.arange(item.prefix_stop + 1, scene.frames)
    shifts = frame_displacements(scene)[np.ix_(frames, others)].min(axis=1)
    clear = frames[shifts >= SUBSTITUTE_DISPLACEMENT]
    nearest = clear[np.argsort(np.abs(clear - item.target_frame), kind="stable")][:SUBSTITUTES]
    if not len(nearest):
        return None
    frame = int(rng.choice(nearest))
    candidates = list(item.candidates)
    candidates[item.answer] = Candidate(item.scene_id, frame)
    return replace(item, target_frame=frame, candidates=tuple(candidates))


def make_statement_writer(
    p: RelationalPredicates,
    item: SelectionItem,
    rng: np.random.Generator,
    statements: Sequence[Relation] = (),
    detail: Detail = FULL,
) -> RelationalWriter:
    """Return a writer of the narrator's phrases about the given statements."""
    decision = Decision(tuple(statements), ())
    return RelationalWriter(p, decision, detail, item.item_id, int(rng.integers(2**31)))


def suppose_target(p: RelationalPredicates, letter: str) -> RelationalPredicates:
    """Return predicates as if a candidate were the target, and all objects had moved equally far.
    What candidates show of objects that are not in the scene is left out."""
    names = {o.object for o in p.objects}
    candidates = tuple(replace(c, agrees=c.letter == letter) for c in p.candidates)
    views = tuple(
        replace(v, relations=tuple(r for r in v.relations if names.issuperset(r.objects)))
        for v in p.views
    )
    paths = dict.fromkeys(names, SUPPOSED_PATH)
    return replace(p, candidates=candidates, views=views, paths=paths)


def state_closest_other(writer: RelationalWriter, p: RelationalPredicates) -> str:
    """Return the clause that names the candidate which, apart from the supposed target, shows the
    object of the first statement closest to its place there, if one does, or a statement that is
    true of the supposed target."""
    others = [view for view in p.views if view.letter != p.answer]
    conclusion = writer.conclusion(others)
    if writer.find_closest(others) is None:
        return conclusion
    return f"apart from candidate {p.answer}, {conclusion}"


def sample_statements(
    p: RelationalPredicates,
    view: View,
    rng: np.random.Generator,
    count: int,
    without: Sequence[str] = (),
) -> list[Relation]:
    """Sample up to `count` different statements about objects of `p` that are true of a frame, of
    its kinds with the frequencies `WEIGHTS`; either of two objects may be the subject.

    Args:
        without: Kinds of statements that are left out.
    """
    names = {o.object for o in p.objects}
    by_kind: dict[str, list[Relation]] = {}
    for statement in sorted(view.statements):
        if statement.kind not in (*CHANGES, *without) and names.issuperset(statement.objects):
            by_kind.setdefault(statement.kind, []).append(statement)
    kinds = [*by_kind]
    weights = np.array([WEIGHTS.get(kind, 1) for kind in kinds], dtype=float)
    chosen: dict[Relation, None] = {}
    for _ in range(count if kinds else 0):
        options = by_kind[kinds[rng.choice(len(kinds), p=weights / weights.sum())]]
        chosen[options[rng.integers(len(options))]] = None
    return [flip_relation(s) if s.kind in SYMMETRIC and rng.random() < 0.5 else s for s in chosen]
