"""Embeddings on disk, so that a model embeds each input once.

    store/<name>/embeddings/<kind>-<key>/
        about.json          the settings that all of them depend on; the key is their hash
        00000.npy           a part: (rows, entries) fp32
        00000.json          the names of its rows and its SHA-256; written last
        index/              approximate indexes over them

A part is written atomically, so that a killed evaluation resumes after the last one. All of it can
be deleted at any time.
"""

from __future__ import annotations

import hashlib
import io
import json
import logging
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

from conf.errors import UserError
from conf.runs import lock_folder, write_json
from data.parallel import batched
from data.store import hash_file, write_atomically

log = logging.getLogger(__name__)

ABOUT, NOTES = "about.json", "[0-9]*.json"
PLURALS = {"frame": "frames", "query": "queries", "text": "texts", "image": "images"}
PART_ROWS, PART_SECONDS = 512, 30
"""A part is written after this many embeddings or seconds: a kill costs no more. It ends with a
batch, so that a resumed evaluation has the same batches."""

Input = TypeVar("Input")


@dataclass(frozen=True)
class Part:
    path: Path
    names: list[str]


class EmbeddingCache:
    """One model's embeddings of one kind of input, by name."""

    def __init__(self, root: Path, kind: str, about: Mapping[str, Any]) -> None:
        """`kind` is a key of `PLURALS`; `about` has all settings that the embeddings depend on, as
        JSON."""
        self.kind, self.about = kind, dict(about)
        key = hashlib.sha256(json.dumps(self.about, sort_keys=True).encode()).hexdigest()[:16]
        self.folder = root / f"{kind}-{key}"
        self._parts: list[Part] = []
        self._place: dict[str, tuple[int, int]] = {}

    def complete(
        self, inputs: Mapping[str, Input], embed: Callable[[list[Input]], np.ndarray], batch: int
    ) -> None:
        """Embed the `inputs` that the cache lacks, `batch` at a time.

        Args:
            inputs: By name, in the order in which they are embedded.
            embed: Returns (inputs, entries) fp32; shorter rows are padded with zeros.

        Raises:
            UserError: An embedding is non-finite, or another process fills the folder.
        """
        self._read()
        if not self._missing(inputs):
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        busy = f"{self.folder} is in use by another process; run this again when it is done"
        with lock_folder(self.folder, busy):
            # Another process may have completed it in the meantime.
            self._delete_damaged(self._read())
            write_json(self.folder / ABOUT, self.about)
            missing = self._missing(inputs)
            with tqdm(
                total=len(inputs),
                initial=len(inputs) - len(missing),
                desc=f"embedding {PLURALS[self.kind]}",
                unit=self.kind,
            ) as bar:
                names, rows, began = [], [], time.monotonic()
                for some in batched(missing, batch):
                    names += some
                    rows.append(embed([inputs[name] for name in some]))
                    self._check_finite(rows[-1], some)
                    bar.update(len(some))
                    if len(names) >= PART_ROWS or time.monotonic() - began > PART_SECONDS:
                        self._write(names, pad_rows(rows))
                        names, rows, began = [], [], time.monotonic()
                if names:
                    self._write(names, pad_rows(rows))

    def parts(self, names: Sequence[str]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """Yield the embeddings of `names` one file at a time, as indices into `names` and rows."""
        wanted = {name: k for k, name in enumerate(names)}
        for number, part in enumerate(self._parts):
            rows = [
                row
                for row, name in enumerate(part.names)
                if name in wanted and self._place[name] == (number, row)
            ]
            if rows:
                indices = np.array([wanted[part.names[row]] for row in rows])
                yield indices, np.load(part.path)[rows]

    def rows(self, names: Sequence[str]) -> np.ndarray:
        """Return (names, entries) in the order of `names`, which may repeat."""
        unique = list(dict.fromkeys(names))
        embeddings = np.zeros((len(unique), self.width), np.float32)
        for indices, rows in self.parts(unique):
            embeddings[indices, : rows.shape[1]] = rows
        row_of = {name: k for k, name in enumerate(unique)}
        return embeddings[[row_of[name] for name in names]]

    @property
    def width(self) -> int:
        """Entries of the longest embedding."""
        return max(np.load(part.path, mmap_mode="r").shape[1] for part in self._parts)

    def _missing(self, names: Mapping[str, Any]) -> list[str]:
        return [name for name in names if name not in self._place]

    def _read(self) -> list[Path]:
        """Find the intact parts, and return the notes of the others."""
        self._parts, self._place = [], {}
        damaged = []
        for note in sorted(self.folder.glob(NOTES)):
            if part := _read_part(note):
                self._add(part)
            else:
                damaged.append(note)
        return damaged

    def _add(self, part: Part) -> None:
        number = len(self._parts)
        self._parts.append(part)
        self._place |= {name: (number, row) for row, name in enumerate(part.names)}

    def _delete_damaged(self, notes: list[Path]) -> None:
        """Delete damaged parts, with a warning, and leftovers of a killed process."""
        for note in notes:
            log.warning("%s is damaged; embedding its rows again", note.with_suffix(".npy"))
            note.unlink()
        for array in self.folder.glob("*.npy"):
            if not array.with_suffix(".json").exists():
                array.unlink()
        for leftover in self.folder.glob(".*.partial"):
            leftover.unlink()

    def _write(self, names: list[str], rows: np.ndarray) -> None:
        buffer = io.BytesIO()
        np.save(buffer, rows)
        numbers = [int(note.stem) for note in self.folder.glob(NOTES)]
        array = self.folder / f"{max(numbers, default=-1) + 1:05d}.npy"
        write_atomically(array, buffer.getvalue())
        note = {"names": names, "sha256": hash_file(array)}
        write_atomically(array.with_suffix(".json"), json.dumps(note).encode())
        self._add(Part(array, names))

    def _check_finite(self, rows: np.ndarray, names: list[str]) -> None:
        finite = np.isfinite(rows).all(axis=1)
        bad = [name for name, is_finite in zip(names, finite, strict=True) if not is_finite]
        if bad:
            more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
            raise UserError(
                f"non-finite embedding (NaN or Inf) for {self.kind} {bad[0]}{more}: the weights "
                "are broken or overflow; measure in train.precision=fp32, or train again with a "
                "lower train.lr",
                code="non-finite-embedding",
            )


def pad_rows(parts: Sequence[np.ndarray]) -> np.ndarray:
    """Concatenate rows (some, entries) of several lengths, padded with zeros."""
    longest = max(part.shape[1] for part in parts)
    return np.concatenate([np.pad(r, ((0, 0), (0, longest - r.shape[1]))) for r in parts])


def _read_part(note: Path) -> Part | None:
    """Return the part of a note, or None if it is damaged."""
    array = note.with_suffix(".npy")
    try:
        content = json.loads(note.read_text())
        is_intact = hash_file(array) == content["sha256"]
        return Part(array, content["names"]) if is_intact else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
