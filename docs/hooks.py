"""Hooks of mkdocs: write the configuration page, and require that the library page is complete."""

from __future__ import annotations

import json
import re
from collections.abc import Iterator
from dataclasses import MISSING, asdict, fields, is_dataclass
from pathlib import Path
from typing import Any, get_args, get_origin, get_type_hints

import dynapix
from dynapix.conf import schema
from dynapix.conf.help import description

GROUPS = {
    "benchmark": schema.BenchmarkConfig,
    "teacher": schema.TeacherConfig,
    "student": schema.StudentConfig,
    "retriever": schema.RetrieverConfig,
    "train, of a student": schema.SftTrainConfig,
    "train, of a student in distillation": schema.DistillTrainConfig,
    "train, of a student with rewards": schema.ReinforceTrainConfig,
    "train, of a retriever": schema.ContrastiveTrainConfig,
    "server": schema.ServerConfig,
}
"""Groups of settings that several commands share, by their key."""


def on_page_markdown(markdown: str, page: Any, **_: Any) -> str:
    """Add the tables of settings to the configuration page."""
    if page.file.src_uri != "configuration.md":
        return markdown
    sections = [f"\n## `{name}`\n\n{setting_table(group)}" for name, group in GROUPS.items()]
    return "\n".join([markdown, *sections])


def setting_table(group: type) -> str:
    """Return a Markdown table of the keys, defaults and descriptions of a group of settings."""
    rows = ["| key | default | meaning |", "|---|---|---|"]
    rows += [f"| `{key}` | `{default}` | {text} |" for key, default, text in settings_of(group)]
    return "\n".join(rows)


def settings_of(group: type, prefix: str = "") -> Iterator[tuple[str, str, str]]:
    types = get_type_hints(group)
    for field in fields(group):
        nested = [t for t in (types[field.name], *get_args(types[field.name])) if is_dataclass(t)]
        by_name = get_origin(types[field.name]) is dict
        if nested and not by_name:
            yield from settings_of(nested[0], f"{prefix}{field.name}.")
            continue
        made = field.default_factory() if field.default_factory is not MISSING else field.default
        text = description(group, field.name).replace("|", "\\|")
        default = json.dumps(made, default=lambda value: asdict(value))
        shown = "required" if made is MISSING or made == "???" else default
        yield f"{prefix}{field.name}", shown if len(shown) <= 60 else "see the preset", text
        if nested and by_name:
            yield from settings_of(nested[0], f"{prefix}{field.name}.NAME.")


def on_env(env: Any, config: Any, **_: Any) -> None:
    """Fail if the library page lacks a public name."""
    text = (Path(config.docs_dir) / "api.md").read_text()
    listed = set(re.findall(r"\w+", " ".join(re.findall(r"members: \[(.*)\]", text))))
    if missing := set(dynapix.__all__) - listed:
        raise SystemExit(f"docs/api.md lacks the public names {', '.join(sorted(missing))}")
