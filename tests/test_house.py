"""Laws of the whole tree."""

from __future__ import annotations

import ast
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
FLOW = ("conf", "data", "teacher", "models", "train", "evaluation")
COMMANDS = (
    "data.build",
    "data.statistics",
    "data.export",
    "data.gallery",
    "teacher.narrate",
    "teacher.serve",
    "train.sft",
    "train.contrastive",
    "train.export",
    "evaluation.select",
    "evaluation.retrieve",
    "evaluation.two_stage",
    "evaluation.report",
    "evaluation.study",
    "evaluation.study.export",
)
HEAVY = {"torch", "transformers", "sentence_transformers", "pybullet", "matplotlib", "datasets"}


@pytest.mark.parametrize("package", FLOW)
def test_packages_import_only_from_their_left(package: str) -> None:
    allowed = set(FLOW[: FLOW.index(package) + 1])
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            roots = {name.split(".")[0] for name in names} & set(FLOW)
            assert roots <= allowed, f"{path.relative_to(ROOT)} imports {roots - allowed}"


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_help_imports_nothing_heavy(command: str) -> None:
    code = (
        f"import runpy, sys; sys.argv = [{command!r}, '--help']\n"
        f"runpy.run_module({command!r}, run_name='__main__')\n"
        f"assert not {HEAVY!r} & set(sys.modules), sorted({HEAVY!r} & set(sys.modules))"
    )
    shown = subprocess.run([sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True)
    assert shown.returncode == 0, shown.stderr
    assert shown.stdout.startswith(f"python -m {command} [KEY=VALUE ...]")


def test_no_file_names_a_package_registry() -> None:
    needles = ["pypi" + ".org", "pythonhosted" + ".org", "registry.npm" + "js"]
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        path = ROOT / name
        if path.suffix in (".png", ".safetensors") or not path.exists():
            continue
        text = path.read_text(errors="ignore")
        assert not any(needle in text for needle in needles), name
