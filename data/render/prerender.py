"""Renders frames of a built benchmark ahead, into the store's cache."""

from __future__ import annotations

import hashlib
import json
import logging
from collections import defaultdict
from functools import partial
from typing import Any

from data.parallel import Workers
from data.records import FrameRef, sample_prefix_frames
from data.render import check_renderer
from data.render.frame_cache import FrameCache, load_frames, save_frames
from data.store import DATABASES, Store, write_atomically
from data.tracks.controls import MATCHED_ANCHOR

log = logging.getLogger(__name__)

RECORD = "frames.json"
GB = 1e9


def prerender_frames(store: Store, which: str, bound_gb: float | None, workers: Workers) -> None:
    """Render the frames that are not there yet: all, or those named by items, queries and
    databases, until they take `bound_gb` of disk space. What is left is drawn when it is asked for.
    """
    asked = {"frames": which, "bound_gb": bound_gb, "renderer": store.manifest["renderer"]}
    path = store.folder / "frames" / RECORD
    if path.exists() and asked.items() <= json.loads(path.read_text()).items():
        return
    config = store.manifest["config"]
    if which != "none" and config["simulator"] == "bullet":
        check_renderer(config["renderer"])
    wanted = frames_to_render(store, which)
    databases = {name: set(store.database(name)) for name in DATABASES}
    ranked = set().union(*databases.values())
    cache = FrameCache.of(store)
    jobs = {
        scene: partial(
            _render_scene, cache, scene, frames, [f for f in frames if FrameRef(scene, f) in ranked]
        )
        for scene, frames in wanted.items()
    }
    taken, rendered, hashes = 0.0, 0, {}
    for scene, (size, pixels) in workers.run(jobs, "rendering scenes", "scene"):
        if bound_gb is not None and taken + size > bound_gb * GB:
            cache.path(scene).unlink()
            log.info(
                "frames_gb=%g holds the frames of %d of %d scenes; the others are drawn when they "
                "are asked for", bound_gb, rendered, len(jobs),
            )  # fmt: skip
            break
        taken, rendered = taken + size, rendered + 1
        hashes |= {FrameRef(scene, frame): digest for frame, digest in pixels.items()}
    record = {**asked, "scenes": rendered, "bytes": taken, **_twins(databases, hashes)}
    write_atomically(path, json.dumps(record, indent=1).encode())


def frames_to_render(store: Store, which: str) -> dict[str, list[int]]:
    """Frames by scene, the test split's scenes first."""
    if which == "none":
        return {}
    named = referenced_frames(store)
    if which == "all":
        named |= {
            scene: set(range(store.scene(scene).frames))
            for split in ("test", "train")
            for scene in store.scene_ids(split)
        }
    test = set(store.scene_ids("test"))
    order = sorted(named, key=lambda scene: (scene.split("-without-")[0] not in test, scene))
    return {scene: sorted(named[scene]) for scene in order}


def referenced_frames(store: Store) -> dict[str, set[int]]:
    """The frames of each scene that items, queries and databases name."""
    named: dict[str, set[int]] = defaultdict(set)
    count = store.manifest["config"]["prefix_frames"]
    items = [*store.selection(), *store.selection(suite=MATCHED_ANCHOR)]
    queries = [q for pool in ("future", "counterfactual") for q in store.retrieval(pool=pool)]
    for asked in (*items, *queries):
        shown = sample_prefix_frames(asked.prefix_start, asked.prefix_stop, count)
        named[asked.scene_id].update(shown)
    for frame in (
        *(c for i in items for c in i.candidates),
        *(f for q in queries for f in (q.target, *q.hard_negatives)),
        *(f for name in DATABASES for f in store.database(name)),
    ):
        named[frame.scene_id].add(frame.frame)
    return named


def _render_scene(
    cache: FrameCache, scene_id: str, frames: list[int], ranked: list[int]
) -> tuple[int, dict[int, str]]:
    """Render what an archive lacks; its size in bytes, and a hash of the pixels of each frame that
    a database holds."""
    path = cache.path(scene_id)
    there = load_frames(path)
    missing = cache.draw(scene_id, [f for f in frames if f not in there])
    if missing:
        save_frames(there | missing, path)
    pixels = there | missing
    hashes = {f: hashlib.sha256(pixels[f].tobytes()).hexdigest() for f in ranked}
    return path.stat().st_size, hashes


def _twins(databases: dict[str, set[FrameRef]], hashes: dict[FrameRef, str]) -> dict[str, Any]:
    """How many frames of a database are alike to the pixel, which the oracle should have told."""
    twins = 0
    for name, frames in databases.items():
        seen = [hashes[f] for f in frames if f in hashes]
        if more := len(seen) - len(set(seen)):
            log.warning("%d frames of database %s are alike to the pixel", more, name)
        twins += more
    return {"pixel_twins": twins}
