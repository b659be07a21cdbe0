"""Dotted keys of settings, and the known key that is nearest to a mistyped one."""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from difflib import SequenceMatcher, get_close_matches
from typing import Any, get_args, get_origin, get_type_hints


def keys(schema: type, prefix: str = "") -> Iterator[str]:
    """Every dotted key of a schema, those of nested and optional dataclasses included."""
    hints = get_type_hints(schema)
    for field in fields(schema):
        yield prefix + field.name
        hint = hints[field.name]
        # X | None has the keys of X; a dict has whichever keys its preset gives it.
        kinds = () if get_origin(hint) is dict else (hint, *get_args(hint))
        for kind in filter(is_dataclass, kinds):
            yield from keys(kind, f"{prefix}{field.name}.")


def flatten(value: Any, key: str = "") -> dict[str, Any]:
    """Nested settings by dotted key."""
    if not isinstance(value, dict) or not value:
        return {key: value}
    return {
        dotted: leaf
        for name, inner in value.items()
        for dotted, leaf in flatten(inner, f"{key}.{name}" if key else str(name)).items()
    }


def nearest(key: str, known: Iterable[str]) -> str | None:
    """The known key most similar to `key`, or None.

    A key with the same last part wins, so that `lr` suggests `train.lr`.
    """
    known = list(known)
    last = key.rpartition(".")[2]
    if same_last := [k for k in known if k.rpartition(".")[2] == last]:
        return max(same_last, key=lambda k: SequenceMatcher(None, key, k).ratio())
    if close := get_close_matches(key, known, n=1):
        return close[0]
    by_last = {k.rpartition(".")[2]: k for k in reversed(known)}
    close = get_close_matches(last, by_last, n=1)
    return by_last[close[0]] if close else None
