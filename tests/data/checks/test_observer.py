"""The laws of observers with stated errors, and of the curve of their accuracy."""

from __future__ import annotations

import io
import shutil
from collections.abc import Iterator
from dataclasses import replace
from itertools import pairwise

import numpy as np
import pandas as pd
import pytest

from dynapix.data.checks import observer
from dynapix.data.checks.intervals import Interval
from dynapix.data.checks.observer import (
    ERRORS,
    EXTRAPOLATES,
    OBSERVER_FOLDER,
    SIMULATES,
    candidate_distances,
    load_observers,
    observe_benchmark,
    observe_item,
)
from dynapix.data.checks.observer_curve import (
    ObserverCurve,
    format_observers,
    observer_curves,
    plot_observers,
    summarize_observers,
)
from dynapix.data.oracle.events import touching_pairs
from dynapix.data.parallel import Workers
from dynapix.data.records import SPLITS
from dynapix.data.store import Store, open_store
from tests.user_errors import raises_user_error

DRAWS = 3
"""Draws of each error; each needs a simulation."""


@pytest.fixture(scope="module", autouse=True)
def few_draws() -> Iterator[None]:
    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(observer, "DRAWS", DRAWS)
        yield


@pytest.fixture(scope="module")
def store(micro_store, tmp_path_factory) -> Store:
    """A copy of the small benchmark, without frames, in which observers may keep results."""
    folder = tmp_path_factory.mktemp("observed") / "micro"
    shutil.copytree(micro_store.folder, folder, ignore=shutil.ignore_patterns("frames"))
    return open_store(folder)


@pytest.fixture(scope="module")
def items(store):
    return store.selection()


@pytest.fixture(scope="module")
def results(store) -> dict[str, pd.DataFrame]:
    """The results on the items of both splits."""
    of_splits = [observe_benchmark(store, split, Workers(1)) for split in SPLITS]
    return {name: pd.concat(own[name] for own in of_splits) for name in (SIMULATES, EXTRAPOLATES)}


def known_curve(values) -> ObserverCurve:
    """A curve with these accuracies at the errors, of many items."""
    accuracies = dict(zip(ERRORS, values, strict=True))
    return ObserverCurve({e: Interval(v, v, v, 1000) for e, v in accuracies.items()})


def exactly(accuracy: float) -> Interval:
    return Interval(accuracy, accuracy, accuracy, 1000)


@pytest.mark.slow
def test_the_exact_observer_is_right_also_where_the_prefix_ends_in_a_contact(
    store, items, results
) -> None:
    assert (results[SIMULATES][0.0] == 1).all()
    ends = [(store.scene(item.scene_id), item.prefix_stop) for item in items]
    assert sum(bool(touching_pairs(scene, stop, stop)) for scene, stop in ends) > 0.1 * len(ends)


@pytest.mark.slow
def test_the_curves_fall_within_their_intervals(items, results) -> None:
    curves = observer_curves(results, items, 0)
    for curve in curves.values():
        intervals = list(curve.accuracy.values())
        for left, right in pairwise(intervals):
            assert right.low <= left.high
        assert intervals[-1].high < intervals[0].low
    exact = curves[SIMULATES].accuracy[0.0].value
    assert exact > curves[EXTRAPOLATES].accuracy[0.0].value


@pytest.mark.slow
def test_the_error_of_observers_is_recovered_from_their_answers(store, items, results) -> None:
    """The error lies between those of the curve, and the observers have draws of their own. With
    these items and draws, the standard deviation of the median is about 7%."""
    count, rng = 12, np.random.default_rng(4)
    credits = [observe_item(i, store, [6.0], count, rng)[SIMULATES][1] for i in items]
    curve = observer_curves(results, items, 0)[SIMULATES]
    found = [curve.error_of(exactly(accuracy)).value for accuracy in np.mean(credits, axis=0)]
    assert np.median(found) == pytest.approx(6, rel=0.2)


@pytest.mark.slow
def test_results_are_kept_and_do_not_depend_on_what_was_kept(store, results) -> None:
    [*paths] = sorted((store.folder / OBSERVER_FOLDER).glob("test-*.json"))
    first = paths[0].read_bytes()
    kept = {path: path.stat().st_mtime_ns for path in paths}
    paths[0].unlink()
    assert load_observers(store, "test") is None
    observe_benchmark(store, "test", Workers(1))
    assert paths[0].read_bytes() == first
    assert {p: p.stat().st_mtime_ns for p in paths[1:]} == {p: kept[p] for p in paths[1:]}


@pytest.mark.slow
def test_statistics_have_the_curves_and_ceilings(items, results) -> None:
    summary = summarize_observers(results, items, 0)
    by_group = summary["curves"][SIMULATES]
    families = ("event", "time", "window")
    assert sum(by_group[family]["1"]["n"] for family in families) == len(items)
    assert by_group["all"]["0"]["value"] == pytest.approx(results[SIMULATES][0.0].mean())
    shares = np.array(list(summary["ceilings"].values())) * DRAWS
    assert np.allclose(shares, shares.round())
    text = format_observers(summary)
    assert max(map(len, text.splitlines())) <= 100
    file = io.BytesIO()
    plot_observers(observer_curves(results, items, 0), file, {"a $model$": exactly(0.8)})
    assert file.getvalue().startswith(b"\x89PNG")


@pytest.mark.slow
def test_an_item_whose_prefix_shows_no_object_is_a_guess(store, items) -> None:
    item = items[0]
    count = len(store.scene(item.scene_id).objects)
    nothing = np.zeros(count, bool)
    distances = candidate_distances(item, store, np.zeros((2, count, 2)), nothing)
    assert (distances == distances[0, 0]).all()


@pytest.mark.slow
def test_benchmarks_without_simulation_or_items_are_refused(store) -> None:
    config = store.manifest["config"] | {"simulator": "movi_a"}
    release = replace(store, manifest=store.manifest | {"config": config})
    empty = replace(store, manifest=store.manifest | {"suite": "other"})
    shutil.rmtree(store.folder / OBSERVER_FOLDER, ignore_errors=True)
    for refused, code in ((release, "no-simulation"), (empty, "empty-split")):
        with raises_user_error(code):
            observe_benchmark(refused, "test", Workers(1))


def test_an_accuracy_of_the_curve_has_the_error_of_the_curve() -> None:
    curve = known_curve([0.99, 0.97, 0.9, 0.8, 0.7, 0.55, 0.4, 0.3])
    for error, accuracy in curve.accuracy.items():
        assert curve.error_of(accuracy).value == pytest.approx(error) or error == ERRORS[-1]
    # Halfway between two accuracies, the error is the geometric mean.
    assert curve.error_of(exactly(0.75)).value == pytest.approx(8**0.5)


def test_a_higher_accuracy_is_a_smaller_error_even_where_the_curve_rises() -> None:
    curve = known_curve([0.9, 0.92, 0.9, 0.8, 0.82, 0.5, 0.5, 0.3])
    errors = [curve.error_of(exactly(a)).value for a in np.linspace(0.2, 1, 81)]
    assert (np.diff([min(e, 1e6) for e in errors]) <= 0).all()


def test_the_interval_of_an_error_is_that_of_the_accuracy() -> None:
    curve = known_curve([0.99, 0.97, 0.9, 0.8, 0.7, 0.55, 0.4, 0.3])
    found = curve.error_of(Interval(0.7, 0.55, 0.8, 100))
    assert (found.low, found.value, found.high) == pytest.approx((2, 4, 8))
    assert str(curve.error_of(Interval(0.7, 0.2, 1.0, 100))) == "4 [< 0.25, > 32]"
