"""Rules for the whole repository: imports, commands, folders, error codes, package registries."""

from __future__ import annotations

import ast
import json
import os
import shutil
import subprocess
import sys
import zipfile
from collections import Counter
from pathlib import Path

import pytest

import dynapix
from tests.children import run_child
from tests.conf.schemas import SCHEMAS

ROOT = Path(__file__).parent.parent
PACKAGES = ("conf", "data", "teacher", "models", "train", "evaluation", "dynapix")
"""The packages in the order of the data flow: each imports only from itself and those before it.

`dynapix/` has a link to each of the others, and code imports them through it: a folder `data` of
the user's cannot hide `dynapix.data`."""
TOP = {"data/export.py", "evaluation/report.py"}
"""Commands that show or write what several packages make. Nothing imports them, so they import from
all."""
HEAVY = {"torch", "transformers", "sentence_transformers", "pybullet", "matplotlib", "datasets"}
"""Packages that take long to import."""
MODULES = [path for package in PACKAGES for path in sorted((ROOT / package).rglob("*.py"))]
SHORT = ("data", "teacher", "train", "evaluation")
"""Packages that a wheel has at its top too, for the short names of commands."""
COMMANDS = sorted(SCHEMAS)
LONGEST_HELP = 50
"""Maximum number of lines of a command's help."""
LARGEST_FOLDER = 12
"""Maximum number of modules in a folder."""


def imported_names(path: Path) -> list[str]:
    """Return the modules that a file imports."""
    nodes = [*ast.walk(ast.parse(path.read_text()))]
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    return names + [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_import_only_from_those_before_them(package: str) -> None:
    allowed = set(PACKAGES[: PACKAGES.index(package) + 1])
    tops = {name.removesuffix(".py").replace("/", ".") for name in TOP}
    for path in (ROOT / package).rglob("*.py"):
        name = path.relative_to(ROOT).as_posix()
        names = imported_names(path)
        foreign = {*PACKAGES[:-1], "benchmarks", "research", "tests"}
        assert not foreign & {each.split(".")[0] for each in names}, f"{name}: {names}"
        below = [each.removeprefix("dynapix.") for each in names if each.startswith("dynapix")]
        assert not tops & {*below}, f"{name} imports a command"
        parts = {each.split(".")[0] for each in below}
        roots = {part if part in PACKAGES else "dynapix" for part in parts}
        known = {*PACKAGES} if name in TOP else allowed
        assert roots <= known, f"{name} imports {roots - known}"


ROOMS = (
    "records", "seeded_order", "versions", "store", "parallel", "sim", "oracle", "render",
    "sources", "frames", "items", "checks", "publish", "build", "export gallery statistics",
)  # fmt: skip
"""The modules and folders of `data/` in the order of the data flow, like `PACKAGES`. The commands
at the end import nothing from each other."""


def test_rooms_of_data_import_only_from_those_before_them() -> None:
    place = {name: k for k, names in enumerate(ROOMS) for name in names.split()}
    for path in sorted((ROOT / "data").rglob("*/*.py")):
        own = path.relative_to(ROOT / "data").parts[0].removesuffix(".py")
        for name in imported_names(path):
            assert name != "dynapix.data", f"{path} names no room"
            if name.startswith("dynapix.data."):
                room = name.split(".")[2]
                assert room == own or place[room] < place[own], f"{path} imports {name}"


def test_no_folder_is_crowded() -> None:
    modules = [*MODULES, *(ROOT / "research").rglob("*.py")]
    counts = Counter(path.parent for path in modules)
    crowded = {str(f.relative_to(ROOT)): n for f, n in counts.items() if n > LARGEST_FOLDER}
    assert not crowded


def test_every_user_error_has_a_code() -> None:
    for path in MODULES:
        calls = [n for n in ast.walk(ast.parse(path.read_text())) if isinstance(n, ast.Call)]
        for call in calls:
            if isinstance(call.func, ast.Name) and call.func.id == "UserError":
                has_code = len(call.args) > 1 or any(k.arg == "code" for k in call.keywords)
                assert has_code, f"{path.relative_to(ROOT)}:{call.lineno}"


HELP = f"""
import json, runpy, sys
from contextlib import redirect_stdout
from io import StringIO
for command in {COMMANDS!r}:
    sys.argv = [command, "--help"]
    with redirect_stdout(StringIO()) as shown:
        runpy.run_module(command, run_name="__main__", alter_sys=True)
    print(json.dumps([command, shown.getvalue(), sorted({HEAVY!r} & set(sys.modules))]))
"""


@pytest.mark.slow
def test_help_imports_nothing_heavy() -> None:
    done = run_child([sys.executable, "-c", HELP], check=True, cwd=ROOT)
    rows = [json.loads(line) for line in done.stdout.splitlines()]
    assert [command for command, _, _ in rows] == COMMANDS
    for command, text, heavy in rows:
        assert not heavy, f"{command} imports {heavy}"
        path = ROOT / f"{command.replace('.', '/')}.py"
        module = path if path.exists() else path.with_suffix("") / "__main__.py"
        purpose = ast.get_docstring(ast.parse(module.read_text()))
        assert text.startswith(f"python -m {command} [KEY=VALUE ...]\n\n{purpose}\n"), command
        assert len(text.splitlines()) <= LONGEST_HELP


def test_no_file_names_a_package_registry() -> None:
    hosts = ["pypi" + ".org", "pythonhosted" + ".org", "registry.npm" + "js"]
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        path = ROOT / name
        if path.suffix in (".png", ".safetensors", ".parquet") or not path.is_file():
            continue
        text = path.read_text(errors="ignore")
        assert not any(host in text for host in hosts), name


@pytest.mark.slow
def test_the_wheel_has_every_file_and_no_folder_of_a_user_hides_one(tmp_path: Path) -> None:
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    names = [name for name in listed.stdout.splitlines() if not name.startswith("tests/")]
    for name in (name for name in names if os.path.lexists(ROOT / name)):
        (tmp_path / "source" / name).parent.mkdir(parents=True, exist_ok=True)
        shutil.copy(ROOT / name, tmp_path / "source" / name, follow_symlinks=False)
    build = [sys.executable, "-m", "uv", "build", "--quiet", "--wheel", "--out-dir", tmp_path]
    run_child([*build, tmp_path / "source"], check=True)
    (wheel,) = tmp_path.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(site := tmp_path / "site")
    files = [n for n in names if n.split("/")[0] in PACKAGES and (ROOT / n).is_file()]
    assert len(files) > 400
    own = [name if name.startswith("dynapix/") else f"dynapix/{name}" for name in files]
    assert not [name for name in own if not (site / name).is_file()]
    assert not (site / "benchmarks").exists()

    for name in PACKAGES[:-1]:
        (tmp_path / "user" / name).mkdir(parents=True)
        (tmp_path / "user" / name / "__init__.py").write_text("raise SystemExit('of the user')")
    every = "; ".join(f"dynapix.{name}" for name in dynapix.__all__)
    code = f"import dynapix; {every}; print(dynapix.__file__)"
    env = {**os.environ, "PYTHONPATH": str(site)}
    # Without such folders, commands have their short names too.
    for place, arguments, shown in (
        ("user", ["-c", code], str(site)),
        ("user", ["-m", "dynapix.train.sft", "--help"], "python -m train.sft "),
        (".", ["-m", "data.build", "--help"], "python -m data.build "),
    ):
        done = run_child([sys.executable, *arguments], check=True, cwd=tmp_path / place, env=env)
        assert done.stdout.startswith(shown)
    assert all((site / name / "__init__.py").exists() for name in SHORT)
