"""The frames that retrieval ranks, no two of them alike.

Which frames look alike is told by the oracle: the same objects show, and none of them has moved by
a pixel. So databases are chosen before a single frame is rendered.

The future-state queries of all scenes have a source of frames, from which the standard test's
database is drawn; the counterfactual queries have a source of their own (paper, Table 1 and
"Query constructions").
"""

from __future__ import annotations

from collections import Counter, defaultdict
from collections.abc import Callable, Iterable
from dataclasses import dataclass, field, replace

import numpy as np

from conf.schema import BenchmarkConfig
from data.records import POOLS, FrameRef, RetrievalQuery, Scene
from data.tracks.selection.distractors import cell_rng
from data.world.displacement import on_screen_positions

TWIN_DISTANCE = 1.0
"""Frames in which every object is within this of its place in the other, px at 336 x 336, are
twins."""
SHOWING = (0.02, 0.08)
"""An object shows where at least such a share of it is visible. Two bounds, so that one that lies
at either of them makes no twins differ."""


@dataclass
class UniqueFrames:
    """Frames no two of which are twins, and how many were left out as twins of one in it."""

    scene_of: Callable[[str], Scene]
    frames: dict[FrameRef, None] = field(default_factory=dict)
    left_out: int = 0
    _seen: dict[tuple, list[np.ndarray]] = field(default_factory=lambda: defaultdict(list))

    def add(self, frame: FrameRef) -> bool:
        """Take a frame in, unless it or a twin of it is there; whether it is new."""
        if frame in self.frames:
            return False
        looks = list(_appearances(self.scene_of(frame.scene_id), frame.frame))
        for shown, places in looks:
            if any(
                np.abs(other - places).max(initial=0) < TWIN_DISTANCE for other in self._seen[shown]
            ):
                self.left_out += 1
                return False
        for shown, places in looks:
            self._seen[shown].append(places)
        self.frames[frame] = None
        return True

    def fill(self, names: list[str], wanted: int, seed: int) -> list[FrameRef]:
        """Take in `wanted` more frames of the scenes `names`, or as many as they have: a random one
        of each scene in turn."""
        taken: list[FrameRef] = []
        waiting = {
            name: cell_rng(seed, "database", name).permutation(self.scene_of(name).frames).tolist()
            for name in names
        }
        while waiting and len(taken) < wanted:
            for name in list(waiting):
                if len(taken) == wanted:
                    break
                while waiting[name]:
                    frame = FrameRef(name, waiting[name].pop())
                    if self.add(frame):
                        taken.append(frame)
                        break
                else:
                    del waiting[name]
        return taken


def _appearances(scene: Scene, frame: int) -> Iterable[tuple[tuple, np.ndarray]]:
    """Which objects show in a frame, by each bound of `SHOWING`, and where."""
    visible = scene.visible_fraction[frame]
    # Where a record does not tell how much of an object is visible, being in view has to do.
    visible = np.where(np.isnan(visible), 1.0, visible) * scene.in_view[frame]
    places = on_screen_positions(scene)[0][frame]
    order = sorted(range(len(scene.objects)), key=lambda k: str(scene.objects[k]))
    for bound in SHOWING:
        shown = [k for k in order if visible[k] >= bound]
        yield tuple(scene.objects[k] for k in shown), places[shown]


def make_databases(
    cfg: BenchmarkConfig,
    queries: list[RetrievalQuery],
    scene_ids: dict[str, list[str]],
    scene_of: Callable[[str], Scene],
) -> tuple[list[RetrievalQuery], dict[str, list[FrameRef]], dict[str, int]]:
    """The frames of every database, and counts of what was left out of them.

    Returns:
        The queries whose target is in its database under its own name, those of the standard test
        marked; frames by database; counts.
    """
    albums = {pool: UniqueFrames(scene_of) for pool in POOLS}
    kept = {
        pool: with_target(cfg, [q for q in queries if q.pool == pool], albums[pool])
        for pool in POOLS
    }
    dropped = sum(album.left_out for album in albums.values())
    kept["future"] = mark_standard(kept["future"], cfg.retrieval.standard)
    test, source = future_databases(cfg, kept["future"], scene_ids, albums["future"])
    absent = counterfactual_database(cfg, kept["counterfactual"], albums["counterfactual"])
    counts = {
        "queries dropped, target has a twin": dropped,
        "frames left out, twins": sum(album.left_out for album in albums.values()) - dropped,
    }
    return (
        [*kept["future"], *kept["counterfactual"]],
        {"test": test, "future": source, "counterfactual": absent},
        counts,
    )


def future_databases(
    cfg: BenchmarkConfig,
    queries: list[RetrievalQuery],
    scene_ids: dict[str, list[str]],
    album: UniqueFrames,
) -> tuple[list[FrameRef], list[FrameRef]]:
    """The standard test's database, of test scenes alone, and the source of all future-state
    queries, of which it is a part."""
    if not queries:
        return [], []
    track = cfg.retrieval
    asked = dict.fromkeys(q.target for q in queries if q.standard)
    test = [*asked, *album.fill(scene_ids["test"], track.database - len(asked), cfg.seed)]
    source = [*test, *(f for f in dict.fromkeys(q.target for q in queries) if f not in asked)]
    every = [*scene_ids["train"], *scene_ids["test"]]
    return test, [*source, *album.fill(every, track.source - len(source), cfg.seed)]


def counterfactual_database(
    cfg: BenchmarkConfig, queries: list[RetrievalQuery], album: UniqueFrames
) -> list[FrameRef]:
    """The source of the counterfactual queries: their targets, then their hard negatives, of each
    query first what happened instead, then other frames of the scenes without the object. The test
    queries' come before the training queries', for those alone are ranked among them."""
    wanted = cfg.retrieval.counterfactual_source
    ranked = sorted(queries, key=lambda q: q.split != "test")
    for of_rank in zip(*(q.hard_negatives for q in ranked), strict=True):
        for frame in of_rank:
            if len(album.frames) < wanted:
                album.add(frame)
    absent = sorted({q.target.scene_id for q in queries})
    album.fill(absent, wanted - len(album.frames), cfg.seed)
    return list(album.frames)


def with_target(
    cfg: BenchmarkConfig, queries: list[RetrievalQuery], album: UniqueFrames
) -> list[RetrievalQuery]:
    """Queries up to their quotas whose target is no twin of another's, of which those of the test
    split come first: of two frames that look alike both would be right."""
    kept: Counter[tuple[int | None, str]] = Counter()
    chosen = set()
    for query in sorted(queries, key=lambda q: q.split != "test"):
        quota = cfg.retrieval.counterfactual
        if query.builder is not None:
            quota = cfg.retrieval.builders[str(query.builder)]
        full = kept[query.builder, query.split] >= getattr(quota, query.split)
        if not full and (query.target in album.frames or album.add(query.target)):
            kept[query.builder, query.split] += 1
            chosen.add(query.query_id)
    return [q for q in queries if q.query_id in chosen]


def mark_standard(queries: list[RetrievalQuery], total: int) -> list[RetrievalQuery]:
    """The queries, `total` of the test split's marked as the standard test: as many of each builder
    as of any other, the first ones."""
    builders = sorted({q.builder for q in queries if q.split == "test"})
    left = {
        builder: total * (k + 1) // len(builders) - total * k // len(builders)
        for k, builder in enumerate(builders)
    }
    marked = []
    for query in queries:
        standard = query.split == "test" and left[query.builder] > 0
        if standard:
            left[query.builder] -= 1
        marked.append(replace(query, standard=standard))
    return marked
