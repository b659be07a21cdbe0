"""A benchmark on disk.

    store/<name>/
        manifest.json        settings, versions, counts, and the SHA-256 of scenes and tables
        scenes/<id>.npz      the oracle of a scene; <id>-without-<k> is simulated without object k,
                             and <id>-alt-<...> is an alternative future
        selection.parquet retrieval.parquet database.parquet    tables of items, queries, frames
        frames/<id>.zip      cache of a scene's frames
        embeddings/          cache of embeddings of frames and queries
        rationales.jsonl     every response of a teacher
        rationales.parquet   accepted rationales of the last narration
        observer-2/          results of simulated observers
        checked.json         sizes and times of the files at the last check

The manifest does not cover the last six, which may change after the build.

A build writes to the folder `.<name>.partial` beside the store and renames it when the benchmark is
complete. Every file is written atomically, so that a killed build resumes with the complete files.
The frames can be deleted at any time: they are rendered again from the oracle, or read again from
the release of another simulator.
"""

from __future__ import annotations

import contextlib
import hashlib
import io
import json
from collections.abc import Collection
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass, fields
from functools import lru_cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from dynapix.conf.errors import UserError
from dynapix.conf.files import read_json_if_valid, write_bytes
from dynapix.conf.schema.benchmark import INTERVENTIONS
from dynapix.data.records import (
    Collision,
    FrameRef,
    Landing,
    Rationale,
    RetrievalQuery,
    Scene,
    SceneObject,
    SelectionItem,
    original_scene_id,
)
from dynapix.data.versions import component_versions

if TYPE_CHECKING:
    import pyarrow as pa

MANIFEST = "manifest.json"
CHECKED = "checked.json"
"""Hash, size and modification time of each file when it was last hashed; made by `open_store`."""
CHECKSUM_KEY = "sha256"
PLAN = "plan.json"
"""Settings of a build in progress; absent from a complete store."""
PARTS = "parts"
"""Folder of the results of a build's jobs; absent from a complete store."""
SCENES_FOLDER, FRAMES_FOLDER = "scenes", "frames"
TABLES = ("selection.parquet", "retrieval.parquet", "database.parquet")
RATIONALES, JOURNAL = "rationales.parquet", "rationales.jsonl"
"""Files of the accepted rationales, and of all responses of teachers."""
DATABASES = ("test", "future", "counterfactual")
"""Names of the databases of frames: of the standard test, of the future-state queries and of the
counterfactual queries. Every frame of `test` is also in `future`."""


def scene_path(folder: Path, scene_id: str) -> Path:
    """Return the path of a scene's oracle in a store or a partial build."""
    return folder / SCENES_FOLDER / f"{scene_id}.npz"


def part_path(folder: Path, inputs: Any) -> Path:
    """Return the path of a job's result in a partial build, which a hash of its inputs names."""
    key = hashlib.sha256(json.dumps(inputs).encode()).hexdigest()
    return folder / PARTS / f"{key[:32]}.json"


def save_scene(scene: Scene, path: Path) -> None:
    """Write a scene's oracle as arrays and a JSON header."""
    header = {f.name: getattr(scene, f.name) for f in fields(scene) if f.name not in Scene.ARRAYS}
    defaults = {"scales": (), "radii": (), "speed_bounds": (), "records_contacts": True}
    for name, default in defaults.items():
        if header[name] == default:
            # Default values are left out: an added field does not change the bytes of scenes that
            # do not use it.
            del header[name]
    arrays = {name: getattr(scene, name) for name in Scene.ARRAYS}
    buffer = io.BytesIO()
    np.savez(buffer, header=np.array(json.dumps(header, default=vars)), **arrays)
    write_bytes(path, buffer.getvalue())


