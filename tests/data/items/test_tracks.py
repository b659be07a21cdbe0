"""Items, queries and databases of a built benchmark agree with the oracle and with the paper."""

from __future__ import annotations

from collections import Counter
from dataclasses import replace
from itertools import combinations

import numpy as np
import pytest

from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.items.database import UniqueFrames, counterfactual_database
from dynapix.data.items.pickers import Timing, visible_objects
from dynapix.data.items.recipes import TIME_QUESTION, window_subjects
from dynapix.data.oracle.displacement import (
    cross_scene_displacement,
    frame_displacements,
    object_match_scores,
    visible_positions,
)
from dynapix.data.oracle.events import collisions_in, next_collision, window_group
from dynapix.data.oracle.interventions import removal_displacements
from dynapix.data.records import FPS, SPLITS, FrameRef, SelectionItem, original_scene_id
from dynapix.data.store import Store


@pytest.fixture(scope="module")
def items(benchmark_store: Store) -> list[SelectionItem]:
    return benchmark_store.selection()


@pytest.fixture(scope="module")
def min_displacement(benchmark_store: Store) -> float:
    """The minimum displacement between two candidates, px at 336 x 336."""
    return benchmark_store.manifest["config"]["selection"]["min_displacement"]


def timing(item: SelectionItem) -> Timing:
    return Timing(item.prefix_start, item.prefix_stop, item.target_frame)


def test_every_cell_has_items_and_letters_are_balanced(benchmark_store, items) -> None:
    track = benchmark_store.manifest["config"]["selection"]
    cells = {(f, cell) for f in ("event", "time", "window") for cell in track[f]}
    assert {(i.family, i.subtype) for i in items} == cells
    for cell_and_split in {(i.subtype, i.split) for i in items}:
        letters = Counter(i.answer for i in items if (i.subtype, i.split) == cell_and_split)
        assert max(letters.values()) - min(letters[k] for k in range(4)) <= 1
    assert len({i.item_id for i in items}) == len(items)


def test_items_and_queries_have_the_split_of_their_scene(benchmark_store, items) -> None:
    train, test = set(benchmark_store.scene_ids("train")), set(benchmark_store.scene_ids("test"))
    assert not train & test
    assert len(test) * 4 == len(train)
    for record in (*items, *benchmark_store.retrieval()):
        assert record.scene_id in (train if record.split == "train" else test)


def test_candidates_differ_by_the_minimum_displacement(
    benchmark_store, items, min_displacement
) -> None:
    for item in items:
        gaps = []
        for a, b in combinations(item.candidates, 2):
            scene, other = benchmark_store.scene(a.scene_id), benchmark_store.scene(b.scene_id)
            gap = cross_scene_displacement(scene, a.frame, other, b.frame)
            if a.scene_id == b.scene_id:
                assert gap == pytest.approx(frame_displacements(scene)[a.frame, b.frame])
            gaps.append(gap)
        assert item.min_displacement == pytest.approx(min(gaps), rel=1e-5)
        assert min(gaps) >= min_displacement


def test_event_items_match_a_collision(benchmark_store, items) -> None:
    for item in (i for i in items if i.family == "event"):
        events = [c.frame for c in benchmark_store.scene(item.scene_id).collisions]
        assert item.event_frame in events
        if item.framing == "future":
            assert next_collision(benchmark_store.scene(item.scene_id), item.prefix_stop).frame == (
                item.target_frame
            )
        assert item.prefix_stop - item.prefix_start == 20
        assert item.gap == (5 if item.subtype == "future_match_gap5" else 10)
        assert item.prefix_stop == item.event_frame - (item.gap if item.framing == "future" else 0)
        assert item.target_frame == item.prefix_stop + item.gap
        assert item.target_frame <= 127 - 10


def test_event_distractors_match_their_source(benchmark_store, items, min_displacement) -> None:
    split = {s: set(benchmark_store.scene_ids(s)) for s in ("train", "test")}
    for item in (i for i in items if i.family == "event"):
        scene = benchmark_store.scene(item.scene_id)
        wrong = [c for c in item.candidates if c.source != "target"]
        assert {c.source for c in wrong} == {item.distractors}
        cross_scenes = {c.scene_id for c in wrong} - {item.scene_id}
        if item.distractors == "cross_scene":
            assert len(cross_scenes) == 3
            assert cross_scenes <= split[item.split]
        else:
            assert not cross_scenes
        if item.distractors == "same_offset":
            assert {abs(c.frame - item.target_frame) for c in wrong} <= {16, 32, 48}
        if item.distractors == "same_obj_match":
            # A frame on the same side of the target that is more similar than the distractors is
            # not a candidate because it differs too little from one.
            score = object_match_scores(scene, item.target_frame)
            gaps = frame_displacements(scene, visible_objects(scene, timing(item)))
            chosen = [c.frame for c in item.candidates]
            for early in (True, False):
                side = [c.frame for c in wrong if (c.frame < item.target_frame) == early]
                closest = min((score[f] for f in side), default=0)
                nearer = timing(item).outside_prefix(np.flatnonzero(score < closest))
                for frame in (f for f in nearer if (f < item.target_frame) == early):
                    is_too_close = gaps[frame, chosen].min() < min_displacement
                    assert frame == item.target_frame or is_too_close


