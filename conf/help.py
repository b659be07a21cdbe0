"""What `--help` prints: the presets to choose from, and every key with its value and meaning."""

from __future__ import annotations

import json
import sys
from typing import Any

from omegaconf import OmegaConf

from conf.compose import OVERLAYS, compose, options
from conf.keys import description, keys


def help_text(command: str, schema: type, overrides: list[str]) -> str:
    """The help of a command, with the values that `overrides` lead to. Raises SettingsError."""
    settings = OmegaConf.structured(compose(command, schema, overrides))
    purpose = (sys.modules["__main__"].__doc__ or "").strip()
    lines = [f"python -m {command} [KEY=VALUE ...]", "", *([purpose, ""] if purpose else [])]
    groups = options(command, schema)
    lines += ["Presets, chosen as GROUP=NAME:"]
    lines += [f"  {g}: {', '.join(groups[g])}" for g in groups if g not in OVERLAYS]
    overlays = [f"  {g}: {', '.join(groups[g])}" for g in groups if g in OVERLAYS]
    lines += ["Overlays, laid over as +GROUP=NAME:", *overlays] if overlays else []
    lines += ["", "Settings, changed as KEY=VALUE, or as KEY=VALUE,VALUE with -m for a sweep:"]
    lines += [_line(schema, settings, key) for key in keys(schema) if _is_leaf(settings, key)]
    lines += ["", "-m runs a sweep, one process a job; --cfg job prints the settings and ends."]
    return "\n".join(lines)


def _is_leaf(settings: Any, key: str) -> bool:
    parent = OmegaConf.select(settings, key.rpartition(".")[0]) if "." in key else settings
    if parent is None:
        return False
    value = OmegaConf.select(settings, key)
    return not OmegaConf.is_dict(value) or OmegaConf.get_type(value) is dict


def _line(schema: type, settings: Any, key: str) -> str:
    value = OmegaConf.select(settings, key)
    shown = json.dumps(OmegaConf.to_container(value) if OmegaConf.is_config(value) else value)
    if len(shown) > 60:
        shown = shown[:57] + "..."
    text = f"  {key} = {shown}"
    said = description(schema, key)
    return f"{text:<44}  {said}".rstrip()
