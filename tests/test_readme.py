"""Commands in README.md and docs/ exist and have valid settings, and the runs that they name are
produced by other documented commands."""

from __future__ import annotations

import json
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

import dynapix
from dynapix.conf.compose import compose, config_name
from dynapix.conf.multirun.sweep import Sweep
from dynapix.conf.runs import TRAINER_FOLDERS, run_name
from tests.conf.schemas import SCHEMAS, distinct
from tests.evaluation.chat_server import ChatServer

ROOT = Path(__file__).parents[1]
PAGES = [*sorted(ROOT.glob("*.md")), *sorted((ROOT / "docs").glob("*.md"))]
LONGEST_README = 150
"""Maximum number of lines of the README."""
PYTHON = re.compile(r"^```python\n(.*?)^```", re.MULTILINE | re.DOTALL)
LINE = re.compile(r"^    (?:accelerate launch .*|python) -m (\S+)(.*)$", re.MULTILINE)
LINES = sorted({line for page in PAGES for line in LINE.findall(page.read_text())})
COMMANDS = [(command, shlex.split(rest, comments=True)) for command, rest in LINES]
"""The command and the overrides of each line of a code block that starts a command."""


def run_folder(command: str, overrides: list[str]) -> str:
    """The run's folder below checkpoints/."""
    settings = dict(o.lstrip("+").split("=", 1) for o in overrides if "=" in o)
    return f"{config_name(command)}/{run_name(settings.get('run'), overrides)}"


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.stem)
def test_what_a_page_names_exists(page: Path) -> None:
    text = page.read_text()
    for module in re.findall(r"python -m\s+([\w.]+)", text):
        is_script = module.startswith(("benchmarks.", "research."))
        path = ROOT / f"{module.replace('.', '/')}.py"
        is_program = (ROOT / module.replace(".", "/") / "__main__.py").exists()
        is_command = module.removeprefix("dynapix.") in SCHEMAS or is_program
        assert path.exists() if is_script else is_command, module
    targets = re.findall(r"^([a-z-]+):", (ROOT / "Makefile").read_text(), re.MULTILINE)
    assert {*re.findall(r"(?:`| {4}|&& )make ([a-z-]+)", text)} <= {*targets}
    for target in re.findall(r"\]\((?!https?:)([^)#]+)", text):
        assert (page.parent / target).exists(), target
    assert page.name != "README.md" or len(text.splitlines()) <= LONGEST_README


@pytest.mark.slow
@pytest.mark.parametrize(("command", "overrides"), distinct(COMMANDS), ids=str)
def test_settings_of_a_documented_command_are_valid(command: str, overrides: list[str]) -> None:
    check = Sweep if "-m" in overrides else compose
    settings = [o.replace("=RUN", "=checkpoints/sft/exp-cot") for o in overrides if o != "-m"]
    check(command, SCHEMAS[command], settings)


def test_named_runs_are_produced_by_other_commands() -> None:
    produced = {run_folder(command, o) for command, o in COMMANDS if "-m" not in o}
    named = set()
    for command, overrides in COMMANDS:
        for override in overrides:
            key, _, value = override.partition("=")
            if key.endswith("model") and value.startswith("checkpoints/"):
                named.add(value.removeprefix("checkpoints/"))
            if (command, key) == ("evaluation.study.export", "run"):
                named.add(f"study/{value}")
            if (command, key) == ("train.export", "run"):
                product = "retriever" if "product=retriever" in overrides else "student"
                folder = value.removeprefix("checkpoints/")
                named.add(folder if folder != value else f"{TRAINER_FOLDERS[product]}/{value}")
    assert len(named) > 3
    assert named <= produced


def test_python_examples_run(micro_store, tmp_path, monkeypatch, capsys) -> None:
    # The examples load the tiny benchmark; the folder store/tiny is here a smaller one.
    (tmp_path / "store").mkdir()
    (tmp_path / "store" / "tiny").symlink_to(micro_store.folder)
    monkeypatch.chdir(tmp_path)
    server = ChatServer(lambda request: f"Answer: {'ABCD'[len(server.requests) % 4]}")
    monkeypatch.setenv("OPENAI_BASE_URL", server.url)
    monkeypatch.setenv("OPENAI_API_KEY", "none")
    monkeypatch.setenv("MPLBACKEND", "agg")
    examples = [code for page in PAGES for code in PYTHON.findall(page.read_text())]
    assert examples
    notebook = json.loads((ROOT / "examples" / "evaluate.ipynb").read_text())
    cells = [cell["source"] for cell in notebook["cells"] if cell["cell_type"] == "code"]
    examples.append("\n".join(map("".join, cells)))
    for code in examples:
        exec(compile(code, "example", "exec"), {})
    assert "Selection accuracy (%)" in capsys.readouterr().out
    assert (tmp_path / "runs" / "nearest" / "report.json").exists()
    server.stop()
    assert len(server.requests) == len(micro_store.selection("test"))
    report = json.loads((tmp_path / "runs" / "MODEL" / "report.json").read_text())
    assert report["rows"][0]["parse_rate"] == 1


@pytest.mark.slow
def test_the_documentation_builds_without_warnings(tmp_path) -> None:
    command = [sys.executable, "-m", "mkdocs", "build", "--strict", "--site-dir", str(tmp_path)]
    done = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr
    assert "min_displacement" in (tmp_path / "configuration.html").read_text()
    library = (tmp_path / "api.html").read_text()
    assert all(name in library for name in dynapix.__all__)
    # The pages load nothing from other hosts.
    for page in tmp_path.glob("*.html"):
        sources = re.findall(r'(?:src|<link[^>]+href)="(https?:[^"]*)"', page.read_text())
        assert not sources, f"{page.name}: {sources}"
