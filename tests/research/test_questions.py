"""Questions for the tiny base: their answers agree with the oracle and do not name the target."""

from __future__ import annotations

import re
from collections import Counter
from collections.abc import Sequence
from dataclasses import replace
from math import dist

import numpy as np
import pytest

from dynapix.data.records import LETTERS, SelectionItem
from dynapix.data.store import Store
from dynapix.models.student.collator import IGNORED, encode
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.facts import RelationalPredicates, View
from dynapix.teacher.predicates.statement_choice import choose_statements
from dynapix.teacher.reading.claims import Claim
from dynapix.teacher.validation.claim_extraction import extract_claims
from research.tiny_base.questions import ASK, KINDS, Question, make_question, suppose_target
from research.tiny_base.samples import ALTERNATIVES, FALSIFIED_SECTIONS, WORD, falsify_words
from tests.teacher.test_predicates import random_cases

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


def count_supported(claims: Sequence[Claim]) -> int:
    """Return the number of supported claims; none may be contradicted."""
    assert [c for c in claims if c.verdict == "contradicted"] == []
    return sum(c.verdict == "supported" for c in claims)


@pytest.mark.parametrize("kind", ["parse", "predict"])
def test_statements_about_the_scene_are_true(kind: str, described: Described) -> None:
    supported = [count_supported(extract_claims(ask(kind, i, p).answer, p)) for i, p in described]
    assert np.mean(supported) > 6


def test_compared_candidates_are_measured_from_the_supposed_target(described: Described) -> None:
    """Statements about candidates are true. The outcome names the closest candidate apart from the
    supposed target."""
    named = supported = 0
    for item, p in described:
        for block in ask("compare", item, p).answer.split("Supposition: ")[1:]:
            claims = extract_claims(
                block[block.index("Candidate analysis:") : block.index("Outcome:")], p
            )
            # What candidates agree with is the stated prediction, not the target.
            supported += count_supported(
                [c for c in claims if c.candidate is not None and c.kind not in RELATIVE]
            )
            assert re.findall(r"Candidate ([A-D]) shows[^.]+\.", block) == list(LETTERS)
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
    assert supported > 6 * len(described)


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
    explained = 0
    for item, p in described:
        question = make_question("explain", item, micro_store.scene, np.random.default_rng(0))
        before, _, outcome = question.answer.partition("Outcome:")
        claims = extract_claims(before, p)
        count_supported([c for c in claims if c.kind not in RELATIVE and c.candidate != p.answer])
        if question.instead is None:
            assert "Prediction" not in question.answer
            continue
        assert question.instead.scene_id == item.scene_id
        frames = {c.frame for c in item.candidates if c.scene_id == item.scene_id}
        assert question.instead.frame not in frames
        if found := re.search(r"closest to its expected place in candidate ([A-D])\.", outcome):
            explained += 1
            candidates = list(item.candidates)
            candidates[item.answer] = question.instead
            frame = question.instead.frame
            other = replace(item, candidates=tuple(candidates), target_frame=frame)
            scene = micro_store.scene(item.scene_id)
            shown = extract_predicates(other, scene, micro_store.scene).views
            place = choose_statements(p, shown).place
            assert found[1] == find_closest(place.objects[0], p, shown)
    assert explained > 0.25 * len(described)


def test_answers_about_candidates_do_not_depend_on_the_target(described: Described) -> None:
    """Each candidate is described with each object once."""
    for item, p in described:
        other = LETTERS[(LETTERS.index(p.answer) + 1) % 4]
        candidates = tuple(replace(c, agrees=c.letter == other) for c in p.candidates)
        moved = replace(p, candidates=candidates)
        assert moved.answer == other
        for kind in ("describe", "compare"):
            assert ask(kind, item, p) == ask(kind, item, moved)
        for line in ask("describe", item, p).answer.splitlines():
            placed = re.findall(r"The (\w+ \w+ \w+) is (?:near the|out of sight)", line)
            assert len(placed) == len(set(placed)) <= len(p.objects)


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


def test_words_are_replaced_by_false_ones_of_their_kind() -> None:
    """Nothing else changes, and the spans contain each false word and one more character. Extremes
    need not be false: an object can be both leftmost and topmost."""
    replaced = words = 0
    verdicts: Counter[str] = Counter()
    rng = np.random.default_rng(0)
    for item, predicates in random_cases(60, relational=True):
        true = write_rationale(predicates, item, 0)
        assert falsify_words(true, 0.0, np.random.default_rng(0)) == (true, ())
        text, spans = falsify_words(true, 0.5, rng)
        end = shift = 0
        claims = [c for c in extract_claims(text, predicates) if c.kind != "extreme"]
        for start, stop in spans:
            assert text[end:start] == true[end + shift : start + shift]
            word = WORD.match(true, start + shift).group()
            assert text[start : stop - 1] in ALTERNATIVES[word]
            end, shift = stop - 1, shift + len(word) - (stop - 1 - start)
            verdicts.update(c.verdict for c in claims if c.span[0] < stop and start < c.span[1])
        assert text[end:] == true[end + shift :]
        lines = [line for line in true.splitlines() if line.startswith(FALSIFIED_SECTIONS)]
        words += len(WORD.findall(" ".join(lines)))
        replaced += len(spans)
    assert 0.4 < replaced / words < 0.6
    assert verdicts["supported"] == 0
    assert verdicts["contradicted"] > max(100, 9 * verdicts["unknown"])
    assert all(word not in others and others for word, others in ALTERNATIVES.items())
    for text in ("nearer to the red cube", "as near to it", "near a wall", "the nearest"):
        assert not WORD.search(text)


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
