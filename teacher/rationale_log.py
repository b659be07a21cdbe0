"""The append-only file of a teacher's answers, one JSON line each, safe against a kill."""

from __future__ import annotations

import hashlib
import io
import json
import os
from collections.abc import Iterable
from dataclasses import fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from conf.errors import UserError
from conf.runs import wait_for_lock
from data.records import Rationale
from data.store import write_atomically
from teacher.validation.validator import SECTIONS

if TYPE_CHECKING:
    import pyarrow as pa

DIGEST = "sha256"
UNREADABLE = (ValueError, TypeError, KeyError, AttributeError)


class Journal:
    """An open rationales.jsonl; `rationales` are the answers that it held when it was opened.

    While another process writes it, opening waits. A torn last line, left by a kill, is ended or
    taken back; the answer it lost is asked for again.

    Raises:
        UserError: a line before the last cannot be read.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = open(path, "ab+")  # noqa: SIM115  closed by __exit__
        wait_for_lock(self.file.fileno(), f"{path} is being written by another process")
        self._end_torn_line()
        self.rationales = read_rationales(path)

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        self.file.close()

    def append(self, rationales: Iterable[Rationale]) -> None:
        """Write answers and wait until they are on the disk."""
        self.file.write(b"".join(_line(r) for r in rationales))
        self.file.flush()
        os.fsync(self.file.fileno())

    def _end_torn_line(self) -> None:
        self.file.seek(0)
        content = self.file.read()
        whole = content.rfind(b"\n") + 1
        torn = content[whole:]
        if not torn:
            return
        try:
            _read(torn)
        except UNREADABLE:
            self.file.truncate(whole)
        else:
            self.file.write(b"\n")
        self.file.flush()


def _line(rationale: Rationale) -> bytes:
    # A teacher may answer with half of a surrogate pair, which UTF-8 cannot hold.
    whole = json.dumps(rationale.to_row(), ensure_ascii=False).encode("utf-8", "replace")
    row = json.loads(whole)
    return json.dumps({**row, DIGEST: _digest(row)}, ensure_ascii=False).encode() + b"\n"


def _read(line: bytes) -> Rationale:
    row = json.loads(line)
    if row.pop(DIGEST) != _digest(row):
        raise ValueError("it was changed after it was written")
    return Rationale.from_row(row)


def _digest(row: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(row).encode()).hexdigest()[:16]


def read_rationales(path: Path) -> list[Rationale]:
    """Every answer in a rationales.jsonl.

    Raises:
        UserError: a line cannot be read or was changed; names the file and the line.
    """
    rationales = []
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            rationales.append(_read(line))
        except UNREADABLE as error:
            raise UserError(
                f"{path}, line {number}: not a rationale ({error}); delete the line, and its "
                "answer is asked for again"
            ) from error
    return rationales


def save_accepted(rationales: list[Rationale], path: Path) -> None:
    """Put accepted rationales into a parquet file, whole or not at all."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    sink = io.BytesIO()
    schema = _schema()
    columns = {name: [getattr(r, name) for r in rationales] for name in schema.names}
    table = pa.Table.from_pydict(columns, schema=schema)
    pq.write_table(table, sink, compression="zstd")
    write_atomically(path, sink.getvalue())


def _schema() -> pa.Schema:
    """Of every field but the claims' counts, for some are null in all rows."""
    import pyarrow as pa

    types = {"accepted": pa.bool_(), "fallback": pa.bool_(), "finished": pa.float64()}
    types["reasons"] = pa.list_(pa.string())
    types["sections"] = pa.struct([(name, pa.string()) for name in SECTIONS])
    whole = ("attempt", "seed", "prompt_tokens", "completion_tokens")
    types |= dict.fromkeys(whole, pa.int64())
    names = [f.name for f in fields(Rationale) if f.name != "claims"]
    return pa.schema([(name, types.get(name, pa.string())) for name in names])
