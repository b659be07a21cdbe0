"""Databases of frames that retrievers rank, without near-duplicates.

Near-duplicates are frames in which the same objects are visible within a pixel of each other. They
are found from the oracle, before any frame is rendered.

The database of the future-state queries contains that of the standard test; the counterfactual
queries have another one (paper, Table 1 and "Query constructions").
"""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from itertools import chain, islice, product

import numpy as np

from dynapix.conf.schema import BenchmarkConfig
from dynapix.conf.schema.benchmark import POOLS
from dynapix.data.items.cells import builder_name, split_quotas
from dynapix.data.oracle.displacement import visible_positions
from dynapix.data.records import FrameRef, RetrievalQuery, Scene
from dynapix.data.seeded_order import named_rng, round_robin

DUPLICATE_DISTANCE = 1.0
"""Near-duplicates differ by less than this in all coordinates of objects, px at 336 x 336."""
VISIBLE_FRACTIONS = (0.02, 0.08)
"""Least visible fractions of a visible object. The visible objects of a frame are listed for both,
and two frames are near-duplicates if they have a list in common, so that a fraction close to one of
the bounds makes no difference."""


@dataclass
class UniqueFrames:
    """A set of frames without near-duplicates. `left_out` counts the near-duplicates not added."""

    scene_of: Callable[[str], Scene]
    frames: dict[FrameRef, None] = field(default_factory=dict)
    left_out: int = 0
    _positions: dict[tuple, list[np.ndarray]] = field(default_factory=lambda: defaultdict(list))

    def add(self, frame: FrameRef) -> bool:
        """Add a frame unless it or a near-duplicate is in the set; return whether it was added."""
        if frame in self.frames:
            return False
        visible = _list_visible(self.scene_of(frame.scene_id), frame.frame)
        for objects, positions in visible:
            x, y = _first_place(positions)
            near = product((x - 1, x, x + 1), (y - 1, y, y + 1))
            others = chain.from_iterable(
                self._positions.get((objects, place), ()) for place in near
            )
            steps = (np.abs(other - positions) for other in others)
            if any(step.max(initial=0) < DUPLICATE_DISTANCE for step in steps):
                self.left_out += 1
                return False
        for objects, positions in visible:
            self._positions[objects, _first_place(positions)].append(positions)
        self.frames[frame] = None
        return True

    def fill(self, names: list[str], wanted: int, seed: int) -> list[FrameRef]:
        """Add and return `wanted` frames of the scenes `names`, a random frame of each scene in
        turn; fewer if the scenes have no more."""

        def new_frames(name: str) -> Iterator[FrameRef]:
            order = named_rng(seed, "database", name).permutation(self.scene_of(name).frames)
            frames = (FrameRef(name, frame) for frame in reversed(order.tolist()))
            return (frame for frame in frames if self.add(frame))

        return list(islice(round_robin(map(new_frames, names)), max(wanted, 0)))


def _first_place(positions: np.ndarray) -> tuple[int, int]:
    """Return the first object's position in units of `DUPLICATE_DISTANCE`, rounded down. In
    near-duplicates, these differ by at most 1."""
    return tuple(int(x // DUPLICATE_DISTANCE) for x in positions[0]) if len(positions) else (0, 0)


def _list_visible(scene: Scene, frame: int) -> list[tuple[tuple, np.ndarray]]:
    """Return the visible objects of a frame and their positions (K, 2), px at 336 x 336, for each
    of `VISIBLE_FRACTIONS`. Appearances alone determine the order of the objects."""
    # NaN means that the simulator records only whether the object is in view.
    fraction = np.nan_to_num(scene.visible_fraction[frame], nan=1.0) * scene.in_view[frame]
    order = sorted(range(len(scene.objects)), key=lambda k: str(scene.objects[k]))
    lists = [[k for k in order if fraction[k] >= least] for least in VISIBLE_FRACTIONS]
    positions = visible_positions(scene)[0][frame]
    return [(tuple(scene.objects[k] for k in each), positions[each]) for each in lists]


def make_databases(
    cfg: BenchmarkConfig,
    queries: list[RetrievalQuery],
    scene_ids: dict[str, list[str]],
    scene_of: Callable[[str], Scene],
) -> tuple[list[RetrievalQuery], dict[str, list[FrameRef]], dict[str, int]]:
    """Choose the frames of every database.

    Returns:
        The queries whose target has no near-duplicate in its database; frames by database; and
        counts of the queries and frames that were left out.
    """
    unique = {pool: UniqueFrames(scene_of) for pool in POOLS}
    kept = {pool: choose_queries(cfg, queries, pool, unique[pool]) for pool in POOLS}
    dropped = sum(frames.left_out for frames in unique.values())
    test, future = future_databases(cfg, kept["future"], scene_ids, unique["future"])
    counterfactual = counterfactual_database(cfg, kept["counterfactual"], unique["counterfactual"])
    left_out = sum(frames.left_out for frames in unique.values())
    counts = {
        "queries dropped, target has a near-duplicate": dropped,
        "frames left out, near-duplicates": left_out - dropped,
    }
    databases = {"test": test, "future": future, "counterfactual": counterfactual}
    return [*kept["future"], *kept["counterfactual"]], databases, counts


def choose_queries(
    cfg: BenchmarkConfig, queries: list[RetrievalQuery], pool: str, unique: UniqueFrames
) -> list[RetrievalQuery]:
    """Return the queries of a pool up to their quotas, test queries first, and add their targets to
    `unique`. A query whose target is a near-duplicate of another query's target is left out: both
    frames would be right answers."""
    room, chosen = split_quotas(cfg), set()
    own = [q for q in queries if q.pool == pool]
    for query in sorted(own, key=lambda q: q.split != "test"):
        cell = f"{builder_name(query.builder)}/{query.split}"
        if room[cell] and (query.target in unique.frames or unique.add(query.target)):
            room[cell] -= 1
            chosen.add(query.query_id)
    return [q for q in own if q.query_id in chosen]


def future_databases(
    cfg: BenchmarkConfig,
    queries: list[RetrievalQuery],
    scene_ids: dict[str, list[str]],
    unique: UniqueFrames,
) -> tuple[list[FrameRef], list[FrameRef]]:
    """Return the database of the standard test, which has frames of test scenes only, and the
    database of all future-state queries, which contains it."""
    if not queries:
        return [], []
    track = cfg.retrieval
    targets = dict.fromkeys(q.target for q in queries if q.split == "test")
    test = [*targets, *unique.fill(scene_ids["test"], track.database - len(targets), cfg.seed)]
    source = [*test, *(f for f in dict.fromkeys(q.target for q in queries) if f not in targets)]
    every = [*scene_ids["train"], *scene_ids["test"]]
    return test, [*source, *unique.fill(every, track.source - len(source), cfg.seed)]


def counterfactual_database(
    cfg: BenchmarkConfig, queries: list[RetrievalQuery], unique: UniqueFrames
) -> list[FrameRef]:
    """Return the database of the counterfactual queries: their targets, then their hard negatives
    (the factual frames of all queries first), then other frames of the counterfactual scenes. Test
    queries come before training queries, because only test queries are evaluated on it."""
    wanted = cfg.retrieval.counterfactual_source
    ranked = sorted(queries, key=lambda q: q.split != "test")
    for frame in chain.from_iterable(zip(*(q.hard_negatives for q in ranked), strict=True)):
        if len(unique.frames) < wanted:
            unique.add(frame)
    scenes = sorted({q.target.scene_id for q in queries})
    unique.fill(scenes, wanted - len(unique.frames), cfg.seed)
    return list(unique.frames)
