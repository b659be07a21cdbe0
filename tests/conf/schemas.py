"""The settings of all commands, for laws that hold for each of a kind."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import fields, is_dataclass
from typing import get_args, get_type_hints

from dynapix.conf import schema as settings
from dynapix.conf.schema.commands import CommandConfig

COMMANDS = [
    schema
    for schema in vars(settings).values()
    if isinstance(schema, type)
    and issubclass(schema, CommandConfig)
    and schema is not CommandConfig
]


def leaf_settings(schema: type, kind: type, group: str = "") -> Iterator[tuple[str, bool]]:
    """Yield the key of each setting whose values are of a kind, and whether it is a list."""
    hints = get_type_hints(schema)
    for field in fields(schema):
        key, hint = f"{group}{field.name}", hints[field.name]
        options = [hint, *get_args(hint)]
        groups = [each for each in options if is_dataclass(each)]
        if groups and not str(hint).startswith("dict"):
            yield from leaf_settings(groups[0], kind, f"{key}.")
        elif kind in options and not str(hint).startswith(("list", "dict")):
            yield key, False
        elif list[kind] in options:
            yield key, True


def path_settings(schema: type, group: str = "") -> Iterator[str]:
    """Yield the key of each setting that names a file or a folder."""
    hints = get_type_hints(schema)
    for field in fields(schema):
        key, hint = f"{group}{field.name}", hints[field.name]
        groups = [each for each in (hint, *get_args(hint)) if is_dataclass(each)]
        if groups and not str(hint).startswith("dict"):
            yield from path_settings(groups[0], f"{key}.")
        elif field.metadata.get("is_path"):
            yield key