def load_scene(path: Path) -> Scene:
    """Read a scene's oracle."""
    with np.load(path) as file:
        header = json.loads(str(file["header"]))
        collisions = ((c["frame"], tuple(c["objects"]), c["end"]) for c in header["collisions"])
        header |= {
            "objects": tuple(SceneObject(**o) for o in header["objects"]),
            "collisions": tuple(Collision(*c) for c in collisions),
            "image_size": tuple(header["image_size"]),
            "landings": tuple(Landing(**landing) for landing in header["landings"]),
            **{key: tuple(header.get(key, ())) for key in ("scales", "radii", "speed_bounds")},
        }
        return Scene(**header, **{name: file[name] for name in Scene.ARRAYS})


def save_rows(rows: list[dict[str, Any]], path: Path, schema: pa.Schema | None = None) -> None:
    """Write rows as a parquet file; by default, their types determine its schema."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    pq.write_table(pa.Table.from_pylist(rows, schema=schema), sink, compression="zstd")
    write_bytes(path, sink.getvalue())


def load_rows(path: Path) -> list[dict[str, Any]]:
    """Read the rows of a parquet file."""
    import pyarrow.parquet as pq

    # read_table would import pandas, and a path would be expanded by rules of its own.
    with open(path, "rb") as file:
        return pq.ParquetFile(file).read().to_pylist()


def hash_file(path: Path) -> str:
    """SHA-256 of a file."""
    with open(path, "rb") as file:
        return hashlib.file_digest(file, "sha256").hexdigest()


def hash_files(folder: Path, names: Collection[str]) -> dict[str, str]:
    """SHA-256 of files of a store, by relative path."""
    with ThreadPoolExecutor(4) as pool:
        hashes = pool.map(lambda name: hash_file(folder / name), names)
        return dict(zip(names, hashes, strict=True))


def with_checksum(manifest: dict[str, Any]) -> dict[str, Any]:
    """Return a copy of a manifest with the SHA-256 of its other entries."""
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
        """A short hash of the benchmark's scenes, tables, renderer, frame size and world."""
        config = self.manifest["config"]
        frames = [self.manifest["renderer"], config["width"], config["height"]]
        if changes := self.manifest["world_changes"]:
            frames.append(changes)
        content = json.dumps([self.manifest["files"], *frames])
        return hashlib.sha256(content.encode()).hexdigest()[:16]

    def scene_ids(self, split: str) -> list[str]:
        return self.manifest["scenes"][split]

    def scene(self, scene_id: str) -> Scene:
        return cached_scene(scene_path(self.folder, scene_id))

    @property
    def suite(self) -> str:
        """Name of the set of the benchmark's items, except for matched-anchor items."""
        return self.manifest["suite"]

    def selection(self, split: str | None = None, suite: str | None = None) -> list[SelectionItem]:
        """Selection items; by default of both splits and of the benchmark's own suite."""
        rows = load_rows(self.folder / "selection.parquet")
        suite = suite or self.suite
        kept = (r for r in rows if split in (None, r["split"]) and r["suite"] == suite)
        return [SelectionItem.from_row(r) for r in kept]

    def training_items(self) -> list[SelectionItem]:
        """Selection items for training: those of the benchmark's own suite, and the pairs about
        interventions."""
        return self.selection("train") + self.selection("train", INTERVENTIONS)

    def rationales(self) -> list[Rationale]:
        """Rationales that the last narration accepted; none if there has been no narration."""
        path = self.folder / RATIONALES
        return [Rationale.from_row(row) for row in load_rows(path)] if path.exists() else []

    def retrieval(self, split: str | None = None, pool: str = "future") -> list[RetrievalQuery]:
        """Retrieval queries of one of the `POOLS`; by default of both splits."""
        rows = load_rows(self.folder / "retrieval.parquet")
        kept = (r for r in rows if split in (None, r["split"]) and r["pool"] == pool)
        return [RetrievalQuery.from_row(r) for r in kept]

    def standard_test(self) -> list[RetrievalQuery]:
        """The future-state queries of the test split, whose targets are in the database `test`."""
        return self.retrieval("test")

    def database(self, name: str = "test") -> list[FrameRef]:
        """Return the frames of one of `DATABASES`."""
        rows = load_rows(self.folder / "database.parquet")
        return [FrameRef(r["scene_id"], r["frame"]) for r in rows if r["database"] == name]

    def ranked_frames(self, split: str, pool: str = "future") -> list[FrameRef]:
        """Return the frames to rank for the queries of a split in one of the `POOLS`.

        In the future pool, they are the database of the standard test, or, for the training split,
        that of all future-state queries. In the counterfactual pool, they are the frames of its
        database that are of the split's scenes, and the factual twins that this database lacks.
        """
        if pool == "future":
            return self.database("test" if split == "test" else "future")
        own = set(self.scene_ids(split))
        frames = [f for f in self.database(pool) if original_scene_id(f.scene_id) in own]
        # The database lacks a twin if it has a near-duplicate of it, or had no room for it.
        return list(
            dict.fromkeys([*frames, *(q.factual_twin for q in self.retrieval(split, pool))])
        )


