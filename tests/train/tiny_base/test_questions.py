"""Questions for the tiny base: their answers agree with the oracle and do not name the target."""

from __future__ import annotations

import re
from dataclasses import replace
from math import dist

import numpy as np
import pytest

from data.records import LETTERS, SelectionItem
from data.store import Store
from teacher.deciding import choose_statements, list_compared
from teacher.predicates.extraction import extract_predicates
from teacher.predicates.facts import RelationalPredicates, View
from teacher.predicates.relations import Bounds, normalize_relation
from teacher.validation.claim_extraction import extract_claims
from train.tiny_base.questions import KINDS, Question, sample_statements, suppose_target

RELATIVE = ("agrees", "extra", "displaced")
"""Kinds of claims about a candidate that refer to what was predicted."""

Described = list[tuple[SelectionItem, RelationalPredicates]]


@pytest.fixture(scope="module")
def described(micro_store: Store) -> Described:
    """The training items that have predicates, and these."""
    items = micro_store.selection("train")
    facts = [
        extract_predicates(i, micro_store.scene(i.scene_id), micro_store.scene, Bounds())
        for i in items
    ]
    return [(item, p) for item, p in zip(items, facts, strict=True) if p is not None]


def ask(kind: str, item: SelectionItem, p: RelationalPredicates, seed: int = 0) -> Question:
    return KINDS[kind](p, item, np.random.default_rng(seed))


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


def test_supposed_targets_agree(described: Described) -> None:
    agreeing = []
    for item, p in described:
        for block in ask("compare", item, p).answer.split("Supposition: ")[1:]:
            judged = re.findall(r"Candidate ([A-D]) (shows[^.]+)\.", block)
            assert [letter for letter, _ in judged] == list(LETTERS)
            letters = [letter for letter, text in judged if text.endswith(", and agrees")]
            supposed = suppose_target(p, re.match(r"candidate ([A-D]) is the target", block)[1])
            assert letters == [v.letter for v in supposed.views if agrees(v, supposed)]
            outcome = re.search(r"Candidates? ([^.]+) agrees?\.$", block.strip())[1]
            assert re.findall(r"\b[A-D]\b", outcome) == letters
            agreeing.append(len(letters))
    assert np.mean(np.array(agreeing) == 1) > 0.7


def agrees(view: View, p: RelationalPredicates) -> bool:
    """Whether all compared statements are true of a candidate, and no place is off."""
    compared = list_compared(choose_statements(p), p)
    there = [
        dist(view.places.image.get(s.objects[0], (9, 9)), p.target.places.image[s.objects[0]])
        for s in compared
        if s.kind == "region"
    ]
    return {*compared} <= view.statements and max(there, default=0) < 12 / 336


def test_explained_candidates_do_not_include_the_target(described: Described) -> None:
    explained = agreeing = 0
    for item, p in described:
        question = ask("explain", item, p)
        claims = extract_claims(question.answer, p)
        claims = [c for c in claims if c.kind not in RELATIVE and c.candidate != p.answer]
        assert [c for c in claims if c.verdict == "contradicted"] == []
        if "Outcome:" not in question.answer:
            continue
        explained += 1
        assert item.answer not in question.order
        judged = dict(re.findall(r"Candidate ([A-D]) (shows[^.]+)\.", question.answer))
        assert judged[p.answer] == judged[LETTERS[question.order[item.answer]]]
        letters = [letter for letter, text in judged.items() if text.endswith(", and agrees")]
        assert re.findall(r"^Candidate ([A-D]) matches\.$", question.answer, re.M) == letters
        wrong = re.findall(r"^Candidate ([A-D]) does not match: it ", question.answer, re.M)
        assert sorted(letters + wrong) == list(LETTERS)
        agreeing += bool(letters)
    assert explained > 0.9 * len(described)
    assert agreeing < 0.1 * explained


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


def test_questions_show_what_they_ask_about(described: Described) -> None:
    shown = {k: (q.clip, q.candidates) for k in KINDS for q in [ask(k, *described[0])]}
    assert shown == {
        "parse": (True, False),
        "predict": (True, False),
        "describe": (False, True),
        "compare": (True, True),
        "explain": (True, True),
        # Only without pictures does an answer say which candidate is the target.
        "match": (False, False),
        "narrate": (False, False),
    }


def test_texts_are_compared_as_pictures_are(described: Described) -> None:
    for item, p in described:
        assert ask("match", item, p).answer == ask("compare", item, p).answer


def test_narrated_rationales_have_both_vocabularies(described: Described) -> None:
    texts = [ask("narrate", item, p, k).answer for k, (item, p) in enumerate(described)]
    assert {t[-9:] for t in texts} == {f"Answer: {letter}" for letter in LETTERS}
    decided = [", and agrees." in text for text in texts]
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
