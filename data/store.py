"""A benchmark on disk.

    store/<name>/
        manifest.json        what it is: config, versions, counts, a SHA-256 for every file of it
        scenes/<id>.npz      one scene's oracle; <id>-without-<k> is it with object k absent
        selection.parquet retrieval.parquet database.parquet
        frames/<id>.zip      a cache of that scene's rendered frames, not part of the manifest
        embeddings/          a cache of what retrievers make of frames and queries, not part of it
        rationales.jsonl     every answer of teachers, not part of the manifest
        rationales.parquet   the accepted ones of the last narration, not part of it either

A store is written in a folder beside it and renamed when it is whole, every part atomically, so
that a killed build goes on with the parts it has. Frames follow from the oracle and the renderer,
so they can be rendered later, or deleted.
"""

from __future__ import annotations

import hashlib
import io
import json
import os
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from typing import Any

import numpy as np

from conf.errors import UserError
from data import render
from data.records import (
    Collision,
    FrameRef,
    Landing,
    RetrievalQuery,
    Scene,
    SceneObject,
    SelectionItem,
)
from data.tracks.selection.distractors import BUILDERS_VERSION
from data.world.standins import generator_version

MANIFEST = "manifest.json"
CHECKSUM_KEY = "sha256"
PLAN = "plan.json"
"""What a build in progress is to become; gone from a whole store."""


def component_versions(simulator: str, renderer: str, standin: str | None) -> dict[str, str]:
    """What makes the same config give another benchmark: scenes, pixels, items and queries."""
    rendered = simulator == "bullet"
    return {
        "generator": generator_version(standin),
        "renderer": render.renderer_version(renderer) if rendered else f"{simulator}'s own frames",
        "builders": BUILDERS_VERSION,
    }


DATABASES = ("test", "future", "counterfactual")
"""Frames that retrieval ranks: the standard test's, drawn out of the source of the future-state
queries, and the source of the counterfactual ones."""
SCENES, FRAMES = "scenes", "frames"
PARTS = "parts"
"""Folder of what a build in progress has done; gone from a whole store."""


def write_atomically(path: Path, content: bytes) -> None:
    """Write a file whole or not at all."""
    path.parent.mkdir(parents=True, exist_ok=True)
    partial = path.with_name(f".{path.name}.{os.getpid()}.partial")
    try:
        with open(partial, "wb") as file:
            file.write(content)
            file.flush()
            os.fsync(file.fileno())
        os.replace(partial, path)
    except OSError as error:
        partial.unlink(missing_ok=True)
        # A full disk names no file of itself.
        raise OSError(error.errno, error.strerror, str(path)) from error


def scene_path(folder: Path, scene_id: str) -> Path:
    """Where a scene's oracle is in a store, whole or growing."""
    return folder / SCENES / f"{scene_id}.npz"


def save_scene(scene: Scene, path: Path) -> None:
    header = {
        "scene_id": scene.scene_id,
        "split": scene.split,
        "objects": [vars(o) for o in scene.objects],
        "collisions": [{"frame": c.frame, "objects": c.objects} for c in scene.collisions],
        "image_size": scene.image_size,
        "fps": scene.fps,
        "landings": [vars(landing) for landing in scene.landings],
        "scenario": scene.scenario,
        "footage": scene.footage,
    }
    arrays = {name: getattr(scene, name) for name in Scene.ARRAYS}
    buffer = io.BytesIO()
    np.savez(buffer, header=np.array(json.dumps(header)), **arrays)
    write_atomically(path, buffer.getvalue())


def load_scene(path: Path) -> Scene:
    with np.load(path) as file:
        header = json.loads(str(file["header"]))
        return Scene(
            scene_id=header["scene_id"],
            split=header["split"],
            objects=tuple(SceneObject(**o) for o in header["objects"]),
            collisions=tuple(
                Collision(c["frame"], tuple(c["objects"])) for c in header["collisions"]
            ),
            image_size=tuple(header["image_size"]),
            fps=header["fps"],
            landings=tuple(Landing(**landing) for landing in header["landings"]),
            scenario=header["scenario"],
            footage=header["footage"],
            **{name: file[name] for name in Scene.ARRAYS},
        )


def save_rows(rows: list[dict[str, Any]], path: Path) -> None:
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows), sink, compression="zstd")
    write_atomically(path, sink.getvalue())


def load_rows(path: Path) -> list[dict[str, Any]]:
    import pyarrow.parquet as pq

    # Not read_table, which imports pandas first.
    return pq.ParquetFile(path).read().to_pylist()


