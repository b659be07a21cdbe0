"""The accuracy on balanced time items, split into future and moment."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np
import pytest

from dynapix.data.checks.intervals import SceneBootstrap
from dynapix.data.items.recipes import TIME_CELLS
from dynapix.data.records import LETTERS, Candidate, SelectionItem
from dynapix.evaluation.metrics.future_moment import (
    FutureMoment,
    Shares,
    has_two_futures,
    measure_future_moment,
)
from dynapix.evaluation.reporting.tables import future_moment_table

ITEMS = 240


def make_items() -> list[SelectionItem]:
    """Time items of every cell whose candidates are two futures at two moments, in random order."""
    rng = np.random.default_rng(0)
    items = []
    for k in range(ITEMS):
        scene_id, subtype = f"s{k % 60}", [*TIME_CELLS][k % len(TIME_CELLS)]
        target, wrong = 40 + k % 50, 95 + k % 30
        shown = [(s, f) for s in (scene_id, f"{scene_id}-alt-{k % 2}") for f in (target, wrong)]
        order = rng.permutation(4).tolist()
        candidates = tuple(Candidate(*shown[i], "x") for i in order)
        items.append(
            SelectionItem(
                f"i{k}", "test", "dynapix", "time", subtype, "Which?", scene_id, 0, 25, target,
                candidates, order.index(0), 12.0,
            )
        )  # fmt: skip
    return items


@pytest.fixture(scope="module")
def items() -> list[SelectionItem]:
    return make_items()


def choose(items: list[SelectionItem], suits: Callable[..., bool], seed: int = 3) -> dict[str, str]:
    """Choose a random letter among the candidates that suit."""
    rng = np.random.default_rng(seed)
    return {
        i.item_id: str(
            rng.choice([x for x, c in zip(LETTERS, i.candidates, strict=True) if suits(i, c)])
        )
        for i in items
    }


def true_future(item: SelectionItem, candidate: Candidate) -> bool:
    return candidate.scene_id == item.scene_id


def true_moment(item: SelectionItem, candidate: Candidate) -> bool:
    return candidate.frame == item.target_frame


def anything(item: SelectionItem, candidate: Candidate) -> bool:
    return True


def values(shares: Shares) -> tuple[float, float, float]:
    return shares.accuracy.value, shares.future.value, shares.moment.value


@pytest.fixture(scope="module")
def measured(items) -> dict[str, FutureMoment]:
    random = choose(items, anything)
    letters = {
        "future": choose(items, true_future),
        "moment": choose(items, true_moment),
        "target": {item.item_id: item.letter for item in items},
        "random": random,
        "often silent": {k: "" if n % 3 else x for n, (k, x) in enumerate(random.items())},
        "silent": dict.fromkeys(random, ""),
        "tied": dict.fromkeys(random, LETTERS),
    }
    return measure_future_moment(items, letters, seed=0)


def test_future_and_moment_say_what_an_answer_shows(measured):
    (right, future, moment) = values(measured["future"].total)
    assert (future, moment) == (1, right)
    assert right == pytest.approx(0.5, abs=0.1)
    (right, future, moment) = values(measured["moment"].total)
    assert (moment, future) == (1, right)
    assert right == pytest.approx(0.5, abs=0.1)
    assert values(measured["target"].total) == (1, 1, 1)
    assert values(measured["silent"].total) == (0, 0, 0)
    assert values(measured["tied"].total) == (0.25, 0.5, 0.5)


def test_shares_bound_the_accuracy(measured):
    for of_model in measured.values():
        for shares in (of_model.total, *of_model.horizons.values()):
            accuracy, future, moment = values(shares)
            assert accuracy <= min(future, moment)
            assert accuracy >= future + moment - 1 - 1e-9


def test_horizons_add_up_to_the_whole(measured):
    for of_model in measured.values():
        total = of_model.total
        seconds = [f"{s} s" for s in TIME_CELLS.values()]
        assert [*of_model.horizons] == seconds
        by_horizon = zip(*map(values, of_model.horizons.values()), strict=True)
        # Each cell has the same number of items.
        assert [np.mean(parts) for parts in by_horizon] == pytest.approx(values(total))


def test_intervals_are_those_of_the_accuracy(items):
    """Other items of the evaluation do not count, but the same scenes are resampled."""
    paper = [
        replace(item, item_id=f"p{k}", candidates=tuple(
            Candidate(item.scene_id, frame, "x") for frame in (item.target_frame, 96, 100, 110)
        ), answer=0)
        for k, item in enumerate(items[:90])
    ]  # fmt: skip
    assert not any(map(has_two_futures, paper))
    every = [*paper, *items]
    chosen = choose(every, anything)
    measured = measure_future_moment(every, {"one": chosen}, seed=5)["one"]
    scenes = SceneBootstrap([item.scene_id for item in every], 5)
    right = [float(chosen[item.item_id] == item.letter) for item in every]
    groups = ["paper"] * len(paper) + ["balanced"] * len(items)
    assert measured.total.accuracy == scenes.group_means(right, groups)["balanced"]
    assert measure_future_moment(paper, {"one": chosen}, seed=5) == {}
    del chosen[items[0].item_id]
    assert measure_future_moment(every, {"one": chosen}, seed=5) == {}


def test_the_table_has_every_model(measured):
    table = str(future_moment_table(measured))
    assert all(label in table for label in measured)
    assert table.count("0.25 s") == table.count("3 s") == len(measured)