def test_time_items_count_26_frames_per_second(items) -> None:
    cells = {
        "in_250ms": (32, "a quarter of a second"), "in_500ms": (39, "half a second"),
        "in_1s": (52, "1 second"), "in_1500ms": (65, "1.5 seconds"), "in_2s": (78, "2 seconds"),
        "in_3s": (104, "3 seconds"),
    }  # fmt: skip
    for item in (i for i in items if i.family == "time"):
        target, words = cells[item.subtype]
        assert (item.prefix_start, item.prefix_stop) == (0, 25)
        assert (item.target_frame, item.horizon) == (target, target - 25)
        assert item.question == TIME_QUESTION.format(words)


def test_window_items_match_their_group_and_horizon(benchmark_store, items) -> None:
    for item in (i for i in items if i.family == "window"):
        assert item.prefix_stop - item.prefix_start + 1 == 16
        assert item.target_frame - item.prefix_stop == item.horizon
        scene = benchmark_store.scene(item.scene_id)
        group = window_group(scene, item.prefix_start, item.prefix_stop, item.horizon)
        family = item.window_family
        assert item.subtype == f"{group}_{family}_h{item.horizon}_{item.difficulty}"


def test_candidates_of_window_families_b_and_c_differ_in_their_subjects(
    benchmark_store, items, min_displacement
) -> None:
    counts = Counter()
    for item in (i for i in items if i.window_family in ("B", "C")):
        scene = benchmark_store.scene(item.scene_id)
        subjects = window_subjects(item.window_family, scene, timing(item))
        visible = visible_objects(scene, timing(item))
        if item.window_family == "B":
            assert item.group in ("G2", "G4")
            ahead = collisions_in(scene, item.prefix_stop + 1, item.target_frame)
            assert subjects in {c.objects for c in ahead}
            subjects = tuple(k for k in subjects if k in visible)
        else:
            assert item.group != "G4"
            assert len(subjects) == 1
        gaps = frame_displacements(scene, subjects)
        for a, b in combinations(item.candidates, 2):
            assert gaps[a.frame, b.frame] >= min_displacement
        counts[item.window_family] += 1
    assert min(counts["B"], counts["C"]) > 2


def test_candidates_differ_in_a_visible_object(benchmark_store, items, min_displacement) -> None:
    for item in items:
        scene = benchmark_store.scene(item.scene_id)
        gaps = frame_displacements(scene, visible_objects(scene, timing(item)))
        same = [c.frame for c in item.candidates if c.scene_id == item.scene_id]
        assert timing(item).outside_prefix(same) == same
        assert all(gaps[a, b] >= min_displacement for a, b in combinations(same, 2))


def test_rank_of_the_target_in_time_is_balanced(items) -> None:
    ranks = Counter(
        sum(c.frame < i.target_frame for c in i.candidates)
        for i in items
        if i.family == "window" or i.family == "time"
    )
    assert all(0.12 < ranks[k] / ranks.total() < 0.4 for k in range(4))


def test_hard_distractors_are_more_similar_than_easy_ones(benchmark_store, items) -> None:
    score = {"easy": [], "hard": []}
    for item in (i for i in items if i.window_family == "A"):
        match = object_match_scores(benchmark_store.scene(item.scene_id), item.target_frame)
        score[item.difficulty] += [match[c.frame] for c in item.candidates if c.source != "target"]
    assert np.median(score["hard"]) < np.median(score["easy"])


def test_displacement_across_scenes_with_different_objects_is_the_diagonal(benchmark_store) -> None:
    scene, other = (benchmark_store.scene(s) for s in benchmark_store.scene_ids("train")[:2])
    assert scene.objects != other.objects
    assert cross_scene_displacement(scene, 60, other, 60) == pytest.approx(336 * 2**0.5)
    assert cross_scene_displacement(scene, 60, scene, 60) == 0


