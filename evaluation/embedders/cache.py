"""Embeddings on disk, so that nothing is embedded twice by one model.

    store/<name>/embeddings/<kind>-<key>/
        about.json          what all of them were made by and of; the key is its hash
        00000.npy           some embeddings, (rows, entries) fp32
        00000.json          whose they are, row by row, and the array's SHA-256; written last
        index/              approximate indexes over them

Parts are written whole or not at all, so that a killed evaluation goes on with those it has. All of
it can be deleted at any time.
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
KINDS = {"frame": "frames", "query": "queries", "text": "texts", "image": "images"}
PART, SECONDS = 512, 30
"""A file is written after so many embeddings, or so long: a kill costs no more. It is read at once,
and ends with a batch, so that what goes on after a kill passes the model in the same batches."""

Thing = TypeVar("Thing")


@dataclass(frozen=True)
class Part:
    path: Path
    names: list[str]


class EmbeddingCache:
    """One model's embeddings of one kind of thing, by name."""

    def __init__(self, root: Path, kind: str, about: Mapping[str, Any]) -> None:
        """`kind` is one of `KINDS`; `about` is everything that the embeddings depend on, as JSON
        holds it."""
        self.kind, self.about = kind, dict(about)
        key = hashlib.sha256(json.dumps(self.about, sort_keys=True).encode()).hexdigest()[:16]
        self.folder = root / f"{kind}-{key}"
        self._parts: list[Part] = []
        self._place: dict[str, tuple[int, int]] = {}

    def complete(
        self, things: Mapping[str, Thing], embed: Callable[[list[Thing]], np.ndarray], batch: int
    ) -> None:
        """Embed those of `things` that are not there yet, `batch` at a time, under a progress bar.

        Args:
            things: by name; they are embedded in this order.
            embed: gives (things, entries) fp32; where it gives fewer entries for some than for
                others, their rows are filled up with zeros.

        Raises:
            UserError: an embedding is not finite, or another process is filling the folder.
        """
        self._read()
        if not self._missing(things):
            return
        self.folder.mkdir(parents=True, exist_ok=True)
        busy = f"{self.folder} is being filled by another process; run this again when it is done"
        with lock_folder(self.folder, busy):
            # Another process may have filled it since.
            self._clean(self._read())
            write_json(self.folder / ABOUT, self.about)
            waiting = self._missing(things)
            with tqdm(
                total=len(things),
                initial=len(things) - len(waiting),
                desc=f"embedding {KINDS[self.kind]}",
                unit=self.kind,
            ) as bar:
                names, rows, begun = [], [], time.monotonic()
                for some in batched(waiting, batch):
                    names += some
                    rows.append(embed([things[name] for name in some]))
                    self._check_finite(rows[-1], some)
                    bar.update(len(some))
                    if len(names) >= PART or time.monotonic() - begun > SECONDS:
                        self._add(names, filled_up(rows))
                        names, rows, begun = [], [], time.monotonic()
                if names:
                    self._add(names, filled_up(rows))

    def parts(self, names: Sequence[str]) -> Iterator[tuple[np.ndarray, np.ndarray]]:
        """All embeddings of `names`, in no order, a file at a time: which of `names` they are, and
        the rows (some, entries)."""
        wanted = {name: k for k, name in enumerate(names)}
        for number, part in enumerate(self._parts):
            rows = [
                row
                for row, name in enumerate(part.names)
                if name in wanted and self._place[name] == (number, row)
            ]
            if rows:
                numbers = np.array([wanted[part.names[row]] for row in rows])
                yield numbers, np.load(part.path)[rows]

    def rows(self, names: Sequence[str]) -> np.ndarray:
        """(names, entries) in their order; a name may stand there twice."""
        once = list(dict.fromkeys(names))
        found = np.zeros((len(once), self.width), np.float32)
        for numbers, rows in self.parts(once):
            found[numbers, : rows.shape[1]] = rows
        row_of = {name: k for k, name in enumerate(once)}
        return found[[row_of[name] for name in names]]

    @property
    def width(self) -> int:
        """Entries of the longest embedding."""
        return max(np.load(part.path, mmap_mode="r").shape[1] for part in self._parts)

    def _missing(self, names: Mapping[str, Any]) -> list[str]:
        return [name for name in names if name not in self._place]

    def _read(self) -> list[Path]:
        """Find the parts that are there; the notes of those that are not whole."""
        notes = sorted(self.folder.glob(NOTES))
        parts = [_whole(note) for note in notes]
        self._parts, self._place = [], {}
        for part in filter(None, parts):
            self._know(part)
        return [note for note, part in zip(notes, parts, strict=True) if part is None]

    def _know(self, part: Part) -> None:
        number = len(self._parts)
        self._parts.append(part)
        self._place |= {name: (number, row) for row, name in enumerate(part.names)}

    def _clean(self, damaged: list[Path]) -> None:
        """Delete what is damaged, which is told, and what a kill left."""
        for note in damaged:
            array = note.with_suffix(".npy")
            log.warning("%s is damaged; its embeddings are made again", array)
            note.unlink()
        for array in self.folder.glob("*.npy"):
            if not array.with_suffix(".json").exists():
                array.unlink()
        for leftover in self.folder.glob(".*.partial"):
            leftover.unlink()

    def _add(self, names: list[str], rows: np.ndarray) -> None:
        buffer = io.BytesIO()
        np.save(buffer, rows)
        taken = [int(note.stem) for note in self.folder.glob(NOTES)]
        array = self.folder / f"{max(taken, default=-1) + 1:05d}.npy"
        write_atomically(array, buffer.getvalue())
        note = {"names": names, "sha256": hash_file(array)}
        write_atomically(array.with_suffix(".json"), json.dumps(note).encode())
        self._know(Part(array, names))

    def _check_finite(self, rows: np.ndarray, names: list[str]) -> None:
        bad = [
            n for n, whole in zip(names, np.isfinite(rows).all(axis=1), strict=True) if not whole
        ]
        if bad:
            more = f", and of {len(bad) - 1} more" if len(bad) > 1 else ""
            raise UserError(
                f"the embedding of {self.kind} {bad[0]}{more} is not finite (NaN or infinite): the "
                "weights are broken or overflow; measure in train.precision=fp32, or train again "
                "with a lower train.lr"
            )


def filled_up(rows: Sequence[np.ndarray]) -> np.ndarray:
    """Rows (some, entries) of several lengths below each other, zeros where some are shorter."""
    longest = max(part.shape[1] for part in rows)
    return np.concatenate([np.pad(r, ((0, 0), (0, longest - r.shape[1]))) for r in rows])


def _whole(note: Path) -> Part | None:
    """A part by its note; None where it is not whole."""
    array = note.with_suffix(".npy")
    try:
        there = json.loads(note.read_text())
        return Part(array, there["names"]) if hash_file(array) == there["sha256"] else None
    except (OSError, ValueError, KeyError, TypeError):
        return None
