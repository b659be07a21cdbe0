"""Questions for the tiny base: their answers agree with the oracle and do not name the target."""

from __future__ import annotations

import re
from collections.abc import Sequence
from dataclasses import replace
from math import dist

import numpy as np
import pytest

from dynapix.data.records import LETTERS, SelectionItem
from dynapix.data.store import Store
from dynapix.models.student.collator import IGNORED, encode
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.facts import RelationalPredicates, View
from dynapix.teacher.predicates.relations import normalize_relation
from dynapix.teacher.predicates.statement_choice import choose_statements
from dynapix.teacher.validation.claim_extraction import extract_claims
from research.tiny_base.questions import (
    ASK,
    KINDS,
    Question,
    make_question,
    sample_statements,
    suppose_target,
)

RELATIVE = ("agrees", "extra", "displaced")
"""Kinds of claims about a candidate that refer to what was predicted."""

Described = list[tuple[SelectionItem, RelationalPredicates]]


@pytest.fixture(scope="module")
def described(micro_store: Store) -> Described:
    """The training items that have predicates, and these."""
    items = micro_store.selection("train")
    facts = [extract_predicates(i, micro_store.scene(i.scene_id), micro_store.scene) for i in items]
    return [(item, p) for item, p in zip(items, facts, strict=True) if p is not None]


def ask(kind: str, item: SelectionItem, p: RelationalPredicates, seed: int = 0) -> Question:
    return ASK[kind](p, item, np.random.default_rng(seed))


@pytest.mark.parametrize("kind", ["parse", "predict"])
def test_statements_about_the_scene_are_true(kind: str, described: Described) -> None:
    supported = 0
    for item, p in described:
        claims = extract_claims(ask(kind, item, p).answer, p)
        assert [c for c in claims if c.verdict == "contradicted"] == []
        supported += sum(c.verdict == "supported" for c in claims)
    assert supported > 6 * len(described)


def test_statements_about_candidates_are_true(described: Described) -> None:
    supported = 0
    for item, p in described:
        for block in ask("compare", item, p).answer.split("Supposition: ")[1:]:
            block = block[block.index("Candidate analysis:") : block.index("Outcome:")]
            claims = extract_claims(block, p)
            # What candidates agree with is the stated prediction, not the target.
            claims = [c for c in claims if c.candidate is not None and c.kind not in RELATIVE]
            assert [c for c in claims if c.verdict == "contradicted"] == [], block
            supported += sum(c.verdict == "supported" for c in claims)
    assert supported > 6 * len(described)


def test_compared_candidates_are_measured_from_the_supposed_target(described: Described) -> None:
    """The outcome names the closest candidate apart from the supposed target."""
    named = 0
    for item, p in described:
        for block in ask("compare", item, p).answer.split("Supposition: ")[1:]:
            judged = re.findall(r"Candidate ([A-D]) shows[^.]+\.", block)
            assert judged == list(LETTERS)
            supposed = suppose_target(p, re.match(r"candidate ([A-D]) is the target", block)[1])
            place = choose_statements(supposed).place
            outcome = re.search(
                rf"Outcome: Apart from candidate ({supposed.answer}), the (\w+ \w+ \w+) is closest "
                r"to its expected place in candidate ([A-D])\.",
                block,
            )
            others = [v for v in supposed.views if v.letter != supposed.answer]
            closest = place and find_closest(place.objects[0], supposed, others)
            assert (outcome and outcome[3]) == closest
            if outcome:
                assert outcome[2] == place.objects[0]
                named += 1
    assert named > len(described)


def find_closest(name: str, p: RelationalPredicates, views: Sequence[View]) -> str | None:
    """The letter of the candidate that shows an object closest to its place at the target; None if
    another one shows it about as close."""
    target = p.target.places.image[name]
    shown = [v for v in views if name in v.places.image]
    distances = sorted((dist(v.places.image[name], target), v.letter) for v in shown)
    if not distances or (len(distances) > 1 and distances[1][0] - distances[0][0] < 12 / 336):
        return None
    return distances[0][1]


