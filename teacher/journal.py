"""The journal of a teacher's responses (rationales.jsonl), and the table of accepted rationales."""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable
from dataclasses import asdict, fields
from pathlib import Path
from typing import Any

from dynapix.conf.errors import UserError
from dynapix.conf.runs import wait_for_lock
from dynapix.data.records import Rationale
from dynapix.data.store import save_rows
from dynapix.teacher.sections import SECTIONS

DIGEST = "sha256"
"""Key of the checksum in a line of the journal."""
LINE_ERRORS = (ValueError, TypeError, KeyError, AttributeError)
"""Errors that a damaged line raises when it is decoded."""


class Journal:
    """An open rationales.jsonl: one response per line, to which new ones are appended.

    Opening waits while another process has the file open. If a killed process left a last line
    without a line break, a complete record gets its line break, and an incomplete one is removed,
    so that its response is requested again.

    Attributes:
        rationales: The responses that the file had when it was opened.

    Raises:
        UserError: Another line is damaged; see `read_rationales`.
    """

    def __init__(self, path: Path) -> None:
        self.path = path
        self.file = open(path, "ab+")  # noqa: SIM115  closed by __exit__
        wait_for_lock(self.file.fileno(), f"another process is writing {path}")
        try:
            self._repair_last_line()
            self.rationales = read_rationales(path)
        except BaseException:
            self.file.close()
            raise

    def __enter__(self) -> Journal:
        return self

    def __exit__(self, *_: object) -> None:
        os.fsync(self.file.fileno())
        self.file.close()

    def append(self, rationales: Iterable[Rationale]) -> None:
        self.file.write(b"".join(map(_encode_line, rationales)))
        self.file.flush()

    def _repair_last_line(self) -> None:
        self.file.seek(0)
        content = self.file.read()
        *_, last = content.split(b"\n")
        if last:
            try:
                _decode_line(last)
                self.file.write(b"\n")
            except LINE_ERRORS:
                self.file.truncate(len(content) - len(last))
            self.file.flush()


def _encode_line(rationale: Rationale) -> bytes:
    # A model may generate half of a surrogate pair, which UTF-8 cannot encode.
    text = json.dumps(asdict(rationale), ensure_ascii=False).encode("utf-8", "replace")
    row = json.loads(text)
    return json.dumps({**row, DIGEST: _digest(row)}, ensure_ascii=False).encode() + b"\n"


def _decode_line(line: bytes) -> Rationale:
    row = json.loads(line)
    if row.pop(DIGEST) != _digest(row):
        raise ValueError("its checksum is wrong")
    return Rationale.from_row(row)


def _digest(row: dict[str, Any]) -> str:
    return hashlib.sha256(json.dumps(row).encode()).hexdigest()[:16]


def read_rationales(path: Path) -> list[Rationale]:
    """Return every response in a rationales.jsonl.

    Raises:
        UserError: A line is damaged or was edited; the message names the file and the line.
    """
    rationales = []
    for number, line in enumerate(path.read_bytes().splitlines(), start=1):
        try:
            rationales.append(_decode_line(line))
        except LINE_ERRORS as error:
            raise UserError(
                f"{path}, line {number}: not an intact rationale ({error}). Delete the line; its "
                "response is then requested again",
                code="damaged-file",
            ) from error
    return rationales


def save_accepted(rationales: list[Rationale], path: Path) -> None:
    """Write accepted rationales to a parquet file, atomically."""
    import pyarrow as pa

    # All columns but these are text. The counts of claims have no column: a struct needs the same
    # fields in every file, but some kinds of claims may not occur. Nor has the sample, so that the
    # table is the same whether or not a sample was narrated first.
    types = dict.fromkeys(("attempt", "seed", "prompt_tokens", "completion_tokens"), pa.int64())
    types |= dict.fromkeys(("accepted", "fallback", "undecided"), pa.bool_())
    types |= dict.fromkeys(("finished", "sufficiency"), pa.float64())
    types["reasons"] = pa.list_(pa.string())
    types["sections"] = pa.struct([(name, pa.string()) for name in SECTIONS])
    names = [f.name for f in fields(Rationale) if f.name not in ("claims", "sample")]
    schema = pa.schema([(name, types.get(name, pa.string())) for name in names])
    save_rows([vars(r) for r in rationales], path, schema)