def test_hidden_objects_do_not_distinguish_frames(benchmark_store) -> None:
    for name in benchmark_store.scene_ids("train")[:4]:
        scene = benchmark_store.scene(name)
        for k in range(len(scene.objects)):
            fraction = scene.visible_fraction.copy()
            fraction[:, k] = 0.05
            hidden = replace(scene, visible_fraction=fraction)
            others = tuple(j for j in range(len(scene.objects)) if j != k)
            assert np.array_equal(frame_displacements(hidden), frame_displacements(scene, others))
            # Frames in which it becomes visible are distinguished by it as before.
            fraction[-1, k] = 0.06
            visible = frame_displacements(replace(scene, visible_fraction=fraction))[:, -1]
            shown = replace(scene, visible_fraction=np.ones_like(fraction))
            if visible_positions(shown)[1][-1, k]:
                own = frame_displacements(shown, (k,))[:, -1]
                assert (visible >= own - 1e-6).all()


def test_builders_use_at_most_their_number_of_events_per_scene(benchmark_store) -> None:
    queries = benchmark_store.retrieval()
    assert {q.builder for q in queries} == set(range(1, 7))
    for builder in range(1, 7):
        own = [q for q in queries if q.builder == builder]
        timings = {(q.scene_id, q.prefix_start, q.prefix_stop, q.target) for q in own}
        assert len(timings) == len(own)
        queries_of_scene = Counter(q.scene_id for q in own)
        if builder == 3:
            events = {(q.scene_id, q.target.frame) for q in own}
            assert max(Counter(s for s, _ in events).values()) <= 3
        if builder in (4, 5, 6):
            assert max(queries_of_scene.values()) == 1


