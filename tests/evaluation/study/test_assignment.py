"""Which items are asked, in which order, and where the right answer stands."""

from __future__ import annotations

from collections import Counter
from pathlib import Path

import numpy as np
import pytest

from conf.errors import UserError
from data.records import FAMILIES, Candidate, SelectionItem
from evaluation.study import sampling
from evaluation.study.assignment import Waiting, next_item, plan

NAMES = ["A1", "A2", "A3", "A4"]


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
    """The paper's number, its families of uneven size."""
    families = ["event"] * 12 + ["time"] * 24 + ["window"] * 23
    return [item(k, family) for k, family in enumerate(families)]


@pytest.mark.parametrize("seed", range(4))
def test_the_right_answer_stands_everywhere_equally_often(items, seed) -> None:
    planned = plan(items, NAMES, seed)
    of = {i.item_id: i for i in items}
    places = [(p, of[p.item_id].family, p.order.index(of[p.item_id].answer)) for p in planned]
    for name in NAMES:
        for families in [*([f] for f in FAMILIES), FAMILIES]:
            counts = Counter(w for p, f, w in places if p.annotator == name and f in families)
            assert max(counts.values()) - min(counts[k] for k in range(4)) <= 1
    for i in items:
        assert {w for p, _, w in places if p.item_id == i.item_id} == {0, 1, 2, 3}
        assert all(sorted(p.order) == [0, 1, 2, 3] for p in planned)


@pytest.mark.parametrize("seed", range(4))
def test_pages_side_by_side_show_all_candidates_moving_alike(items, seed) -> None:
    of = {i.item_id: i for i in items}
    by_item: dict[str, list[tuple[int, ...]]] = {}
    for p in plan(items, NAMES, seed):
        by_item.setdefault(p.item_id, []).append(p.order)
    right, wrong = Counter(), Counter()
    for name, orders in by_item.items():
        for candidate in range(4):
            places = [order.index(candidate) for order in orders]
            assert sorted(places) == [0, 1, 2, 3]
            moved = right if candidate == of[name].answer else wrong
            moved[places[0], places[1]] += 1
    # Of the twelve ways to move from one page to the next none tells the right answer.
    assert len(wrong) == 12
    assert len(right) >= 10
    assert max(right.values()) < len(items) / 3


def test_orders_come_from_the_seed_and_the_items_and_are_each_annotators_own(items) -> None:
    planned = plan(items, NAMES, 0)
    assert planned == plan(items, NAMES, 0)
    assert planned != plan(items, NAMES, 1)
    ranks = {n: tuple(p.rank for p in planned if p.annotator == n) for n in NAMES}
    assert len(set(ranks.values())) == len(NAMES)
    # Another benchmark's items stand elsewhere under the same seed.
    others = plan([item(k + 1000, i.family) for k, i in enumerate(items)], NAMES, 0)
    assert [p.order for p in others] != [p.order for p in planned]


def test_who_stops_early_leaves_families_and_depth_even(items) -> None:
    planned = plan(items, NAMES[:3], 0)
    total = Counter(i.family for i in items)
    of = {i.item_id: i for i in items}
    done: dict[str, list[str]] = {name: [] for name in NAMES[:3]}
    rng = np.random.default_rng(0)
    for given in range(1, 128):
        name = NAMES[rng.integers(3)]
        if len(done[name]) == len(items):
            continue
        votes = Counter(i for mine in done.values() for i in mine)
        waiting = [
            Waiting(i.item_id, i.family, i.scene_id, i.prefix_stop, p.rank, votes[i.item_id])
            for p in planned
            if p.annotator == name and (i := of[p.item_id]).item_id not in done[name]
        ]
        asked = Counter(of[i].family for i in done[name])
        done[name].append(next_item(waiting, asked, total))
        asked[of[done[name][-1]].family] += 1
        shares = [asked[f] / total[f] for f in FAMILIES]
        assert max(shares) - min(shares) <= 1 / min(total.values()) + 1e-9
        if given == len(items) - 4:
            depth = Counter(i for mine in done.values() for i in mine)
            assert max(depth.values()) == 1, "an item got a second vote before others had one"
    depth = Counter(i for mine in done.values() for i in mine)
    assert set(depth.values()) <= {1, 2, 3}
    assert len(depth) == len(items)


def test_an_item_comes_before_those_that_show_what_became_of_its_scene() -> None:
    waiting = [
        Waiting("late", "event", "s", 90, 0, 0),
        Waiting("early", "event", "s", 25, 7, 5),
        Waiting("elsewhere", "event", "t", 95, 3, 1),
    ]
    order = []
    while waiting:
        order.append(next_item(waiting, {}, {"event": 3}))
        waiting = [w for w in waiting if w.item_id != order[-1]]
    assert order.index("early") < order.index("late")
    assert order == ["elsewhere", "early", "late"]


def test_drawn_items_are_even_and_share_no_scene_while_there_are_others() -> None:
    pool = [item(k, FAMILIES[k % 3], scene=k // 2) for k in range(60)]
    found = sampling.drawn(pool, 20, seed=0)
    assert sorted(Counter(i.family for i in found).values()) == [6, 7, 7]
    assert sampling.sharing(found) == 0
    assert max(Counter((i.family, i.subtype) for i in found).values()) <= 4
    assert found == sampling.drawn(pool, 20, seed=0) != sampling.drawn(pool, 20, seed=1)
    assert sorted(sampling.drawn(pool, 60, 0), key=pool.index) == pool
    assert sampling.sharing(pool) == 60
    with pytest.raises(ValueError, match="there are 60"):
        sampling.drawn(pool, 61, seed=0)


def test_a_file_names_items_plainly_or_in_json(tmp_path: Path) -> None:
    pool = [item(k, "time") for k in range(4)]
    file = tmp_path / "items.txt"
    file.write_text('i3\n\n{"item_id": "i1", "note": 2}\n')
    names = sampling.read_names(file)
    assert [i.item_id for i in sampling.chosen(pool, names, "store/x")] == ["i3", "i1"]


@pytest.mark.parametrize(
    ("content", "said"),
    [
        (b"", "names no item"),
        (b"i1\ni1\n", "names i1 2 times"),
        (b'{"item": 1}', "line 1 is no JSON object"),
        (b'{"item_id": 7}', "line 1 is no JSON object"),
        (b"i1\n{", "line 2 is no JSON object"),
        (b"\xff\xfe\x00", "is no text"),
        (None, "No such file"),
    ],
)
def test_a_file_that_names_no_items_is_told(tmp_path, content, said) -> None:
    file = tmp_path / "items.txt"
    if content is not None:
        file.write_bytes(content)
    with pytest.raises(UserError, match=said):
        sampling.read_names(file)


def test_an_unknown_item_is_named() -> None:
    with pytest.raises(UserError, match="item i9 is no test item of store/x"):
        sampling.chosen([item(1, "time")], ["i1", "i9"], "store/x")
