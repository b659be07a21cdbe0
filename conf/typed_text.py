"""Texts that look like numbers: a setting that is a text keeps what the user typed.

Hydra's grammar reads `1e-4`, `2026_11_29` and `true` as a number or a truth value, before it knows
that a setting is a text: the name `1e-4` would become `0.0001`.
"""

from __future__ import annotations

import re
from dataclasses import is_dataclass
from typing import Any, get_args, get_origin, get_type_hints

from hydra.core.override_parser.overrides_parser import OverridesParser

# A word between the brackets and commas of a value. Quoted texts and ranges match without a word.
WORDS = re.compile(
    r""""(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|(?:range|interval|tag)\(.*\)"""
    r"|(?P<before>^\s*|[\[,(]\s*)(?P<word>[^\s\[\](){},'\"]+)(?=\s*(?:[\]),]|$))"
)


def adapt_override(override: str, schema: type) -> str:
    """Return an override that Hydra reads as the schema means it: the texts that look like numbers
    are quoted, as are paths that begin with `~`."""
    key, equals, value = override.partition("=")
    hint: Any = schema
    for name in key.lstrip("+").split("."):
        if get_origin(hint) is dict:
            hint = get_args(hint)[1]
        else:
            groups = [t for t in (hint, *get_args(hint)) if is_dataclass(t)]
            hint = get_type_hints(groups[0]).get(name) if groups else None
    return f"{key}{equals}{WORDS.sub(_quote, value)}" if is_text(hint) else override


def is_text(hint: Any) -> bool:
    """Return whether a setting of this type is a text, a list of texts, or null."""
    if get_origin(hint) is dict:
        return False
    return hint is str or any(map(is_text, get_args(hint)))


def _quote(match: re.Match[str]) -> str:
    word = match["word"]
    if word is None or not (word.startswith("~") or _is_number(word)):
        return match[0]
    return f"{match['before']}'{word}'"


def _is_number(word: str) -> bool:
    try:
        return isinstance(OverridesParser.create().parse_rule(word, "primitive"), int | float)
    except Exception:  # Hydra refuses the word, and names the override in its error.
        return False
