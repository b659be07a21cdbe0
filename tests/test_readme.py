"""The commands in README.md and docs/ have valid settings, and other commands there produce the
runs that they name."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from conf.compose import preflight
from conf.multirun.sweep import Sweep
from conf.runs import run_name
from tests.conf.test_presets import SCHEMAS

ROOT = Path(__file__).parents[1]
PAGES = [ROOT / "README.md", *sorted((ROOT / "docs").glob("*.md"))]
LINE = re.compile(r"^    python -m ((?:data|teacher|train|evaluation)\.\S+)(.*)$", re.MULTILINE)
TYPED = sorted({typed for page in PAGES for typed in LINE.findall(page.read_text())})
COMMANDS = [(command, shlex.split(rest, comments=True)) for command, rest in TYPED]


def run_folder(command: str, overrides: list[str]) -> str:
    """The run's folder below checkpoints/."""
    settings = dict(o.lstrip("+").split("=", 1) for o in overrides if "=" in o)
    kind = {"evaluation.study.export": "export_study"}.get(command, command.rpartition(".")[2])
    return f"{kind}/{run_name(settings.get('run'), overrides)}"


@pytest.mark.slow
@pytest.mark.parametrize(("command", "overrides"), COMMANDS, ids=lambda v: str(v).replace("/", "-"))
def test_settings_of_a_documented_command_are_valid(command: str, overrides: list[str]) -> None:
    check = Sweep if "-m" in overrides else preflight
    settings = [o.replace("=RUN", "=checkpoints/sft/exp-cot") for o in overrides if o != "-m"]
    if command in SCHEMAS:
        check(command, SCHEMAS[command], settings)


def test_named_runs_are_produced_by_other_commands() -> None:
    produced = {run_folder(command, o) for command, o in COMMANDS if "-m" not in o}
    produced |= {"sft/search"}
    named = set()
    for command, overrides in COMMANDS:
        for override in overrides:
            key, _, value = override.partition("=")
            if key == "model" and value.startswith("checkpoints/"):
                named.add(value.removeprefix("checkpoints/"))
            if (command, key) == ("evaluation.study.export", "run"):
                named.add(f"study/{value}")
    assert len(named) > 3
    assert named <= produced


def test_link_targets_exist() -> None:
    for page in PAGES:
        for target in re.findall(r"\]\((?!https?:)([^)#]+)", page.read_text()):
            assert (page.parent / target).exists(), f"{page.name}: {target}"
