"""Renders frames of a built benchmark into the store's cache."""

from __future__ import annotations

import json
import logging
from collections import defaultdict
from collections.abc import Mapping
from contextlib import closing
from functools import partial
from pathlib import Path
from typing import Any

from conf.files import read_json, write_bytes
from conf.runs import LOCK, lock_file
from data.frames.frame_cache import frames_path, load_frames, render_frames, save_frames
from data.parallel import Workers
from data.records import MATCHED_ANCHOR, POOLS, original_scene_id, sample_prefix_frames
from data.store import DATABASES, FRAMES_FOLDER, Store, load_scene, scene_path

log = logging.getLogger(__name__)

FRAMES_RECORD = "frames.json"
"""File with the options and results of the last prerendering, which is not repeated."""


def prerender_frames(store: Store, which: str, limit_gb: float | None, workers: Workers) -> None:
    """Render a store's missing frames to its cache.

    Args:
        which: `all`, or `named` for those that items, queries and databases refer to.
        limit_gb: Maximum total size of these frames on disk. Rendering stops when the next scene
            would exceed it. The archives of the remaining scenes are deleted, and their frames are
            rendered on demand.
    """
    options = {"frames": which, "frames_gb": limit_gb, "renderer": store.manifest["renderer"]}
    record = store.folder / FRAMES_FOLDER / FRAMES_RECORD

    def is_done() -> bool:
        return record.exists() and options.items() <= read_json(record).items()

    # Several jobs may have waited for the build of one benchmark.
    busy = f"another process renders the frames of {store.folder}"
    if not is_done():
        with lock_file(record.with_name(LOCK), busy, wait=True):
            if not is_done():
                summary = _render_scenes(store, which, limit_gb, workers)
                write_bytes(record, json.dumps(options | summary, indent=1).encode())


def _render_scenes(
    store: Store, which: str, limit_gb: float | None, workers: Workers
) -> dict[str, float]:
    """Render missing frames, and return the number of scenes and bytes that are on disk."""
    config = store.manifest["config"]
    jobs = {
        scene: partial(_render_scene, store.folder, config, scene, frames)
        for scene, frames in frames_to_render(store, which).items()
    }
    total, kept = 0.0, set()
    # Closing the results stops the workers, which could write further archives.
    with closing(workers.run(jobs, "rendering scenes", "scene")) as results:
        for scene, size in results:
            if limit_gb is not None and total + size > limit_gb * 1e9:
                break
            total += size
            kept.add(scene)
    if others := jobs.keys() - kept:
        for scene in others:
            frames_path(store.folder, scene).unlink(missing_ok=True)
        log.info(
            "frames_gb=%g: the frames of %d of %d scenes are on disk; the others are rendered on "
            "demand", limit_gb, len(kept), len(jobs),
        )  # fmt: skip
    return {"scenes": len(kept), "bytes": total}


def frames_to_render(store: Store, which: str) -> dict[str, list[int]]:
    """Return the frames to render by scene, with the scenes of the test split first."""
    frames: dict[str, set[int]] = defaultdict(set)
    count = store.manifest["config"]["prefix_frames"]
    items = [*store.selection(), *store.selection(suite=MATCHED_ANCHOR)]
    queries = [q for pool in POOLS for q in store.retrieval(pool=pool)]
    for record in (*items, *queries):
        prefix = sample_prefix_frames(record.prefix_start, record.prefix_stop, count)
        frames[record.scene_id].update(prefix)
    for frame in (
        *(c for i in items for c in i.candidates),
        *(f for q in queries for f in (q.target, *q.hard_negatives)),
        *(f for name in DATABASES for f in store.database(name)),
    ):
        frames[frame.scene_id].add(frame.frame)
    if which == "all":
        for scene in (*store.scene_ids("test"), *store.scene_ids("train")):
            frames[scene].update(range(store.scene(scene).frames))
    test = set(store.scene_ids("test"))
    order = sorted(frames, key=lambda scene: (original_scene_id(scene) not in test, scene))
    return {scene: sorted(frames[scene]) for scene in order}


def _render_scene(folder: Path, config: Mapping[str, Any], scene_id: str, frames: list[int]) -> int:
    """Add missing frames to a scene's archive, and return the size of the archive in bytes."""
    path = frames_path(folder, scene_id)
    pixels = load_frames(path)
    if missing := [f for f in frames if f not in pixels]:
        scene = load_scene(scene_path(folder, scene_id))
        save_frames(pixels | render_frames(scene, missing, config), path)
    return path.stat().st_size
