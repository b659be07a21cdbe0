"""The keys of a schema, what is said about them, and the one that a user most likely meant."""

from __future__ import annotations

import ast
import inspect
from collections.abc import Iterable, Iterator
from dataclasses import fields, is_dataclass
from difflib import SequenceMatcher, get_close_matches
from functools import cache
from pathlib import Path
from types import NoneType
from typing import Any, get_args, get_origin, get_type_hints


def keys(schema: type, prefix: str = "") -> Iterator[str]:
    """Every dotted key of a schema, the nested dataclasses' own keys included."""
    hints = get_type_hints(schema)
    for field in fields(schema):
        key = prefix + field.name
        yield key
        inner = _unwrap(hints[field.name])
        if is_dataclass(inner):
            yield from keys(inner, key + ".")


def keys_like(schema: type, key: str) -> Iterator[str]:
    """Every dotted key of a schema and, where `key` lies in a dict field, of its entry there."""
    if above := dict_above(schema, key):
        kind: Any = schema
        for part in above.split("."):
            kind = _unwrap(get_type_hints(kind)[part])
        name = key.removeprefix(f"{above}.").partition(".")[0]
        yield from keys(get_args(kind)[1], f"{above}.{name}.")
    yield from keys(schema)


def has_key(schema: type, key: str) -> bool:
    """Whether `key` can be set; a dict field takes any name, and below it its own schema holds."""
    kind: Any = schema
    for part in key.split("."):
        if is_dataclass(kind):
            hints = get_type_hints(kind)
            if part not in hints:
                return False
            kind = _unwrap(hints[part])
        elif get_origin(kind) is dict:
            kind = get_args(kind)[1]
        else:
            return False
    return True


def dict_above(schema: type, key: str) -> str | None:
    """The dict field that `key` lies in, or None."""
    kind: Any = schema
    for depth, part in enumerate(parts := key.split(".")):
        kind = _unwrap(get_type_hints(kind).get(part)) if is_dataclass(kind) else None
        if get_origin(kind) is dict and depth + 1 < len(parts):
            return ".".join(parts[: depth + 1])
    return None


def nearest(key: str, known: Iterable[str]) -> str | None:
    """The known key most like `key`: one that ends alike wins, so `lr` finds `train.lr`."""
    known = list(known)
    last = key.rpartition(".")[2]
    same_end = [k for k in known if k.rpartition(".")[2] == last]
    if same_end:
        return max(same_end, key=lambda k: SequenceMatcher(None, key, k).ratio())
    if close := get_close_matches(key, known, n=1, cutoff=0.6):
        return close[0]
    ends = {k.rpartition(".")[2]: k for k in reversed(known)}
    close = get_close_matches(last, ends, n=1, cutoff=0.6)
    return ends[close[0]] if close else None


def description(schema: type, key: str) -> str:
    """What the schema's source says under a field, on one line; empty where it says nothing."""
    *parents, name = key.split(".")
    for parent in parents:
        schema = _unwrap(get_type_hints(schema)[parent])
        if not is_dataclass(schema):
            return ""
    line = [c for c in schema.__mro__ if is_dataclass(c)]
    texts = (_docstrings(Path(inspect.getfile(c))).get((c.__name__, name)) for c in line)
    return next((text for text in texts if text), "")


@cache
def _docstrings(source: Path) -> dict[tuple[str, str], str]:
    """(class, field) -> the string that stands below the field."""
    found = {}
    for node in ast.parse(source.read_text(encoding="utf-8")).body:
        if not isinstance(node, ast.ClassDef):
            continue
        for line, below in zip(node.body, node.body[1:], strict=False):
            match line, below:
                case (
                    ast.AnnAssign(target=ast.Name(id=name)),
                    ast.Expr(value=ast.Constant(value=str(text))),
                ):
                    found[node.name, name] = " ".join(text.split())
    return found


def _unwrap(kind: Any) -> Any:
    """X for `X | None`, and any other type as it is."""
    inner = [a for a in get_args(kind) if a is not NoneType]
    return inner[0] if NoneType in get_args(kind) and len(inner) == 1 else kind