def test_builders_follow_the_papers_timing(benchmark_store) -> None:
    for q in benchmark_store.retrieval():
        events = {c.frame for c in benchmark_store.scene(q.scene_id).collisions}
        ahead, length = q.target.frame - q.prefix_stop, q.prefix_stop - q.prefix_start
        assert q.prefix_stop < q.target.frame
        seconds = (ahead + (q.builder == 1)) // FPS
        if q.anchor == "time":
            assert f" {seconds} second" in q.question
        if q.builder == 1:
            assert q.target.frame == 127
            assert q.prefix_stop in (2 * FPS, 3 * FPS, 4 * FPS)
        elif q.builder == 2:
            assert (q.prefix_stop, ahead % FPS) == (2 * FPS, 0)
        elif q.builder == 3:
            assert q.target.frame in events
            assert (q.prefix_start, ahead) == (0, 5)
            assert length + 1 >= 12
        else:
            assert q.prefix_stop + {4: 0, 5: FPS, 6: FPS // 2}[q.builder] in events
            assert (length, ahead) == (FPS, FPS)


def test_hard_negatives_are_wrong_time_frames_of_the_scene(benchmark_store) -> None:
    for q in benchmark_store.retrieval():
        gaps = frame_displacements(benchmark_store.scene(q.scene_id))
        frames = [q.target.frame, *(n.frame for n in q.hard_negatives)]
        assert len(frames) == 1 + benchmark_store.manifest["config"]["retrieval"]["hard_negatives"]
        assert {n.scene_id for n in q.hard_negatives} == {q.scene_id}
        assert min(gaps[a, b] for a, b in combinations(frames, 2)) >= 12


def test_counterfactual_targets_differ_from_the_factual_scene(
    benchmark_store, min_displacement
) -> None:
    queries = benchmark_store.retrieval(pool="counterfactual")
    assert {q.split for q in queries} == {"train", "test"}
    for q in queries:
        scene, other = benchmark_store.scene(q.scene_id), benchmark_store.scene(q.target.scene_id)
        k = [o.noun_phrase for o in scene.objects].index(q.removed_object)
        assert q.target.scene_id == f"{q.scene_id}-without-{k}"
        assert other.objects == scene.objects[:k] + scene.objects[k + 1 :]
        assert other.split == scene.split == q.split
        assert q.removed_object in q.question
        # The object is in view at the end of the prefix, and has had no contact until then.
        assert scene.in_view[q.prefix_stop, k]
        first = min(c.frame for c in scene.collisions if k in c.objects)
        assert q.prefix_stop < first
        kept = [i for i in range(len(scene.objects)) if i != k]
        before = slice(0, first)
        np.testing.assert_array_equal(scene.positions[before, kept], other.positions[before])
        shifts = removal_displacements(scene, other, k)
        asked = [o.noun_phrase for o in scene.objects].index(q.asked_object)
        assert asked != k
        assert f"where would the {q.asked_object} be" in q.question
        assert shifts[q.target.frame, asked] >= min_displacement
        assert other.in_view[q.target.frame, asked - (asked > k)]
        assert shifts[: q.prefix_stop].max() == 0
        assert q.target.frame - q.prefix_stop in (12, 25, 50, 75, 100)
        factual, *wrong_time = q.hard_negatives
        assert factual == q.factual_twin == FrameRef(q.scene_id, q.target.frame)
        assert {n.scene_id for n in wrong_time} == {other.scene_id}
        for pair in combinations([q.target, *q.hard_negatives], 2):
            a, b = ((benchmark_store.scene(f.scene_id), f.frame) for f in pair)
            assert cross_scene_displacement(*a, *b) >= min_displacement


def test_databases_contain_targets_and_no_identical_frames(benchmark_store) -> None:
    frames = FrameReader(benchmark_store)
    queries_of = {
        "test": benchmark_store.standard_test(),
        "future": benchmark_store.retrieval(),
        "counterfactual": benchmark_store.retrieval(pool="counterfactual"),
    }
    for name, queries in queries_of.items():
        database = benchmark_store.database(name)
        assert {q.target for q in queries} <= set(database)
        pixels = {frames.array(f.scene_id, f.frame).tobytes() for f in database}
        assert len(pixels) == len(database) == len(set(database))


def test_standard_test_uses_only_test_scenes(benchmark_store) -> None:
    queries, database = benchmark_store.standard_test(), benchmark_store.database("test")
    assert queries == benchmark_store.retrieval("test")
    assert {f.scene_id for f in database} <= set(benchmark_store.scene_ids("test"))
    assert set(database) <= set(benchmark_store.database("future"))


@pytest.mark.parametrize("only_targets", [False, True])
def test_ranked_frames_are_of_the_split_and_include_targets_and_twins(
    benchmark_store, monkeypatch, only_targets
) -> None:
    queries = {split: benchmark_store.retrieval(split, "counterfactual") for split in SPLITS}
    if only_targets:
        targets = [q.target for own in queries.values() for q in own]
        monkeypatch.setattr(Store, "database", lambda store, name: targets)
    for split, own in queries.items():
        frames = benchmark_store.ranked_frames(split, "counterfactual")
        assert len(frames) == len(set(frames))
        assert {frame for q in own for frame in (q.target, q.factual_twin)} <= set(frames)
        scenes = {original_scene_id(frame.scene_id) for frame in frames}
        assert scenes <= set(benchmark_store.scene_ids(split))


def test_counterfactual_database_contains_factual_frames(benchmark_store) -> None:
    database = benchmark_store.database("counterfactual")
    unique = UniqueFrames(benchmark_store.scene)
    assert all(unique.add(frame) for frame in database)
    queries = benchmark_store.retrieval(pool="counterfactual")
    test = [q.hard_negatives[0] for q in queries if q.split == "test"]
    train = [q.hard_negatives[0] for q in queries if q.split == "train"]
    assert test
    assert not any(unique.add(frame) for frame in test)
    if any(unique.add(frame) for frame in train):
        others = set(database) - {q.target for q in queries}
        assert others <= {*test, *train}, "the database has other frames, but lacks factual ones"


@pytest.mark.parametrize("more", [0, 1, 3])
def test_counterfactual_database_has_its_configured_size(micro, micro_store, more) -> None:
    queries = micro_store.retrieval(pool="counterfactual")
    unique = UniqueFrames(micro_store.scene)
    for query in queries:
        unique.add(query.target)
    wanted = len(unique.frames) + more
    cfg = replace(micro, retrieval=replace(micro.retrieval, counterfactual_source=wanted))
    assert len(counterfactual_database(cfg, queries, unique)) == wanted


def test_frames_without_motion_are_twins(benchmark_store) -> None:
    scene = benchmark_store.scene(benchmark_store.scene_ids("test")[0])
    first = {n: np.repeat(getattr(scene, n)[:1], scene.frames, axis=0) for n in scene.ARRAYS}
    still = replace(scene, **first)
    unique = UniqueFrames({"moving": scene, "still": still}.get)
    for frame in range(scene.frames):
        unique.add(FrameRef("still", frame))
    assert list(unique.frames) == [FrameRef("still", 0)]
    assert unique.left_out == scene.frames - 1
    # The moving scene has the same first frame.
    assert not unique.add(FrameRef("moving", 0))
    added = [f.frame for f in unique.fill(["moving"], 200, seed=0)]
    gaps = frame_displacements(scene)[np.ix_(added, added)]
    assert len(added) > 20
    assert gaps[~np.eye(len(added), dtype=bool)].min() > 0.9
