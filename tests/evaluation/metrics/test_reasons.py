"""What rationales claim, and whether answers rest on true reasons, for texts of known truth."""

from __future__ import annotations

from itertools import pairwise
from types import SimpleNamespace

import numpy as np
import pytest

from dynapix.data.checks.intervals import SceneBootstrap
from dynapix.data.records import LETTERS, SelectionItem
from dynapix.data.store import Store
from dynapix.evaluation.metrics.reasons import ReasonSummary, measure_reasons, read_reasons
from dynapix.evaluation.reporting.item_results import mark_claims
from dynapix.evaluation.reporting.run_responses import parse_response
from dynapix.evaluation.reporting.tables import reason_table
from dynapix.teacher.narrator import write_match_lines, write_rationale
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.validation.reasons import PARTS


@pytest.fixture(scope="module")
def rationales(micro_store: Store) -> list[tuple[SelectionItem, str]]:
    """Test items, and rationales of the relational narrator with the match layout."""
    found = []
    for item in micro_store.selection("test"):
        scene = micro_store.scene(item.scene_id)
        predicates = extract_predicates(item, scene, micro_store.scene)
        if predicates is not None:
            text = write_rationale(predicates, item, 0)
            body, answer = text.rsplit("\n", 1)
            lines = write_match_lines(predicates, item)
            found.append((item, "\n".join([body, *lines, answer])))
    assert len(found) > 20
    return found


def summarize(
    rationales: list[tuple[SelectionItem, str]], store: Store, letters: list[str | None]
) -> ReasonSummary:
    items, texts = zip(*rationales, strict=True)
    answers = [SimpleNamespace(text=t, letter=x) for t, x in zip(texts, letters, strict=True)]
    return measure_reasons(items, answers, store, seed=0)


def test_true_rationales_give_true_reasons(micro_store, rationales) -> None:
    summary = summarize(rationales, micro_store, [item.letter for item, _ in rationales])
    assert summary.true.value == summary.follows.value == 1
    assert summary.sufficiency.value > 0.9
    assert list(summary.parts) == [*PARTS]
    for part in summary.parts.values():
        assert part.contradicted.value == 0
        assert part.supported.value > 0.8
        assert part.claims.value > 1


def test_the_table_has_a_row_for_the_answers_and_one_for_each_part(micro_store, rationales) -> None:
    summary = summarize(rationales, micro_store, [item.letter for item, _ in rationales])
    table = reason_table({"narrator": summary})
    answers, *parts = table.groups[""]
    assert answers["name"] == "narrator"
    assert (answers["Follows"].value, answers["True reasons"].value) == (1, 1)
    assert answers["Items"] == len(rationales)
    assert [row["name"].strip() for row in parts] == [*PARTS]
    for row in parts:
        found = summary.parts[row["name"].strip()]
        assert row["Claims"].startswith(f"{found.claims.value:.1f} [")
        assert (row["Supported"], row["Contradicted"]) == (found.supported, found.contradicted)


def test_answer_that_the_analysis_does_not_give_does_not_follow(micro_store, rationales) -> None:
    wrong = [LETTERS[(item.answer + 1) % 4] for item, _ in rationales]
    changed = [
        (item, text[:-1] + letter) for (item, text), letter in zip(rationales, wrong, strict=True)
    ]
    summary = summarize(changed, micro_store, wrong)
    assert summary.follows.value == summary.true.value == 0
    unparsed = summarize(rationales, micro_store, [None] * len(rationales))
    assert unparsed.follows.value == 0


def test_rationales_of_other_items_are_contradicted(micro_store, rationales) -> None:
    items, texts = zip(*rationales, strict=True)
    shifted = list(zip(items, [*texts[7:], *texts[:7]], strict=True))
    summary = summarize(shifted, micro_store, [item.letter for item in items])
    assert summary.true.value < 0.1
    assert summary.sufficiency.value < 0.5
    for part in summary.parts.values():
        # Of a sentence about an object that the scene lacks, only the mention counts.
        assert part.supported.value < 0.55
        assert part.contradicted.value > 0.3


def test_right_answer_after_a_false_prediction_is_not_right_for_true_reasons(
    micro_store, rationales
) -> None:
    found = 0
    for item, text in rationales:
        before, _, after = text.partition("Prediction: ")
        prediction, _, rest = after.partition("\n")
        swapped = prediction.replace(" left of ", " RIGHT of ").replace(" right of ", " left of ")
        swapped = swapped.replace(" RIGHT of ", " right of ").replace(
            "near the top", "near the bottom"
        )
        if swapped == prediction:
            continue
        reasons = read_reasons(
            item, f"{before}Prediction: {swapped}\n{rest}", item.letter, micro_store
        )
        assert not reasons.true
        assert reasons.follows
        assert any(c.verdict == "contradicted" for c in reasons.claims["prediction"])
        found += 1
    assert found > 3


def test_response_without_a_rationale_has_no_claims(micro_store, rationales) -> None:
    item, _ = rationales[0]
    reasons = read_reasons(item, f"Answer: {item.letter}", item.letter, micro_store)
    assert not any(reasons.claims.values())
    assert not reasons.true
    assert reasons.sufficiency == 0.25
    empty = summarize([(item, f"Answer: {item.letter}")], micro_store, [item.letter])
    assert empty.parts["prefix"].supported is None
    assert empty.parts["prefix"].claims.value == 0


def test_marks_are_disjoint_and_show_the_worst_verdict(micro_store, rationales) -> None:
    item, text = rationales[0]
    marks = mark_claims(item, parse_response(text, False), micro_store)
    assert len(marks) > 8
    assert all(a["stop"] <= b["start"] for a, b in pairwise(marks))
    assert {m["verdict"] for m in marks} <= {"supported", "unknown"}
    assert mark_claims(item, parse_response(f"Answer: {item.letter}", False), micro_store) == []
    other = next(t for i, t in rationales if i.scene_id != item.scene_id)
    marks = mark_claims(item, parse_response(other, False), micro_store)
    assert "contradicted" in {m["verdict"] for m in marks}


def test_ratio_is_that_of_the_sums() -> None:
    rng = np.random.default_rng(0)
    wholes = rng.integers(0, 9, 60)
    parts = rng.binomial(wholes, 0.3)
    scenes = SceneBootstrap([f"s{k // 3}" for k in range(60)], seed=0)
    ratio = scenes.ratio(parts, wholes)
    assert ratio.value == pytest.approx(parts.sum() / wholes.sum())
    assert ratio.low < ratio.value < ratio.high
    # With equal wholes, the ratio is the mean of the shares.
    equal = scenes.ratio(parts, np.full(60, 4.0))
    mean = scenes.mean(parts / 4)
    np.testing.assert_allclose([equal.low, equal.high], [mean.low, mean.high])
