"""Renders frames of a built benchmark into the store's cache."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Mapping
from functools import partial
from pathlib import Path
from typing import Any

from dynapix.conf.files import read_json, write_json
from dynapix.conf.runs import LOCK, lock_file
from dynapix.conf.schema.benchmark import PAIRED, POOLS
from dynapix.data.frames.frame_cache import frames_path, load_frames, render_frames, save_frames
from dynapix.data.parallel import Workers
from dynapix.data.records import original_scene_id, sample_prefix_frames
from dynapix.data.store import DATABASES, FRAMES_FOLDER, Store, load_scene, scene_path

FRAMES_RECORD = "frames.json"
"""File with the options and results of the last prerendering, which is not repeated."""


def prerender_frames(store: Store, which: str, workers: Workers) -> None:
    """Render a store's missing frames to its cache: `all`, or those `named` by items, queries and
    databases."""
    options = {"frames": which, "renderer": store.manifest["renderer"]}
    record = store.folder / FRAMES_FOLDER / FRAMES_RECORD

    def is_done() -> bool:
        return record.exists() and options.items() <= read_json(record).items()

    # Several jobs may have waited for the build of one benchmark.
    busy = f"another process renders the frames of {store.folder}"
    if not is_done():
        with lock_file(record.with_name(LOCK), busy, wait=True):
            if not is_done():
                summary = _render_scenes(store, which, workers)
                write_json(record, options | summary)


def _render_scenes(store: Store, which: str, workers: Workers) -> dict[str, int]:
    """Render missing frames, and return the number of scenes and bytes that are on disk."""
    config = store.manifest["config"]
    jobs = {
        scene: partial(_render_scene, store.folder, config, scene, frames)
        for scene, frames in frames_to_render(store, which).items()
    }
    sizes = [size for _, size in workers.run(jobs, "rendering scenes", "scene")]
    return {"scenes": len(sizes), "bytes": sum(sizes)}


def frames_to_render(store: Store, which: str) -> dict[str, list[int]]:
    """Return the frames to render by scene, with the scenes of the test split first."""
    frames: dict[str, set[int]] = defaultdict(set)
    count = store.manifest["config"]["prefix_frames"]
    items = [i for suite in (None, *PAIRED) for i in store.selection(suite=suite)]
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
