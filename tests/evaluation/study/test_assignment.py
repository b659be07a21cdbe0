"""The items of a study, their order, and the letters of their candidates."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from data.records import FAMILIES, Candidate, SelectionItem
from evaluation.study.assignment import WaitingItem, assign_items, next_item
from evaluation.study.items import (
    count_shared_scenes,
    find_items,
    read_item_ids,
    sample_items,
)
from tests.user_errors import raises_user_error

NAMES = ["A1", "A2", "A3", "A4", "A5"]


def item(k: int, family: str, scene: int | None = None, stop: int = 10) -> SelectionItem:
    scene_id = f"s{k if scene is None else scene}"
    frames = [50, 60, 70, 80]
    answer = k % 4
    return SelectionItem(
        item_id=f"i{k}", split="test", suite="dynapix", family=family, subtype=f"sub{k % 2}",
        question="?", scene_id=scene_id, prefix_start=0, prefix_stop=stop,
        target_frame=frames[answer], candidates=tuple(Candidate(scene_id, f) for f in frames),
        answer=answer, min_displacement=12.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def items() -> list[SelectionItem]:
    """The paper's number of items, in families of different sizes."""
    families = ["event"] * 12 + ["time"] * 24 + ["window"] * 23
    return [item(k, family) for k, family in enumerate(families)]


@pytest.mark.parametrize("seed", range(4))
def test_correct_answers_are_balanced_over_letters(items, seed) -> None:
    by_id = {i.item_id: i for i in items}
    assignments = assign_items(items, NAMES, seed)
    assert all(sorted(a.order) == [0, 1, 2, 3] for a in assignments)
    for name in NAMES:
        for families in [*([f] for f in FAMILIES), FAMILIES]:
            counts = Counter(
                a.order.index(by_id[a.item_id].answer)
                for a in assignments
                if a.annotator == name and by_id[a.item_id].family in families
            )
            assert max(counts.values()) - min(counts[k] for k in range(4)) <= 1


@pytest.mark.parametrize("seed", range(4))
def test_the_orders_of_four_annotators_are_a_latin_square(items, seed) -> None:
    orders: dict[str, list[tuple[int, ...]]] = {}
    for a in assign_items(items, NAMES[:4], seed):
        orders.setdefault(a.item_id, []).append(a.order)
    wrong_letters = Counter()
    for i in items:
        for candidate in range(4):
            letters = [order.index(candidate) for order in orders[i.item_id]]
            # All candidates move alike, so comparing pages does not reveal the correct one.
            assert [(x - letters[0]) % 4 for x in letters] == [0, 1, 2, 3]
            if candidate != i.answer:
                moved = (letters[0] - orders[i.item_id][0].index(i.answer)) % 4
                wrong_letters[(candidate - i.answer) % 4, moved] += 1
    # The wrong candidates are in random order relative to the correct one.
    assert len(wrong_letters) == 9
    assert max(wrong_letters.values()) < len(items) / 2


def test_orders_depend_on_the_seed_the_items_and_the_annotator(items) -> None:
    assignments = assign_items(items, NAMES, 0)
    assert assignments == assign_items(items, NAMES, 0)
    assert assignments != assign_items(items, NAMES, 1)
    ranks = {n: tuple(a.rank for a in assignments if a.annotator == n) for n in NAMES}
    assert len(set(ranks.values())) == len(NAMES)
    # The items of another benchmark have other orders under the same seed.
    others = assign_items([item(k + 1000, i.family) for k, i in enumerate(items)], NAMES, 0)
    assert [a.order for a in others] != [a.order for a in assignments]


def test_families_and_depth_stay_even_if_annotators_stop_early(items) -> None:
    names = NAMES[:3]
    assignments = assign_items(items, names, 0)
    total = Counter(i.family for i in items)
    by_id = {i.item_id: i for i in items}
    done: dict[str, list[str]] = {name: [] for name in names}
    rng = np.random.default_rng(0)
    for answers in range(1, 128):
        name = names[rng.integers(3)]
        if len(done[name]) == len(items):
            continue
        votes = Counter(i for own in done.values() for i in own)
        waiting = [
            WaitingItem(i.item_id, i.family, i.scene_id, i.prefix_stop, a.rank, votes[i.item_id])
            for a in assignments
            if a.annotator == name and (i := by_id[a.item_id]).item_id not in done[name]
        ]
        opened = Counter(by_id[i].family for i in done[name])
        done[name].append(next_item(waiting, opened, total))
        opened[by_id[done[name][-1]].family] += 1
        shares = [opened[f] / total[f] for f in FAMILIES]
        assert max(shares) - min(shares) <= 1 / min(total.values()) + 1e-9
        if answers == len(items) - 4:
            depth = Counter(i for own in done.values() for i in own)
            assert max(depth.values()) == 1, "an item got a second vote before others had one"
    depth = Counter(i for own in done.values() for i in own)
    assert set(depth.values()) <= {1, 2, 3}
    assert len(depth) == len(items)


def test_the_earliest_prefix_of_a_scene_comes_first() -> None:
    waiting = [
        WaitingItem("late", "event", "s", 90, 0, 0),
        WaitingItem("early", "event", "s", 25, 7, 5),
        WaitingItem("elsewhere", "event", "t", 95, 3, 1),
    ]
    order = []
    while waiting:
        order.append(next_item(waiting, {}, {"event": 3}))
        waiting = [w for w in waiting if w.item_id != order[-1]]
    assert order == ["elsewhere", "early", "late"]


def test_sampled_items_are_even_and_share_scenes_only_if_they_must() -> None:
    pool = [item(k, FAMILIES[k % 3], scene=k // 2) for k in range(60)]
    sampled = sample_items(pool, 20, 0, "items")
    assert sorted(Counter(i.family for i in sampled).values()) == [6, 7, 7]
    assert count_shared_scenes(sampled) == 0
    assert max(Counter((i.family, i.subtype) for i in sampled).values()) <= 4
    assert sampled == sample_items(pool, 20, 0, "items") != sample_items(pool, 20, 1, "items")
    assert sorted(sample_items(pool, 60, 0, "items"), key=pool.index) == pool
    assert count_shared_scenes(pool) == 60
    with raises_user_error("too-few-items", contains=("practice=61", "60")):
        sample_items(pool, 61, 0, "practice")


def test_a_file_names_items_plainly_or_in_json(tmp_path: Path) -> None:
    pool = [item(k, "time") for k in range(4)]
    file = tmp_path / "items.txt"
    file.write_text('i3\n\n{"item_id": "i1", "note": 2}\n')
    found = find_items(pool, read_item_ids(file), "store/x")
    assert [i.item_id for i in found] == ["i3", "i1"]


@pytest.mark.parametrize(
    ("content", "code", "named"),
    [
        (b"", "invalid-items", "items.txt"),
        (b"i1\ni1\n", "invalid-items", "i1 2 times"),
        (b'{"item": 1}', "invalid-items", "line 1"),
        (b'{"item_id": 7}', "invalid-items", "line 1"),
        (b"i1\n{", "invalid-items", "line 2"),
        (b"\xff\xfe\x00", "invalid-items", "items.txt"),
        (None, "missing-file", "items.txt"),
    ],
)
def test_an_invalid_file_of_items_is_refused(tmp_path, content, code, named) -> None:
    file = tmp_path / "items.txt"
    if content is not None:
        file.write_bytes(content)
    with raises_user_error(code, contains=named):
        read_item_ids(file)


def test_an_unknown_item_is_refused() -> None:
    with raises_user_error("unknown-item", contains=("i9", "store/x")):
        find_items([item(1, "time")], ["i1", "i9"], "store/x")
