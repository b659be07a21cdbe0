"""Paired comparisons of two runs agree with definitions and with SciPy."""

from __future__ import annotations

from dataclasses import asdict, replace

import numpy as np
import pytest
from scipy.stats import binomtest, norm, permutation_test
from statsmodels.stats.multitest import multipletests

from dynapix.conf.schema.benchmark import MATCHED_ANCHOR
from dynapix.data.checks.intervals import SceneBootstrap
from dynapix.data.records import FAMILIES, Candidate, SelectionItem
from dynapix.evaluation.metrics.results import accuracy_by_family, from_json
from dynapix.evaluation.metrics.significance import (
    EXACT_SCENES,
    PairedComparison,
    adjust_holm,
    compare_anchors,
    compare_runs,
    sign_flip_test,
)
from dynapix.evaluation.reporting.tables import paired_table
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
    families, scenes = [i.family for i in items], SceneBootstrap([i.scene_id for i in items], 0)
    one, two = (
        accuracy_by_family(families, [credits[i.item_id] for i in items], scenes)
        for credits in (left, right)
    )
    for name, p in found.items():
        if name == "macro":
            expected = (one.macro.value, two.macro.value)
        else:
            expected = tuple((a.families | {"all": a.micro})[name].value for a in (one, two))
        assert (p.left_accuracy, p.right_accuracy) == pytest.approx(expected)
        assert p.difference == pytest.approx(expected[0] - expected[1])
        assert p.low < p.difference < p.high
    assert found["all"].n == sum(found[f].n for f in FAMILIES) == len(items)
    assert found["all"].only_left == sum(found[f].only_left for f in FAMILIES)
    assert found["macro"].mcnemar is None
    assert all(0 < p.p <= 1 for p in found.values())


@pytest.mark.parametrize("seed", range(6))
def test_mcnemar_equals_the_exact_binomial_test(items, seed) -> None:
    left, right = random_credits(items, seed), random_credits(items, seed + 100, 0.3 + 0.1 * seed)
    for p in compare_runs(items, left, right, NAMES, seed=0):
        if p.of == "macro":
            continue
        ids = [i.item_id for i in items if p.of in (i.family, "all")]
        assert p.only_left == sum(left[i] > right[i] for i in ids)
        assert p.only_right == sum(left[i] < right[i] for i in ids)
        binomial = binomtest(p.only_left, p.only_left + p.only_right)
        assert p.mcnemar == pytest.approx(binomial.pvalue)


def test_swapped_runs_have_opposite_differences_and_equal_runs_have_none(items) -> None:
    left, right = random_credits(items, 0, 0.7), random_credits(items, 1)
    forward = compare_runs(items, left, right, NAMES, seed=3)
    backward = compare_runs(items, right, left, NAMES[::-1], seed=3)
    for p, q in zip(forward, backward, strict=True):
        assert (p.left, p.only_left, p.mcnemar) == (q.right, q.only_right, q.mcnemar)
        assert p.p == pytest.approx(q.p)
        assert (p.difference, p.low, p.high) == pytest.approx((-q.difference, -q.high, -q.low))
    for p in compare_runs(items, left, left, NAMES, seed=0):
        assert (p.difference, p.low, p.high) == (0, 0, 0)
        assert p.p == 1
        assert p.of == "macro" or (p.only_left, p.only_right, p.mcnemar) == (0, 0, 1)


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
    assert p.mcnemar == pytest.approx(0.5 ** (p.n - 1))


def test_comparisons_can_be_read_from_json_and_fit_a_page(items) -> None:
    found = compare_runs(
        items, random_credits(items, 0), random_credits(items, 1), ("unchanged", "shuffled"), 0
    )
    assert from_json(list[PairedComparison], [asdict(p) for p in found]) == found
    modes = ("reasoning", "answer, candidate_only")
    table = str(paired_table(replace(p, mode=mode) for mode in modes for p in found))
    assert max(map(len, table.splitlines())) <= 100
    assert table.count("\nmacro ") == 2


@pytest.mark.parametrize("scenes", [1, 2, 7, EXACT_SCENES])
def test_the_sign_flip_test_enumerates_the_outcomes_of_few_scenes(scenes) -> None:
    rng = np.random.default_rng(scenes)
    differences = rng.integers(-1, 2, size=5 * scenes).astype(float)
    names = np.repeat([f"s{k}" for k in range(scenes)], 5)
    sums = differences.reshape(scenes, 5).sum(axis=1)
    # SciPy refuses a single observation: its two outcomes are equally far from 0.
    expected = 1.0
    if scenes > 1:
        expected = permutation_test(
            (sums,), np.sum, permutation_type="samples", n_resamples=np.inf
        ).pvalue
    found = sign_flip_test(differences, np.full(len(names), "all"), names, seed=0)
    assert found == pytest.approx(expected)


def test_the_sign_flip_test_of_many_scenes_approaches_the_normal_one() -> None:
    rng = np.random.default_rng(0)
    values = rng.normal(0.1, 1, size=400)
    groups, scenes = np.full(400, "all"), np.arange(400)
    statistic = values.sum() / np.sqrt((values**2).sum())
    expected = 2 * (1 - norm.cdf(abs(statistic)))
    assert sign_flip_test(values, groups, scenes, seed=0) == pytest.approx(expected, abs=0.015)


def test_repeating_the_items_of_scenes_does_not_change_the_sign_flip_test(items) -> None:
    rng = np.random.default_rng(1)
    differences = rng.integers(-1, 2, size=len(items)).astype(float)
    families = np.array([i.family for i in items])
    scenes = np.array([i.scene_id for i in items])
    p = sign_flip_test(differences, families, scenes, seed=0)
    repeated = (np.repeat(of, 3) for of in (differences, families, scenes))
    assert sign_flip_test(*repeated, seed=0) == pytest.approx(p)


def test_holm_adjusts_p_values_as_statsmodels_does() -> None:
    rng = np.random.default_rng(0)
    for count in (1, 2, 9):
        p_values = rng.random(count) ** 3
        expected = multipletests(p_values, method="holm")[1]
        assert adjust_holm(p_values) == pytest.approx(expected)
