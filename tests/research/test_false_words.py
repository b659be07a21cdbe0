"""False words in rationales."""

from __future__ import annotations

from collections import Counter

import numpy as np

from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.validation.claim_extraction import extract_claims
from research.tiny_base.false_words import (
    ALTERNATIVES,
    FALSIFIED_SECTIONS,
    WORD,
    falsify_words,
)
from tests.teacher.test_predicates import random_cases


def test_words_are_replaced_by_others_of_their_kind() -> None:
    """Nothing else changes, and the spans contain each false word and one more character."""
    replaced = kept = 0
    rng = np.random.default_rng(1)
    for item, predicates in random_cases(40, relational=True):
        true = write_rationale(predicates, item, 0)
        assert falsify_words(true, 0.0, rng) == (true, ())
        text, spans = falsify_words(true, 0.5, rng)
        end = shift = 0
        for start, stop in spans:
            assert text[end:start] == true[end + shift : start + shift]
            word = WORD.match(true, start + shift).group()
            assert text[start : stop - 1] in ALTERNATIVES[word]
            end, shift = stop - 1, shift + len(word) - (stop - 1 - start)
            replaced += 1
        assert text[end:] == true[end + shift :]
        lines = [line for line in true.splitlines() if line.startswith(FALSIFIED_SECTIONS)]
        kept += len(WORD.findall(" ".join(lines))) - len(spans)
    assert 0.4 < replaced / (replaced + kept) < 0.6


def test_replaced_words_are_false() -> None:
    """Apart from extremes: an object can be both leftmost and topmost."""
    verdicts = Counter()
    rng = np.random.default_rng(0)
    for item, predicates in random_cases(60, relational=True):
        text, spans = falsify_words(write_rationale(predicates, item, 0), 0.5, rng)
        claims = [c for c in extract_claims(text, predicates) if c.kind != "extreme"]
        for start, stop in spans:
            touched = [c.verdict for c in claims if c.span[0] < stop and start < c.span[1]]
            verdicts.update(touched)
    assert verdicts["supported"] == 0
    assert verdicts["contradicted"] > 100
    assert verdicts["contradicted"] > 9 * verdicts["unknown"]


def test_each_word_has_alternatives_of_its_kind() -> None:
    near_the_center = ALTERNATIVES["near the center"]
    assert sorted(near_the_center) == [
        "near the bottom",
        "near the left",
        "near the right",
        "near the top",
    ]
    assert ALTERNATIVES["left of"] == ["vertically aligned with", "right of"]
    assert all(word not in others and others for word, others in ALTERNATIVES.items())
    for text in ("nearer to the red cube", "as near to it", "near a wall", "the nearest"):
        assert not WORD.search(text)
