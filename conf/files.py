"""Text, JSON and JSON Lines files."""

from __future__ import annotations

import json
import os
from collections.abc import Iterable, Iterator
from pathlib import Path
from typing import Any

from dynapix.conf.errors import UserError


def expand_path(path: str) -> str:
    """Return a path in which a leading `~` or `~user` is replaced by the home folder. Libraries
    differ in whether they replace it."""
    return os.path.expanduser(path)


def refuse_broken_link(path: str | Path) -> None:
    """Raises UserError if a path leads through a link whose target does not exist."""
    for each in (*reversed(Path(path).parents), Path(path)):
        if each.is_symlink() and not os.path.exists(each):
            raise UserError(
                f"{each} is a link to {os.readlink(each)}, which does not exist: create the "
                "target, or delete the link",
                code="broken-link",
            )


def is_writable(path: Path) -> bool:
    """Return whether this user may write a file or a folder, or create it if it is missing."""
    existing = next(each for each in (path, *path.absolute().parents) if each.exists())
    return os.access(existing, os.W_OK)


def write_bytes(path: Path, content: bytes) -> None:
    """Write a file so that a killed process leaves either the complete file or none."""
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
        # When the disk is full, the error does not name the file.
        raise OSError(error.errno, error.strerror, str(path)) from error


def write_text(path: Path, text: str) -> None:
    """Write a text file atomically."""
    write_bytes(path, text.encode())


def write_json(path: Path, value: Any) -> None:
    """Write JSON with sorted keys, atomically."""
    write_text(path, json.dumps(value, indent=2, sort_keys=True) + "\n")


def write_json_lines(path: Path, rows: Iterable[dict[str, Any]]) -> None:
    """Write one JSON object per line, atomically."""
    write_text(path, "".join(f"{json.dumps(row)}\n" for row in rows))


def read_json(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file of a run or of a build.

    Raises:
        UserError: The file is damaged or missing.
    """
    try:
        value = json.loads(path.read_text(encoding="utf-8-sig"))
        if isinstance(value, dict):
            return value
        problem = "it is no JSON object"
    except FileNotFoundError:
        problem = "there is no such file"
    except ValueError as error:
        problem = str(error)
    raise UserError(
        f"{path} cannot be read ({problem}): restore it, or delete {path.parent} and start again",
        code="damaged-file",
    )


def read_json_if_valid(path: Path) -> dict[str, Any]:
    """Return the object in a JSON file; an empty one if the file is damaged or missing."""
    try:
        return dict(json.loads(path.read_text(encoding="utf-8-sig")))
    except (OSError, ValueError, TypeError):
        return {}


def read_json_lines(path: Path) -> Iterator[dict[str, Any]]:
    """Yield the objects in a file of JSON lines; skip damaged lines, such as a last line that a
    killed process wrote only in part."""
    with open(path, encoding="utf-8-sig", errors="replace") as file:
        for line in file:
            try:
                row = json.loads(line)
            except ValueError:
                continue
            if isinstance(row, dict):
                yield row