def hash_file(path: Path) -> str:
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_files(folder: Path) -> dict[str, str]:
    """SHA-256 of every file that makes a store, by relative path."""
    paths = [*(folder / SCENES).glob("*.npz"), *folder.glob("*.parquet")]
    names = sorted(p.relative_to(folder).as_posix() for p in paths)
    with ThreadPoolExecutor(4) as pool:
        found = pool.map(lambda name: hash_file(folder / name), names)
        return dict(zip(names, found, strict=True))


def add_checksum(manifest: dict[str, Any]) -> dict[str, Any]:
    """A manifest with the SHA-256 of its own content."""
    content = {key: value for key, value in manifest.items() if key != CHECKSUM_KEY}
    return content | {CHECKSUM_KEY: hashlib.sha256(json.dumps(content).encode()).hexdigest()}


@dataclass(frozen=True)
class Store:
    """A built and verified benchmark."""

    folder: Path
    manifest: dict[str, Any]

    @property
    def name(self) -> str:
        return self.folder.name

    @property
    def identity(self) -> str:
        """A short hash of everything in the benchmark, and of what its frames look like."""
        config = self.manifest["config"]
        frames = [self.manifest["renderer"], config["width"], config["height"]]
        content = json.dumps([self.manifest["files"], *frames])
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def scene_ids(self, split: str) -> list[str]:
        return self.manifest["scenes"][split]

    def scene(self, scene_id: str) -> Scene:
        return cached_scene(scene_path(self.folder, scene_id))

    @property
    def suite(self) -> str:
        """The suite of the benchmark's own items."""
        return self.manifest["suite"]

    def selection(self, split: str | None = None, suite: str | None = None) -> list[SelectionItem]:
        """Items of a suite, by default the benchmark's own."""
        rows = load_rows(self.folder / "selection.parquet")
        asked = suite or self.suite
        kept = (r for r in rows if split in (None, r["split"]) and r["suite"] == asked)
        return [SelectionItem.from_row(r) for r in kept]

    def retrieval(self, split: str | None = None, pool: str = "future") -> list[RetrievalQuery]:
        """Queries of a pool, future or counterfactual."""
        rows = load_rows(self.folder / "retrieval.parquet")
        kept = (r for r in rows if split in (None, r["split"]) and r["pool"] == pool)
        return [RetrievalQuery.from_row(r) for r in kept]

    def standard_test(self) -> list[RetrievalQuery]:
        """The queries that retrieval is measured on, over the database `test`."""
        return [q for q in self.retrieval("test") if q.standard]

    def database(self, name: str = "test") -> list[FrameRef]:
        """Frames of one of `DATABASES`."""
        rows = load_rows(self.folder / "database.parquet")
        return [FrameRef(r["scene_id"], r["frame"]) for r in rows if r["database"] == name]


@lru_cache(maxsize=512)
def cached_scene(path: Path) -> Scene:
    return load_scene(path)


def open_store(folder: Path) -> Store:
    """Open a built benchmark and verify every part of it.

    Raises:
        UserError: there is none, another generator made it, or a part is missing or damaged.
    """
    path = folder / MANIFEST
    rebuild = f"delete {folder} and build it again with python -m data.build"
    if not path.exists():
        raise UserError(f"{folder} holds no benchmark: {MANIFEST} is missing; {rebuild}")
    try:
        manifest = json.loads(path.read_text())
        config = manifest.get("config", {})
        current = component_versions(
            config.get("simulator", "bullet"),
            config.get("renderer", "bullet"),
            config.get("standin"),
        )
        built = {key: manifest.get(key) for key in current}
    except (ValueError, AttributeError) as error:
        raise UserError(f"{path} is damaged and cannot be read; {rebuild}") from error
    for key, version in current.items():
        if built[key] != version:
            raise UserError(
                f"{folder} was built by {key} version {built[key]}, this is version {version}; "
                f"{rebuild}"
            )
    if manifest != add_checksum(manifest):
        raise UserError(f"{path} is damaged (it was changed after the build); {rebuild}")
    files = manifest["files"]
    found = hash_files(folder)
    missing = [name for name in files if name not in found]
    damaged = [name for name in files if name in found and found[name] != files[name]]
    if missing or damaged:
        named = (missing + damaged)[0]
        what = "missing" if missing else "damaged (its content differs from the manifest)"
        more = len(missing) + len(damaged) - 1
        others = f", and {more} more parts are not whole" if more else ""
        raise UserError(f"{folder / named} is {what}{others}; {rebuild}")
    return Store(folder, manifest)
