"""Databases of frames that retrieval ranks, without twins.

Twins are frames that look alike: the same objects are visible, and none of them has moved by a
pixel. The oracle decides this, so databases are built before any frame is rendered.

The future-state queries have one source of frames, of which the standard test's database is a part,
and the counterfactual queries have another (paper, Table 1 and "Query constructions").
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable, Iterator
from dataclasses import dataclass, field, replace
from itertools import islice

import numpy as np

from conf.schema import BenchmarkConfig
from data.records import POOLS, FrameRef, RetrievalQuery, Scene
from data.tracks.build_items import builder_name, cell_quotas
from data.tracks.quota import named_rng, round_robin
from data.world.displacement import on_screen_positions

TWIN_DISTANCE = 1.0
"""Frames are twins where no object's position differs by this much, px at 336 x 336."""
VISIBLE_FRACTIONS = (0.02, 0.08)
"""Minimum visible fractions of an object that counts as visible. Frames are twins if they agree
under either bound, so that a fraction near one bound does not make twins differ."""


@dataclass
class UniqueFrames:
    """Frames of which no two are twins, and the number of frames that were left out as twins."""

    scene_of: Callable[[str], Scene]
    frames: dict[FrameRef, None] = field(default_factory=dict)
    left_out: int = 0
    _positions: dict[tuple, list[np.ndarray]] = field(default_factory=lambda: defaultdict(list))

    def add(self, frame: FrameRef) -> bool:
        """Add a frame unless it or a twin of it is present, and return whether it was added."""
        if frame in self.frames:
            return False
        appearances = list(_appearances(self.scene_of(frame.scene_id), frame.frame))
        for objects, positions in appearances:
            others = self._positions[objects]
            if any(np.abs(other - positions).max(initial=0) < TWIN_DISTANCE for other in others):
                self.left_out += 1
                return False
        for objects, positions in appearances:
            self._positions[objects].append(positions)
        self.frames[frame] = None
        return True

    def fill(self, names: list[str], wanted: int, seed: int) -> list[FrameRef]:
        """Add `wanted` more frames of the scenes `names`, a random one of each scene in turn.

        Returns:
            The added frames; fewer where the scenes have no more.
        """

        def new_frames(name: str) -> Iterator[FrameRef]:
            order = named_rng(seed, "database", name).permutation(self.scene_of(name).frames)
            frames = (FrameRef(name, frame) for frame in reversed(order.tolist()))
            return (frame for frame in frames if self.add(frame))

        return list(islice(round_robin(map(new_frames, names)), max(wanted, 0)))


def _appearances(scene: Scene, frame: int) -> Iterable[tuple[tuple, np.ndarray]]:
    """The visible objects of a frame and their positions, by each of `VISIBLE_FRACTIONS`."""
    visible = scene.visible_fraction[frame]
    # NaN: the simulator's record has no visible fraction, only whether the object is in view.
    visible = np.where(np.isnan(visible), 1.0, visible) * scene.in_view[frame]
    positions = on_screen_positions(scene)[0][frame]
    order = sorted(range(len(scene.objects)), key=lambda k: str(scene.objects[k]))
    for bound in VISIBLE_FRACTIONS:
        present = [k for k in order if visible[k] >= bound]
        yield tuple(scene.objects[k] for k in present), positions[present]


def make_databases(
    cfg: BenchmarkConfig,
    queries: list[RetrievalQuery],
    scene_ids: dict[str, list[str]],
    scene_of: Callable[[str], Scene],
) -> tuple[list[RetrievalQuery], dict[str, list[FrameRef]], dict[str, int]]:
    """Choose the frames of every database.

    Returns:
        The queries whose target has no twin in its database, with the standard test marked; frames
        by database; and counts of the queries and frames that were left out.
    """
    unique, kept, twins = {}, {}, {}
    for pool in POOLS:
        unique[pool] = UniqueFrames(scene_of)
        kept[pool] = drop_twins(cfg, [q for q in queries if q.pool == pool], unique[pool])
        twins[pool] = unique[pool].left_out
    kept["future"] = mark_standard(kept["future"], cfg.retrieval.standard)
    test, source = future_databases(cfg, kept["future"], scene_ids, unique["future"])
    absent = counterfactual_database(cfg, kept["counterfactual"], unique["counterfactual"])
    counts = {
        "queries dropped, target has a twin": sum(twins.values()),
        "frames left out, twins": sum(unique[p].left_out - twins[p] for p in POOLS),
    }
    databases = {"test": test, "future": source, "counterfactual": absent}
    return [*kept["future"], *kept["counterfactual"]], databases, counts


def future_databases(
    cfg: BenchmarkConfig,
    queries: list[RetrievalQuery],
    scene_ids: dict[str, list[str]],
    unique: UniqueFrames,
) -> tuple[list[FrameRef], list[FrameRef]]:
    """The standard test's database, of test scenes only, and the future-state queries' source,
    which contains it."""
    if not queries:
        return [], []
    track = cfg.retrieval
    targets = dict.fromkeys(q.target for q in queries if q.standard)
    test = [*targets, *unique.fill(scene_ids["test"], track.database - len(targets), cfg.seed)]
    source = [*test, *(f for f in dict.fromkeys(q.target for q in queries) if f not in targets)]
    every = [*scene_ids["train"], *scene_ids["test"]]
    return test, [*source, *unique.fill(every, track.source - len(source), cfg.seed)]


def counterfactual_database(
    cfg: BenchmarkConfig, queries: list[RetrievalQuery], unique: UniqueFrames
) -> list[FrameRef]:
    """The source of the counterfactual queries.

    It holds their targets, then their hard negatives (the factual frame of each query first), then
    other frames of the counterfactual scenes. Test queries come before training queries, because
    only they are ranked against this source.
    """
    wanted = cfg.retrieval.counterfactual_source
    ranked = sorted(queries, key=lambda q: q.split != "test")
    for of_rank in zip(*(q.hard_negatives for q in ranked), strict=True):
        for frame in of_rank:
            if len(unique.frames) < wanted:
                unique.add(frame)
    absent = sorted({q.target.scene_id for q in queries})
    unique.fill(absent, wanted - len(unique.frames), cfg.seed)
    return list(unique.frames)


def drop_twins(
    cfg: BenchmarkConfig, queries: list[RetrievalQuery], unique: UniqueFrames
) -> list[RetrievalQuery]:
    """Queries up to their quotas whose target is not a twin of another target, because both frames
    would be right answers. The test split has precedence."""
    quotas, kept, chosen = cell_quotas(cfg), Counter(), set()
    for query in sorted(queries, key=lambda q: q.split != "test"):
        cell = builder_name(query.builder), query.split
        is_full = kept[cell] >= getattr(quotas[cell[0]], query.split)
        if not is_full and (query.target in unique.frames or unique.add(query.target)):
            kept[cell] += 1
            chosen.add(query.query_id)
    return [q for q in queries if q.query_id in chosen]


def mark_standard(queries: list[RetrievalQuery], total: int) -> list[RetrievalQuery]:
    """Mark `total` test queries as the standard test: the first ones of each builder, with equal
    counts."""
    builders = sorted({q.builder for q in queries if q.split == "test"})
    standard: set[str] = set()
    for k, builder in enumerate(builders):
        count = total * (k + 1) // len(builders) - total * k // len(builders)
        own = [q.query_id for q in queries if q.split == "test" and q.builder == builder]
        standard.update(own[:count])
    return [replace(query, standard=query.query_id in standard) for query in queries]
