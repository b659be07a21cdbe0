"""Rules for the whole repository: imports, commands, folders, error codes, package registries."""

from __future__ import annotations

import ast
import re
import subprocess
import sys
import tomllib
from collections import Counter
from pathlib import Path

import pytest

ROOT = Path(__file__).parent.parent
PACKAGES = ("conf", "data", "teacher", "models", "train", "evaluation", "dynapix")
"""The packages in the order of the data flow: each imports only from itself and those before it."""
TOP = {"data/export.py", "evaluation/report.py"}
"""Commands that show or write what several packages make. Nothing imports them, so they import from
all."""
HEAVY = {"torch", "transformers", "sentence_transformers", "pybullet", "matplotlib", "datasets"}
"""Packages that take long to import."""
MODULES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
COMMANDS = sorted(
    name
    for path in MODULES
    for name in re.findall(r'^@command\("([\w.]+)"', path.read_text(), re.MULTILINE)
)
LONGEST_HELP = 50
"""Maximum number of lines of a command's help."""
LARGEST_FOLDER = 14
"""Maximum number of modules in a folder."""


def test_all_commands_are_found() -> None:
    assert {"data.build", "train.sft", "train.contrastive", "evaluation.report"} <= set(COMMANDS)
    assert len(COMMANDS) == 20


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_from_those_before_them(package: str) -> None:
    allowed = set(PACKAGES[: PACKAGES.index(package) + 1])
    tops = {name.removesuffix(".py").replace("/", ".") for name in TOP}
    for path in (ROOT / package).rglob("*.py"):
        name = path.relative_to(ROOT).as_posix()
        for node in ast.walk(ast.parse(path.read_text())):
            names = []
            if isinstance(node, ast.Import):
                names = [alias.name for alias in node.names]
            elif isinstance(node, ast.ImportFrom):
                names = [node.module or ""]
            assert not tops & {*names}, f"{name} imports a command"
            roots = {name.split(".")[0] for name in names} & {*PACKAGES, "benchmarks", "tests"}
            known = {*PACKAGES} if name in TOP else allowed
            assert roots <= known, f"{name} imports {roots - known}"


ROOMS = (
    "records", "seeded_order", "versions", "store", "parallel", "sim", "oracle", "render",
    "sources", "frames", "items", "checks", "publish", "build", "export gallery statistics",
)  # fmt: skip
"""The modules and folders of `data/` in the order of the data flow, like `PACKAGES`. The commands
at the end import nothing from each other."""


@pytest.mark.parametrize("path", sorted((ROOT / "data").rglob("*.py")), ids=str)
def test_rooms_of_data_import_only_from_those_before_them(path: Path) -> None:
    place = {name: k for k, names in enumerate(ROOMS) for name in names.split()}
    own = path.relative_to(ROOT / "data").parts[0].removesuffix(".py")
    if own == "__init__":
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "data":
            below = node.module.split(".")[1:]
            names = below[:1] or [alias.name for alias in node.names]
            for name in names:
                assert name == own or place[name] < place[own], f"{path} imports data.{name}"


def test_no_folder_is_crowded() -> None:
    counts = Counter(path.parent for path in MODULES)
    crowded = {str(f.relative_to(ROOT)): n for f, n in counts.items() if n > LARGEST_FOLDER}
    assert not crowded


@pytest.mark.parametrize("package", PACKAGES)
def test_every_user_error_has_a_code(package: str) -> None:
    for path in (ROOT / package).rglob("*.py"):
        for node in ast.walk(ast.parse(path.read_text())):
            if (
                isinstance(node, ast.Call)
                and isinstance(node.func, ast.Name)
                and node.func.id == "UserError"
            ):
                has_code = len(node.args) > 1 or any(k.arg == "code" for k in node.keywords)
                assert has_code, f"{path.relative_to(ROOT)}:{node.lineno}"


@pytest.mark.slow
@pytest.mark.parametrize("command", COMMANDS)
def test_help_imports_nothing_heavy(command: str) -> None:
    code = (
        f"import runpy, sys; sys.argv = [{command!r}, '--help']\n"
        f"runpy.run_module({command!r}, run_name='__main__')\n"
        f"assert not {HEAVY!r} & set(sys.modules), sorted({HEAVY!r} & set(sys.modules))"
    )
    done = subprocess.run(
        [sys.executable, "-c", code], cwd=ROOT, capture_output=True, text=True, timeout=60
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout.startswith(f"python -m {command} [KEY=VALUE ...]")
    assert len(done.stdout.splitlines()) <= LONGEST_HELP


def test_no_file_names_a_package_registry() -> None:
    hosts = ["pypi" + ".org", "pythonhosted" + ".org", "registry.npm" + "js"]
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        path = ROOT / name
        if path.suffix in (".png", ".safetensors", ".parquet") or not path.exists():
            continue
        text = path.read_text(errors="ignore")
        assert not any(host in text for host in hosts), name


def test_the_wheel_has_every_file_of_the_packages() -> None:
    settings = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["setuptools"]
    shipped = {
        path
        for package, patterns in settings["package-data"].items()
        for pattern in patterns
        for path in (ROOT / package.replace(".", "/")).glob(pattern)
    }
    listed = subprocess.run(
        ["git", "ls-files", *PACKAGES], cwd=ROOT, capture_output=True, text=True, check=True
    )
    files = {ROOT / name for name in listed.stdout.splitlines() if not name.endswith(".py")}
    assert len(files) > 50
    assert not files - shipped
