"""What README.md tells one to type composes, and names runs that its other commands make."""

from __future__ import annotations

import re
import shlex
from pathlib import Path

import pytest

from conf.compose import preflight
from conf.runs import TRAINERS, run_name
from tests.conf.test_presets import SCHEMAS

README = (Path(__file__).parents[1] / "README.md").read_text()
TYPED = re.findall(r"^    python -m ((?:data|teacher|train|evaluation)\.\S+)(.*)$", README, re.M)
TOLD = [(command, shlex.split(rest, comments=True)) for command, rest in TYPED]


def folder_of(command: str, overrides: list[str]) -> str:
    """Where a command's run is found."""
    told = dict(o.lstrip("+").split("=", 1) for o in overrides if "=" in o)
    kind = {"evaluation.study.export": "export_study"}.get(command, command.rpartition(".")[2])
    return f"{kind}/{run_name(told.get('run'), overrides)}"


@pytest.mark.slow
@pytest.mark.parametrize(("command", "overrides"), TOLD, ids=lambda v: str(v).replace("/", "-"))
def test_it_composes(command: str, overrides: list[str]) -> None:
    sweep = "-m" in overrides
    # What stands for a reader's own.
    given = [o.replace("=RUN", "=checkpoints/sft/exp-cot") for o in overrides if o != "-m"]
    if command in SCHEMAS:
        preflight(command, SCHEMAS[command], given, sweep)


def test_runs_that_are_named_are_made() -> None:
    made = {folder_of(command, overrides) for command, overrides in TOLD if "-m" not in overrides}
    named = set()
    for command, overrides in TOLD:
        for override in overrides:
            key, _, value = override.partition("=")
            if key == "model" and value.startswith("checkpoints/"):
                named.add(value.removeprefix("checkpoints/"))
            if (command, key) == ("evaluation.study.export", "run"):
                named.add(f"study/{value}")
            if (command, key) == ("train.export", "run"):
                named.add(f"{TRAINERS['student']}/{value}")
    assert len(named) > 3
    assert named <= made
