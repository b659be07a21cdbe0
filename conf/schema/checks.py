"""Checks that several groups of settings share; each returns one sentence per invalid setting.

`group` is the prefix of a key as the user types it, such as ``"train."``.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any
from urllib.parse import urlsplit

from conf.runs import is_run_name, resolve_run_name


def is_url(text: str) -> bool:
    """Whether `text` is a complete http or https address."""
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and parts.port != 0 and " " not in text
    except ValueError:
        return False


def check_minimum(cfg: Any, group: str, least: Mapping[str, float]) -> list[str]:
    """Settings below their least value; null passes."""
    values = {name: getattr(cfg, name) for name in least}
    return [
        f"{group}{name}={value} must be {least[name]} or more"
        for name, value in values.items()
        if value is not None and value < least[name]
    ]


def check_positive(cfg: Any, group: str, names: Sequence[str]) -> list[str]:
    """Settings that are not above 0."""
    values = {name: getattr(cfg, name) for name in names}
    return [f"{group}{name}={v} must be above 0" for name, v in values.items() if not v > 0]


def check_fraction(cfg: Any, group: str, names: Sequence[str]) -> list[str]:
    """Settings outside [0, 1)."""
    return [
        f"{group}{name}={getattr(cfg, name)} must be 0 or more and below 1"
        for name in names
        if not 0 <= getattr(cfg, name) < 1
    ]


def check_share(cfg: Any, group: str, names: Sequence[str]) -> list[str]:
    """Settings outside (0, 1]."""
    return [
        f"{group}{name}={getattr(cfg, name)} must be above 0 and at most 1"
        for name in names
        if not 0 < getattr(cfg, name) <= 1
    ]


def check_options(cfg: Any, group: str, options: Mapping[str, Sequence[str | None]]) -> list[str]:
    """Settings whose value is not one of their options."""
    return [
        f"{group}{name}={getattr(cfg, name)}: the options are {', '.join(o or 'null' for o in all)}"
        for name, all in options.items()
        if getattr(cfg, name) not in all
    ]


def check_choices(name: str, chosen: Sequence[str] | None, options: Sequence[str]) -> list[str]:
    """A list that is empty, repeats a value or has one that is not an option; null passes."""
    if chosen is None or (chosen and len(set(chosen)) == len(chosen) and set(chosen) <= {*options}):
        return []
    return [f"{name}={chosen}: give one or more of {', '.join(options)}, each once"]


def check_run(run: str, folder: str) -> list[str]:
    """A `run` that is neither the name of a run in `folder` nor a folder inside it."""
    if is_run_name(resolve_run_name(run, folder)):
        return []
    return [
        f"run={run} is not a run in {folder}: give its name or its folder, and "
        "checkpoints=FOLDER if the runs are elsewhere"
    ]
