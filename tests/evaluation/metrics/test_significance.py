"""Paired comparisons of two runs agree with definitions and with SciPy."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.stats import binomtest

from data.records import FAMILIES, Candidate, SelectionItem
from data.tracks.controls import MATCHED_ANCHOR
from evaluation.metrics.results import accuracy_by_family, from_json
from evaluation.metrics.significance import PairedComparison, compare_anchors, compare_runs
from evaluation.reporting.tables import paired_table
from tests.user_errors import raises_user_error

NAMES = ("one", "two")


def make_item(number: int, family: str, scene: str) -> SelectionItem:
    candidates = tuple(Candidate(scene, frame, "x") for frame in (40, 50, 60, 70))
    return SelectionItem(
        f"{family}-{number}", "test", "dynapix", family, "any", "Which?", scene, 0, 20, 40,
        candidates, 0, 12.0,
    )  # fmt: skip


@pytest.fixture
def items() -> list[SelectionItem]:
    return [make_item(k, FAMILIES[k % 3], f"scene-{k // 4}") for k in range(120)]


def random_credits(items, seed: int, share: float = 0.5) -> dict[str, float]:
    rng = np.random.default_rng(seed)
    return {item.item_id: float(rng.random() < share) for item in items}


def test_differences_are_those_of_the_accuracies(items) -> None:
    left, right = random_credits(items, 0, 0.7), random_credits(items, 1, 0.4)
    found = {p.of: p for p in compare_runs(items, left, right, NAMES, seed=0)}
    assert list(found) == [*FAMILIES, "macro", "all"]
    one, two = (
        accuracy_by_family([i.family for i in items], [credits[i.item_id] for i in items])
        for credits in (left, right)
    )
    for name, p in found.items():
        if name == "macro":
            expected = (one.macro, two.macro)
        else:
            expected = tuple((a.families | {"all": a.micro})[name].value for a in (one, two))
        assert (p.left_accuracy, p.right_accuracy) == pytest.approx(expected)
        assert p.difference == pytest.approx(expected[0] - expected[1])
        assert p.low < p.difference < p.high
    assert found["all"].n == sum(found[f].n for f in FAMILIES) == len(items)
    assert found["all"].only_left == sum(found[f].only_left for f in FAMILIES)
    assert found["macro"].p is None


@pytest.mark.parametrize("seed", range(6))
def test_the_p_value_equals_that_of_the_exact_binomial_test(items, seed) -> None:
    left, right = random_credits(items, seed), random_credits(items, seed + 100, 0.3 + 0.1 * seed)
    for p in compare_runs(items, left, right, NAMES, seed=0):
        if p.of == "macro":
            continue
        ids = [i.item_id for i in items if p.of in (i.family, "all")]
        assert p.only_left == sum(left[i] > right[i] for i in ids)
        assert p.only_right == sum(left[i] < right[i] for i in ids)
        binomial = binomtest(p.only_left, p.only_left + p.only_right)
        assert p.p == pytest.approx(binomial.pvalue)


def test_swapped_runs_have_opposite_differences_and_equal_runs_have_none(items) -> None:
    left, right = random_credits(items, 0, 0.7), random_credits(items, 1)
    forward = compare_runs(items, left, right, NAMES, seed=3)
    backward = compare_runs(items, right, left, NAMES[::-1], seed=3)
    for p, q in zip(forward, backward, strict=True):
        assert (p.left, p.only_left, p.p) == (q.right, q.only_right, q.p)
        assert (p.difference, p.low, p.high) == pytest.approx((-q.difference, -q.high, -q.low))
    for p in compare_runs(items, left, left, NAMES, seed=0):
        assert (p.difference, p.low, p.high) == (0, 0, 0)
        assert p.of == "macro" or (p.only_left, p.only_right, p.p) == (0, 0, 1)


def test_repeated_items_of_a_scene_do_not_narrow_the_interval(items) -> None:
    left, right = random_credits(items, 0), random_credits(items, 1)
    widths = []
    for count in (1, 4):
        copies = [
            replace(make_item(k, "time", f"scene-{k}"), item_id=f"{item.item_id}-{copy}")
            for k, item in enumerate(items)
            for copy in range(count)
        ]
        sides = [
            {i.item_id: credits[i.item_id.rpartition("-")[0]] for i in copies}
            for credits in (left, right)
        ]
        p = compare_runs(copies, *sides, NAMES, seed=0)[-1]
        widths.append(p.high - p.low)
    assert widths[1] == pytest.approx(widths[0])
    differences = np.array([left[i.item_id] - right[i.item_id] for i in items])
    assert widths[0] == pytest.approx(2 * 1.96 * differences.std() / len(items) ** 0.5, rel=0.1)


def test_items_with_ties_count_for_the_run_with_more_credit(items) -> None:
    few = [item for item in items if item.family == "time"][:3]
    left = dict(zip([i.item_id for i in few], (0.5, 1.0, 0.25), strict=True))
    right = dict(zip([i.item_id for i in few], (0.0, 0.5, 1.0), strict=True))
    [p] = compare_runs(few, left, right, NAMES, seed=0)
    assert (p.of, p.only_left, p.only_right, p.n) == ("all", 2, 1, 3)
    assert p.difference == pytest.approx((0.5 + 0.5 - 0.75) / 3)


def test_runs_over_different_items_are_refused_and_the_items_are_named(items) -> None:
    left, right = random_credits(items[:40], 0), random_credits(items[2:41], 0)
    with raises_user_error("different-items", contains=("2 only in select/a", "time-40")):
        compare_runs(items[:40], left, right, ("select/a", "select/b"), seed=0)


def test_the_two_questions_of_matched_anchor_pairs_are_compared(benchmark_store) -> None:
    matched = benchmark_store.selection(suite=MATCHED_ANCHOR)
    by_family = {i.item_id: float(i.family == "event") for i in matched}
    [p] = compare_anchors(matched[::-1], by_family, seed=0)
    assert (p.left, p.right, p.n) == ("event", "time", len(matched) // 2)
    assert (p.left_accuracy, p.right_accuracy, p.difference) == (1, 0, 1)
    assert (p.only_left, p.only_right) == (p.n, 0)
    assert p.p == pytest.approx(0.5 ** (p.n - 1))


def test_comparisons_can_be_read_from_json_and_fit_a_page(items) -> None:
    found = compare_runs(
        items, random_credits(items, 0), random_credits(items, 1), ("unchanged", "shuffled"), 0
    )
    assert from_json(list[PairedComparison], [asdict(p) for p in found]) == found
    modes = ("reasoning", "answer, candidate_only")
    table = str(paired_table(replace(p, mode=mode) for mode in modes for p in found))
    assert max(map(len, table.splitlines())) <= 100
    assert table.count("\nmacro ") == 2