cached_scene = lru_cache(maxsize=512)(load_scene)
"""`load_scene` that keeps the most recently used scenes in memory."""


def open_store(folder: Path, verify: bool = False) -> Store:
    """Open a built benchmark, and check every file that its manifest lists.

    A file is hashed if its size or its modification time differs from those at the last check, or
    if `verify` is set.

    Raises:
        UserError: `folder` is not a benchmark, was built by another version of the code, or has a
            missing or damaged file.
    """
    path = folder / MANIFEST

    def refusal(problem: str, code: str) -> UserError:
        advice = f"delete {folder} and build it again with python -m data.build benchmark=NAME"
        return UserError(f"{problem}; {advice}", code=code)

    if not path.exists():
        advice = "delete it, or choose another folder" if folder.exists() else "build one"
        raise UserError(
            f"{folder} is not a benchmark, because {MANIFEST} is missing: {advice} (python -m "
            "data.build benchmark=NAME store=FOLDER)",
            code="missing-file",
        )
    try:
        manifest = json.loads(path.read_text())
        config = manifest["config"]
        current = component_versions(config)
        built = {key: manifest[key] for key in current}
    except (ValueError, TypeError, KeyError) as error:
        problem = f"{path} is not a valid manifest (first check that {folder} is a benchmark)"
        raise refusal(problem, "damaged-file") from error
    for key, version in current.items():
        if built[key] != version:
            problem = f"{folder} has version {built[key]} of the {key}, but this code has {version}"
            raise refusal(problem, "different-version")
    if manifest != with_checksum(manifest):
        raise refusal(f"{path} was changed after the build", "damaged-file")
    expected = manifest["files"]
    stats = {name: _size_and_time(folder / name) for name in expected}
    if missing := [name for name, stat in stats.items() if stat is None]:
        problem = f"{len(missing)} files are missing, such as {folder / min(missing)}"
        raise refusal(problem, "missing-file")
    checked = {} if verify else read_json_if_valid(folder / CHECKED)
    changed = [name for name in expected if checked.get(name) != [expected[name], *stats[name]]]
    hashes = hash_files(folder, changed)
    if damaged := [name for name in changed if hashes[name] != expected[name]]:
        problem = f"{len(damaged)} files differ from the manifest, such as {folder / damaged[0]}"
        raise refusal(problem, "damaged-file")
    if changed:
        checked = {name: [expected[name], *stats[name]] for name in expected}
        # A store may be read-only: its files are then hashed each time.
        with contextlib.suppress(OSError):
            write_bytes(folder / CHECKED, json.dumps(checked).encode())
    return Store(folder, manifest)


def _size_and_time(path: Path) -> tuple[int, int] | None:
    """Size in bytes and modification time in ns of a file; None if it is missing."""
    try:
        stat = path.stat()
    except FileNotFoundError:
        return None
    return stat.st_size, stat.st_mtime_ns
