"""The text of `--help`: a command's presets, and every setting with its value and description."""

from __future__ import annotations

import ast
import inspect
import json
import shutil
import sys
import textwrap
from collections.abc import Iterator
from dataclasses import asdict, fields, is_dataclass
from functools import cache
from typing import Any

from dynapix.conf.compose import OVERLAYS, compose, list_presets

COLUMN = 46
"""Column at which the descriptions of settings begin."""
ALL = "all"
"""Word after `--help` that lists every setting."""
COMMON = (
    "run", "seed", "limit", "model", "modes", "suite", "control", "runs", "items", "annotators",
    "host", "port", "public", "folder", "format", "product", "verify", "frames", "pool",
    "examples", "gpus", "routes", "images", "benchmark.name", "benchmark.scenes", "benchmark.seed",
    "benchmark.folder", "benchmark.renderer", "teacher.url", "teacher.model", "teacher.attempts",
    "teacher.predicates", "teacher_model", "teacher_server.url", "sampling_server.url",
    "server.url", "server.model", "student.model", "student.quantization", "student.lora.rank",
    "student.frames", "student.image_size", "student.temperature", "retriever.model",
    "retriever.widths", "matcher.model", "batch", "workers",
)  # fmt: skip
"""Keys that users change often; `--help` lists those of the command."""
TRAINING = (
    "train.regime", "train.beta", "train.responses", "train.rewards.answer", "train.rewards.truth",
    "train.rewards.following", "train.rewards.no_numbers", "train.rewards.form", "train.lr",
    "train.epochs", "train.max_steps", "train.batch", "train.micro_batch", "train.mini_batch",
    "train.hard_negatives", "train.precision", "train.evaluations", "train.generated_items",
    "train.report_to", "train.pools",
)  # fmt: skip
"""Further such keys, which are listed for the commands that train. Other commands use few of
them."""


def help_text(command: str, schema: type, overrides: list[str]) -> str:
    """Help of a command, with the values that result from `overrides`. Raises SettingsError.

    It lists the settings of `COMMON` and `TRAINING`, or every setting if `overrides` contain `ALL`.
    """
    settings = compose(command, schema, [o for o in overrides if o != ALL])
    entries = list(_entries(settings))
    keys = (*COMMON, *TRAINING) if command.startswith("train.") else COMMON
    common = [entry for entry in entries if entry[0] in keys]
    purpose = (sys.modules["__main__"].__doc__ or "").strip()
    groups = list_presets(command, schema)
    presets = [f"  {g}: {', '.join(groups[g])}" for g in groups if g not in OVERLAYS]
    overlays = [f"  {g}: {', '.join(groups[g])}" for g in groups if g in OVERLAYS]
    lines = [f"python -m {command} [KEY=VALUE ...]", "", *([purpose, ""] if purpose else [])]
    lines += ["Presets, chosen with GROUP=NAME:", *presets, ""] if presets else []
    lines += ["Overlays, added with +GROUP=NAME:", *overlays, ""] if overlays else []
    lines += ["Settings, set with KEY=VALUE; with -m, KEY=VALUE,VALUE sweeps over values:"]
    if ALL in overrides:
        for entry in entries:
            lines += _setting_lines(*entry)
    else:
        for key, value, text in common:
            brief = textwrap.shorten(text, _description_width(), placeholder=" ...")
            lines += _setting_lines(key, value, brief)
        more = len(entries) - len(common)
        lines += [f"--help {ALL} lists the other {more} settings, and describes them in full."]
    lines += ["", "-m runs a sweep, one process per job; --cfg job prints the settings and exits."]
    return "\n".join(lines)


def _entries(settings: Any, group: str = "") -> Iterator[tuple[str, Any, str]]:
    """Yield the key, the value and the description of each setting."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            yield from _entries(value, f"{group}{field.name}.")
        else:
            yield f"{group}{field.name}", value, description(type(settings), field.name)


def _description_width() -> int:
    return max(100, shutil.get_terminal_size().columns) - COLUMN


def _setting_lines(key: str, value: Any, text: str) -> Iterator[str]:
    shown = textwrap.shorten(json.dumps(value, default=asdict), 60, placeholder=" ...")
    first, *rest = textwrap.wrap(text, _description_width()) or [""]
    yield f"{f'  {key} = {shown}':<{COLUMN - 2}}  {first}".rstrip()
    yield from (f"{'':<{COLUMN}}{line}" for line in rest)


def description(schema: type, name: str) -> str:
    """Return the docstring below a field of a schema, or below the field of the same name in a base
    class; empty if there is none."""
    schemas = [kind for kind in schema.__mro__ if is_dataclass(kind)]
    return next((text for kind in schemas if (text := _docstrings(kind).get(name))), "")


@cache
def _docstrings(schema: type) -> dict[str, str]:
    """Return the docstrings of the fields that a dataclass defines itself, each joined to one
    line."""
    [node] = ast.parse(textwrap.dedent(inspect.getsource(schema))).body
    assert isinstance(node, ast.ClassDef)
    return {
        line.target.id: " ".join(text.split())
        for line, below in zip(node.body, node.body[1:], strict=False)
        if isinstance(line, ast.AnnAssign) and isinstance(line.target, ast.Name)
        if isinstance(below, ast.Expr) and isinstance(below.value, ast.Constant)
        if isinstance(text := below.value.value, str)
    }
