"""The settings of all commands, for laws that hold for each of a kind."""

from __future__ import annotations

import re
import shlex
from collections.abc import Iterable, Iterator
from dataclasses import Field, fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

from dynapix.conf import schema

ROOT = Path(__file__).parents[2]
COMMAND = re.compile(r'^@command\("([\w.]+)", (\w+)', re.MULTILINE)
SCHEMAS = {
    name: getattr(schema, kind)
    for package in ("data", "teacher", "train", "evaluation")
    for path in sorted((ROOT / package).rglob("*.py"))
    for name, kind in COMMAND.findall(path.read_text())
}
"""The settings of each command, by its name."""


def walk_settings(schema: type, group: str = "") -> Iterator[tuple[str, Field, Any]]:
    """Yield the key, the field and the type of each setting, except those in dicts of groups."""
    hints = get_type_hints(schema)
    for field in fields(schema):
        key, hint = f"{group}{field.name}", hints[field.name]
        groups = [each for each in (hint, *get_args(hint)) if is_dataclass(each)]
        if groups and get_origin(hint) is not dict:
            yield from walk_settings(groups[0], f"{key}.")
        else:
            yield key, field, hint


def parse_line(line: str) -> tuple[str, list[str]]:
    """Return the command and the overrides of a line `python -m COMMAND ...`."""
    python, m, command, *overrides = shlex.split(line)
    assert (python, m) == ("python", "-m")
    return command, overrides


def distinct(commands: Iterable[tuple[str, list[str]]]) -> list[tuple[str, list[str]]]:
    """Return the commands that differ in more than the names of their runs and models."""
    names = ("run=", "model=", "matcher.model=")
    found = {(c, *(o for o in sorted(own) if not o.startswith(names))): own for c, own in commands}
    return [(command, overrides) for (command, *_), overrides in found.items()]
