"""The items of a study, their order for each annotator, and the letters of their candidates."""

from __future__ import annotations

import sqlite3
from collections import Counter

import numpy as np
import pytest

from dynapix.conf.schema import StudyCommand
from dynapix.data.records import FAMILIES, Candidate, SelectionItem
from dynapix.evaluation.study import storage
from dynapix.evaluation.study.assignment import assign_items
from dynapix.evaluation.study.setup import choose_items, item_scenes, sample_items
from dynapix.evaluation.study.workflow import open_next_item
from tests.user_errors import raises_user_error

NAMES = ["A1", "A2", "A3", "A4", "A5"]


def item(k: int, family: str, scene: int | None = None) -> SelectionItem:
    scene_id = f"s{k if scene is None else scene}"
    frames = [50, 60, 70, 80]
    answer = k % 4
    return SelectionItem(
        item_id=f"i{k}", split="test", suite="dynapix", family=family, subtype=f"sub{k % 2}",
        question="?", scene_id=scene_id, prefix_start=0, prefix_stop=10,
        target_frame=frames[answer], candidates=tuple(Candidate(scene_id, f) for f in frames),
        answer=answer, min_displacement=12.0,
    )  # fmt: skip


@pytest.fixture(scope="module")
def items() -> list[SelectionItem]:
    """As many items as in the paper's study, in families of different sizes."""
    families = ["event"] * 12 + ["time"] * 24 + ["window"] * 23
    return [item(k, family) for k, family in enumerate(families)]


@pytest.mark.parametrize("seed", range(2))
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
            # All candidates move alike, so that comparing pages does not reveal the correct one.
            assert [(x - letters[0]) % 4 for x in letters] == [0, 1, 2, 3]
            if candidate != i.answer:
                moved = (letters[0] - orders[i.item_id][0].index(i.answer)) % 4
                wrong_letters[(candidate - i.answer) % 4, moved] += 1
    # The wrong candidates are in random order relative to the correct one.
    assert len(wrong_letters) == 9
    assert max(wrong_letters.values()) < len(items) / 2


def test_assignment_depends_on_the_seed_the_items_and_the_annotator(items) -> None:
    assignments = assign_items(items, NAMES, 0)
    assert assignments == assign_items(items, NAMES, 0)
    assert assignments != assign_items(items, NAMES, 1)
    ranks = {n: tuple(a.rank for a in assignments if a.annotator == n) for n in NAMES}
    assert len(set(ranks.values())) == len(NAMES)
    # The items of another benchmark have other orders under the same seed.
    others = assign_items([item(k + 1000, i.family) for k, i in enumerate(items)], NAMES, 0)
    assert [a.order for a in others] != [a.order for a in assignments]


def open_and_answer(db: sqlite3.Connection, annotator: str) -> str:
    """Open and answer the next item of an annotator, and return its id."""
    token = open_next_item(db, annotator)
    db.execute("UPDATE turn SET loaded = opened, answered = opened WHERE token = ?", (token,))
    [row] = db.execute("SELECT item_id FROM turn WHERE token = ?", (token,))
    return row["item_id"]


def test_families_and_votes_are_balanced_if_annotators_stop_early(items, tmp_path) -> None:
    names = NAMES[:3]
    path = tmp_path / storage.DATABASE
    storage.create(path, {}, items, [], names, assign_items(items, names, 0))
    db = storage.open_study(path)
    total = Counter(i.family for i in items)
    family_of = {i.item_id: i.family for i in items}
    done: dict[str, list[str]] = {name: [] for name in names}
    rng = np.random.default_rng(0)
    for answers in range(1, 128):
        name = names[rng.integers(3)]
        if len(done[name]) == len(items):
            continue
        done[name].append(open_and_answer(db, name))
        opened = Counter(family_of[i] for i in done[name])
        shares = [opened[f] / total[f] for f in FAMILIES]
        assert max(shares) - min(shares) <= 1 / min(total.values()) + 1e-9
        if answers == len(items) - 4:
            depth = Counter(i for own in done.values() for i in own)
            assert max(depth.values()) == 1, "an item got a second vote before others had one"
    depth = Counter(i for own in done.values() for i in own)
    assert set(depth.values()) <= {1, 2, 3}
    assert len(depth) == len(items)


def test_sampled_items_are_balanced_and_do_not_share_scenes() -> None:
    pool = [item(k, FAMILIES[k % 3], scene=k // 2) for k in range(60)]
    sampled = sample_items(pool, 20, 0)
    assert sorted(Counter(i.family for i in sampled).values()) == [6, 7, 7]
    assert len(set.union(*map(item_scenes, sampled))) == len(sampled)
    assert max(Counter((i.family, i.subtype) for i in sampled).values()) <= 4
    assert sampled == sample_items(pool, 20, 0) != sample_items(pool, 20, 1)
    assert sorted(sample_items(pool, 60, 0), key=pool.index) == pool
    with raises_user_error("too-few-items", contains=("items=61", "60")):
        sample_items(pool, 61, 0)


def test_a_file_lists_items(micro_store, tmp_path) -> None:
    first, second, *_ = [i.item_id for i in micro_store.selection("test")]
    file = tmp_path / "items.txt"
    for content, code in (
        (None, "invalid-items"), ("\n", "invalid-items"), ("elsewhere\n", "unknown-item"),
    ):  # fmt: skip
        if content is not None:
            file.write_text(content)
        with raises_user_error(code, contains="item"):
            choose_items(StudyCommand(items=str(file)), micro_store)
    file.write_text(f"{second}\n\n{first}\n")
    chosen = choose_items(StudyCommand(items=str(file)), micro_store)
    assert [i.item_id for i in chosen] == [second, first]
