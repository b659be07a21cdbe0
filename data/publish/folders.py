"""Folders of exports, which are complete or not there.

An export is written to a hidden folder beside its own, and renamed when it is complete. Its
export.json has the settings that decide its content, and the SHA-256 of its files.
"""

from __future__ import annotations

import json
import logging
import shutil
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from typing import Any

from dynapix.conf.errors import UserError
from dynapix.conf.files import read_json_if_valid, write_bytes
from dynapix.conf.runs import lock_file
from dynapix.data.store import hash_file

log = logging.getLogger(__name__)

EXPORT_RECORD = "export.json"
Shard = dict[str, Any]
"""Entry of a file in export.json: path relative to the export's folder, sha256, and more."""


def write_folder(
    folder: Path,
    plan: Mapping[str, Any],
    write: Callable[[Path], list[Shard]],
    others: Sequence[str] = (),
) -> list[Shard]:
    """Write an export unless `folder` holds it, and return its shards.

    Args:
        plan: What decides the content.
        write: Writes the files that a folder lacks, and returns the entries of all shards.
        others: Further files that `write` writes and that are verified too.

    Raises:
        UserError: `folder` contains something else or a damaged export, or another process is
            writing to it.
    """
    if folder.exists():
        shards = _verify(folder, plan)
        log.info("%s already holds this export", folder)
        return shards
    unfinished = folder.with_name(f".{folder.name}.partial")
    busy = f"another process is writing {folder}: run this command again when it has finished"
    with lock_file(unfinished.with_suffix(".lock"), busy):
        unfinished.mkdir(exist_ok=True)
        if not plan.items() <= read_json_if_valid(unfinished / EXPORT_RECORD).items():
            for path in unfinished.iterdir():
                shutil.rmtree(path) if path.is_dir() else path.unlink()
        _write_record(unfinished, plan)
        shards = write(unfinished)
        hashes = {name: hash_file(unfinished / name) for name in others}
        _write_record(unfinished, {**plan, "shards": shards, "others": hashes})
        unfinished.rename(folder)
    return shards


def describe_file(folder: Path, path: Path) -> Shard:
    """Return what export.json says of a file of an export."""
    name = path.relative_to(folder).as_posix()
    return {"path": name, "bytes": path.stat().st_size, "sha256": hash_file(path)}


def _write_record(folder: Path, record: Mapping[str, Any]) -> None:
    write_bytes(folder / EXPORT_RECORD, json.dumps(record, indent=1).encode())


def _verify(folder: Path, plan: Mapping[str, Any]) -> list[Shard]:
    """Return the shards of an undamaged export of `plan`."""
    record = read_json_if_valid(folder / EXPORT_RECORD)
    if "shards" not in record:
        raise UserError(
            f"{folder} exists but contains no readable export: choose another folder with "
            "folder=FOLDER",
            code="folder-in-use",
        )
    for key, value in plan.items():
        if record.get(key) != value:
            raise UserError(
                f"{folder} contains an export with {key}={record.get(key)}, not {key}={value}: "
                f"choose another folder with folder=FOLDER, or delete {folder}",
                code="other-settings",
            )
    expected = record["others"] | {s["path"]: s["sha256"] for s in record["shards"]}
    for name, sha256 in expected.items():
        path = folder / name
        problem = "missing" if not path.exists() else "damaged" if hash_file(path) != sha256 else ""
        if problem:
            raise UserError(
                f"{path} is {problem}: delete {folder} and export again", code=f"{problem}-file"
            )
    return record["shards"]
