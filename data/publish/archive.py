"""Built benchmarks as single files, which others open with `dynapix.load`.

An archive is a zip file with the folder of the benchmark: its manifest, scenes and tables, the
frames that are in its cache, and the rationales of a narration.
"""

from __future__ import annotations

import json
import logging
import shutil
import zipfile
from http.client import HTTPException
from pathlib import Path
from typing import Any
from urllib.request import urlopen

from tqdm import tqdm

from dynapix.conf.errors import UserError
from dynapix.conf.runs import lock_file
from dynapix.data.store import FRAMES_FOLDER, JOURNAL, MANIFEST, RATIONALES, Store, open_store

log = logging.getLogger(__name__)

CHUNK = 1 << 20
"""Bytes that are copied at a time."""


def write_archive(store: Store, path: Path) -> None:
    """Write a benchmark as an archive, unless `path` holds it. The same files give the same bytes.

    Raises:
        UserError: `path` holds something else.
    """
    names = [MANIFEST, *store.manifest["files"]]
    names += [f"{FRAMES_FOLDER}/{p.name}" for p in (store.folder / FRAMES_FOLDER).glob("[!.]*")]
    names += [name for name in (JOURNAL, RATIONALES) if (store.folder / name).exists()]
    if path.exists():
        if _read_manifest(path)[1] != store.manifest or not _has_rationales(path, store):
            raise UserError(
                f"{path} holds another benchmark or build, or other rationales: choose another "
                "archive=FILE, or delete it",
                code="other-settings",
            )
        log.info("%s already holds this benchmark", path)
        return
    path.parent.mkdir(parents=True, exist_ok=True)
    unfinished = path.with_name(f".{path.name}.partial")
    # Frames, which take most of the space, are compressed already.
    with zipfile.ZipFile(unfinished, "w", zipfile.ZIP_STORED) as archive:
        for name in tqdm(sorted(names), desc=f"writing {path.name}", unit="file", mininterval=1.0):
            # ZipInfo has a fixed date.
            member = zipfile.ZipInfo(f"{store.name}/{name}")
            with open(store.folder / name, "rb") as file, archive.open(member, "w") as target:
                shutil.copyfileobj(file, target, CHUNK)
    unfinished.rename(path)


def _has_rationales(path: Path, store: Store) -> bool:
    """Return whether an archive has the rationales of a store, which its manifest does not list."""
    name, own = f"{store.name}/{JOURNAL}", store.folder / JOURNAL
    with zipfile.ZipFile(path) as archive:
        held = archive.read(name) if name in archive.namelist() else None
    return held == (own.read_bytes() if own.exists() else None)


def open_archive(source: str, root: Path) -> Store:
    """Unpack an archive below `root`, unless that is done, and open the benchmark.

    Args:
        source: Its path, or its address, from which it is downloaded.

    Raises:
        UserError: The archive cannot be read or downloaded, it holds a damaged benchmark or one of
            another version, or the folder holds another build.
    """
    if not source.startswith(("http://", "https://")):
        return _unpack(Path(source), root)
    file = root / f".{source.rstrip('/').rpartition('/')[2]}.download"
    with lock_file(file.with_suffix(".lock"), f"another process downloads {source}", wait=True):
        try:
            _download(source, file)
            return _unpack(file, root)
        finally:
            file.unlink(missing_ok=True)


def _download(address: str, file: Path) -> None:
    try:
        with urlopen(address, timeout=60) as reply, open(file, "wb") as target:
            size = int(reply.headers.get("Content-Length") or 0) or None
            with tqdm(total=size, desc="downloading", unit="B", unit_scale=True) as bar:
                while chunk := reply.read(CHUNK):
                    target.write(chunk)
                    bar.update(len(chunk))
            # A transfer that is cut off ends like a complete one.
            if size is not None and target.tell() != size:
                raise ValueError(f"the transfer ended after {target.tell()} of {size} bytes")
    # An HTTPException is no OSError.
    except (OSError, ValueError, HTTPException) as error:
        raise UserError(f"{address} cannot be downloaded: {error}", code="no-download") from error


def _unpack(path: Path, root: Path) -> Store:
    name, manifest = _read_manifest(path)
    folder = root / name
    with lock_file(root / f".{name}.lock", f"another process unpacks {name}", wait=True):
        if folder.exists():
            store = open_store(folder)
            if store.manifest != manifest:
                raise UserError(
                    f"{folder} is another build than {path}: choose another store, or delete it",
                    code="different-builds",
                )
            return store
        unfinished = root / f".{name}.unpacked"
        shutil.rmtree(unfinished, ignore_errors=True)
        try:
            with zipfile.ZipFile(path) as archive:
                # Names with ".." or a leading slash are written below the folder.
                members = archive.namelist()
                for member in tqdm(members, desc="unpacking", unit="file", mininterval=1.0):
                    archive.extract(member, unfinished)
            open_store(unfinished / name)
            (unfinished / name).rename(folder)
        except zipfile.BadZipFile as error:
            raise UserError(f"{path} is damaged: {error}", code="damaged-file") from error
        finally:
            shutil.rmtree(unfinished, ignore_errors=True)
        return open_store(folder)


def _read_manifest(path: Path) -> tuple[str, dict[str, Any]]:
    """Return the name of the benchmark in an archive, and its manifest."""
    try:
        with zipfile.ZipFile(path) as archive:
            [member] = [n for n in archive.namelist() if n.endswith(f"/{MANIFEST}")]
            return member.removesuffix(f"/{MANIFEST}"), json.loads(archive.read(member))
    except (OSError, ValueError, zipfile.BadZipFile) as error:
        raise UserError(
            f"{path} is not an archive of a benchmark: give a file that python -m data.export "
            f"archive=FILE wrote ({error})",
            code="not-an-archive",
        ) from error
