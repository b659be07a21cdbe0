"""Embeddings on disk, so that a model embeds each input once.

    store/<name>/embeddings/<kind>-<key>.sqlite

A file holds the embeddings of one kind of input (frame, query or text) that were made with the same
settings; the key in its name is their hash. Each batch is committed, so that a killed evaluation
resumes after the last batch. All files can be deleted at any time. In a store that this user may
not write, new embeddings are kept in a temporary file. The ranks of a launcher share the batches,
and the main rank alone has the files.
"""

from __future__ import annotations

import logging
import sqlite3
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import closing, contextmanager
from pathlib import Path
from typing import Any, TypeVar

import numpy as np
from tqdm import tqdm

from dynapix.conf.errors import UserError
from dynapix.conf.files import is_writable
from dynapix.conf.runs import rank
from dynapix.data.parallel import batched
from dynapix.models.distributed import map_over_ranks, share_from_main
from dynapix.models.fingerprints import settings_key

log = logging.getLogger(__name__)

SCHEMA = """
PRAGMA page_size = 65536; -- an embedding of 4,096 entries fits in a page
PRAGMA synchronous = OFF; -- a killed process damages nothing, a power failure only this cache
CREATE TABLE IF NOT EXISTS embedding (name TEXT UNIQUE, entries BLOB); -- fp32
"""
PART_ROWS = 512
"""Maximum number of rows of a part that `EmbeddingCache.parts` yields."""

Input = TypeVar("Input")


class EmbeddingCache:
    """One model's embeddings of one kind of input, by the name of the input.

    Args:
        root: Folder of the files.
        kind: frame, query or text.
        settings: Everything that the embeddings depend on besides the inputs; values of JSON.

    Raises:
        UserError: The file is damaged.
    """

    def __init__(self, root: Path, kind: str, settings: Mapping[str, Any]) -> None:
        self.kind = kind
        self.path = root / f"{kind}-{settings_key(settings)}.sqlite"
        with self._explain_damage():
            self._db = self._connect(root)
            self._db.executescript(SCHEMA)

    def _connect(self, root: Path) -> sqlite3.Connection:
        """Open the file, or a temporary copy of it if it cannot be written. A rank other than the
        main rank opens an empty temporary file."""
        if rank() > 0:
            return sqlite3.connect("")
        if is_writable(root) and is_writable(self.path):
            root.mkdir(parents=True, exist_ok=True)
            return sqlite3.connect(self.path, timeout=60)
        log.warning("%s cannot be written: this evaluation keeps its embeddings to itself", root)
        copy = sqlite3.connect("")
        if self.path.exists():
            address = f"{self.path.absolute().as_uri()}?immutable=1"
            with closing(sqlite3.connect(address, uri=True)) as saved:
                saved.backup(copy)
        return copy

    def complete(
        self, inputs: Mapping[str, Input], embed: Callable[[list[Input]], np.ndarray], batch: int
    ) -> None:
        """Embed the `inputs` that the cache lacks, `batch` at a time.

        Args:
            inputs: The inputs by name, in the order in which they are embedded. All ranks must have
                the same.
            embed: Returns the fp32 embeddings (inputs, entries) of some inputs.

        Raises:
            UserError: An embedding is non-finite, or the file is damaged.
        """
        present = {name for (name,) in self._query("SELECT name FROM embedding")}
        missing = share_from_main([name for name in inputs if name not in present])
        if not missing:
            return
        batches = [*batched(missing, batch)]
        embedded = map_over_ranks(lambda names: embed([inputs[name] for name in names]), batches)
        bar = tqdm(
            total=len(inputs), initial=len(inputs) - len(missing), desc="embedding",
            unit=self.kind, disable=rank() > 0,
        )  # fmt: skip
        with bar:
            for names, rows in zip(batches, embedded, strict=True):
                self._check_finite(rows, names)
                if rank() == 0:
                    entries = map(np.ndarray.tobytes, rows.astype(np.float32))
                    with self._explain_damage(), self._db:
                        insert = "INSERT OR REPLACE INTO embedding VALUES (?, ?)"
                        self._db.executemany(insert, zip(names, entries, strict=True))
                bar.update(len(names))

    def parts(self, names: Sequence[str]) -> Iterator[np.ndarray]:
        """Yield the embeddings of `names` in parts (rows, entries). The order of the rows is not
        that of `names`, and a repeated name has one row."""
        wanted, width = set(names), self.width
        bar = tqdm(total=len(wanted), desc="ranking", unit=self.kind, leave=False)
        with self._explain_damage(), bar:
            cursor = self._db.execute("SELECT name, entries FROM embedding")
            while rows := cursor.fetchmany(PART_ROWS):
                if entries := [row for name, row in rows if name in wanted]:
                    yield pad_rows([np.frombuffer(e, np.float32) for e in entries], width)
                    bar.update(len(entries))

    def rows(self, names: Sequence[str]) -> np.ndarray:
        """Return the embeddings (names, entries) in the order of `names`, which may repeat."""
        unique = list(dict.fromkeys(names))
        query = "SELECT entries FROM embedding WHERE name = ?"
        entries = [entries for name in unique for (entries,) in self._query(query, name)]
        rows = pad_rows([np.frombuffer(e, np.float32) for e in entries], self.width)
        row_of = {name: k for k, name in enumerate(unique)}
        return rows[[row_of[name] for name in names]]

    @property
    def width(self) -> int:
        """Number of entries of the longest embedding."""
        [(size,)] = self._query("SELECT max(length(entries)) FROM embedding")
        return size // np.dtype(np.float32).itemsize

    def _query(self, query: str, *values: str) -> list[tuple[Any, ...]]:
        with self._explain_damage():
            return self._db.execute(query, values).fetchall()

    @contextmanager
    def _explain_damage(self) -> Iterator[None]:
        try:
            yield
        except sqlite3.DatabaseError as error:
            raise UserError(
                f"{self.path} cannot be read or written ({error}): if the disk is full or another "
                "command holds the file, correct that, otherwise delete it; then run this again",
                code="unusable-cache",
            ) from error

    def _check_finite(self, rows: np.ndarray, names: list[str]) -> None:
        finite = np.isfinite(rows).all(axis=1)
        bad = [name for name, is_finite in zip(names, finite, strict=True) if not is_finite]
        if bad:
            more = f" and {len(bad) - 1} more" if len(bad) > 1 else ""
            raise UserError(
                f"non-finite embedding (NaN or Inf) for {self.kind} {bad[0]}{more}: the weights "
                "are not finite, or the model overflows; set train.precision=fp32, or train again "
                "with a lower train.lr",
                code="non-finite-embedding",
            )


def pad_rows(rows: Sequence[np.ndarray], width: int | None = None) -> np.ndarray:
    """Stack rows (entries,) of different lengths, padded with zeros to `width` or the longest."""
    padded = np.zeros((len(rows), width or max(map(len, rows))), np.float32)
    for target, row in zip(padded, rows, strict=True):
        target[: len(row)] = row
    return padded