def test_explained_candidates_do_not_include_the_target(
    described: Described, micro_store: Store
) -> None:
    explained = named = 0
    for item, p in described:
        question = make_question("explain", item, micro_store.scene, np.random.default_rng(0))
        before, _, outcome = question.answer.partition("Outcome:")
        claims = extract_claims(before, p)
        claims = [c for c in claims if c.kind not in RELATIVE and c.candidate != p.answer]
        assert [c for c in claims if c.verdict == "contradicted"] == []
        if question.instead is None:
            assert "Prediction" not in question.answer
            continue
        assert question.instead.scene_id == item.scene_id
        shown = {(c.scene_id, c.frame) for c in item.candidates}
        assert (item.scene_id, question.instead.frame) not in shown
        if not outcome:
            continue
        explained += 1
        candidates = list(item.candidates)
        candidates[item.answer] = question.instead
        other = replace(item, candidates=tuple(candidates), target_frame=question.instead.frame)
        scene = micro_store.scene(item.scene_id)
        shown = extract_predicates(other, scene, micro_store.scene)
        claims = extract_claims(before, shown)
        claims = [c for c in claims if c.kind not in RELATIVE and c.candidate is not None]
        assert [c for c in claims if c.verdict == "contradicted"] == []
        if found := re.search(r"closest to its expected place in candidate ([A-D])\.", outcome):
            place = choose_statements(p, shown.views).place
            assert found[1] == find_closest(place.objects[0], p, shown.views)
            named += 1
    assert explained > 0.5 * len(described)
    assert named > 0.5 * explained


def test_each_candidate_is_described_with_each_object_once(described: Described) -> None:
    for item, p in described:
        for line in ask("describe", item, p).answer.splitlines():
            placed = re.findall(r"The (\w+ \w+ \w+) is (?:near the|out of sight)", line)
            assert len(placed) == len(set(placed)) <= len(p.objects)


@pytest.mark.parametrize("kind", ["describe", "compare"])
def test_answers_about_candidates_do_not_depend_on_the_target(
    kind: str, described: Described
) -> None:
    for item, p in described:
        other = LETTERS[(LETTERS.index(p.answer) + 1) % 4]
        candidates = tuple(replace(c, agrees=c.letter == other) for c in p.candidates)
        moved = replace(p, candidates=candidates)
        assert moved.answer == other
        assert ask(kind, item, p) == ask(kind, item, moved)


def test_questions_show_what_they_ask_about(described: Described, micro_store: Store) -> None:
    rng = np.random.default_rng(0)
    questions = {k: make_question(k, described[0][0], micro_store.scene, rng) for k in KINDS}
    shown = {k: (q.clip, q.candidates) for k, q in questions.items()}
    assert shown == {
        "parse": (True, False),
        "predict": (True, False),
        "describe": (False, True),
        "compare": (True, True),
        "explain": (True, True),
        # Only without pictures does an answer say which candidate is the target.
        "narrate": (False, False),
    }


def test_narrated_rationales_have_both_vocabularies(described: Described) -> None:
    texts = [ask("narrate", item, p, k).answer for k, (item, p) in enumerate(described)]
    assert {t[-9:] for t in texts} == {f"Answer: {letter}" for letter in LETTERS}
    decided = ["closest" in text for text in texts]
    assert 0.2 < np.mean(decided) < 0.8


def test_sampled_statements_are_different_and_true(described: Described) -> None:
    kinds, rng = set(), np.random.default_rng(1)
    for _, p in described:
        for view in p.views:
            statements = sample_statements(p, view, rng, 6)
            assert len(set(map(normalize_relation, statements))) == len(statements)
            assert {*map(normalize_relation, statements)} <= view.statements
            kinds |= {s.kind for s in statements}
    assert {"region", "side", "height", "gap", "extreme", "between", "nearer"} <= kinds


def test_false_words_are_read_but_not_written(sampler, processor) -> None:
    """A student's labels are its response, without the tokens that any false span touches."""
    tokenizer, hidden = processor.tokenizer, 0
    for item in sampler.items[:6]:
        sample = sampler.make_sample(item, "compare", "test", 0.5).sample
        encoded = encode(sample, processor, None)
        response = tokenizer.encode(sample.response, add_special_tokens=False)
        start = len(encoded.labels) - len(response) - 1
        assert encoded.input_ids[start:-1] == response
        stop = 0
        for token, label in zip(response, encoded.labels[start:-1], strict=True):
            first, stop = stop, stop + len(tokenizer.decode([token]))
            false = any(first < end and begin < stop for begin, end in sample.false_spans)
            assert label == (IGNORED if false else token)
            hidden += false
        assert stop == len(sample.response)
    assert hidden > 10
