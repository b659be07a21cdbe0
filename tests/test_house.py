"""Rules for the whole repository: imports, commands, folders, error codes, package registries."""

from __future__ import annotations

import ast
import os
import re
import shutil
import subprocess
import sys
import zipfile
from collections import Counter
from pathlib import Path

import pytest

import dynapix

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
COMMANDS = sorted(
    name
    for path in MODULES
    for name in re.findall(r'^@command\("([\w.]+)"', path.read_text(), re.MULTILINE)
)
LONGEST_HELP = 50
"""Maximum number of lines of a command's help."""
LARGEST_FOLDER = 12
"""Maximum number of modules in a folder."""


def imported_names(path: Path) -> list[str]:
    """Return the modules that a file imports."""
    nodes = [*ast.walk(ast.parse(path.read_text()))]
    names = [alias.name for node in nodes if isinstance(node, ast.Import) for alias in node.names]
    return names + [node.module or "" for node in nodes if isinstance(node, ast.ImportFrom)]


def test_all_commands_are_found() -> None:
    assert {"data.build", "train.sft", "train.contrastive", "evaluation.report"} <= set(COMMANDS)
    assert len(COMMANDS) == 19


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


@pytest.mark.parametrize("path", sorted((ROOT / "data").rglob("*.py")), ids=str)
def test_rooms_of_data_import_only_from_those_before_them(path: Path) -> None:
    place = {name: k for k, names in enumerate(ROOMS) for name in names.split()}
    own = path.relative_to(ROOT / "data").parts[0].removesuffix(".py")
    if own == "__init__":
        return
    for node in ast.walk(ast.parse(path.read_text())):
        if isinstance(node, ast.ImportFrom) and (node.module or "").startswith("dynapix.data"):
            below = node.module.split(".")[2:]
            names = below[:1] or [alias.name for alias in node.names]
            for name in names:
                assert name == own or place[name] < place[own], f"{path} imports data.{name}"


def test_no_folder_is_crowded() -> None:
    modules = [*MODULES, *(ROOT / "research").rglob("*.py")]
    counts = Counter(path.parent for path in modules)
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
        if path.suffix in (".png", ".safetensors", ".parquet") or not path.is_file():
            continue
        text = path.read_text(errors="ignore")
        assert not any(host in text for host in hosts), name


@pytest.fixture(scope="module")
def site(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The content of a wheel of this project."""
    folder = tmp_path_factory.mktemp("wheel")
    listed = subprocess.run(["git", "ls-files"], cwd=ROOT, capture_output=True, text=True)
    for name in listed.stdout.splitlines():
        if (ROOT / name).exists() and not name.startswith("tests/"):
            (folder / "source" / name).parent.mkdir(parents=True, exist_ok=True)
            shutil.copy(ROOT / name, folder / "source" / name, follow_symlinks=False)
    build = [sys.executable, "-m", "uv", "build", "--quiet", "--wheel", "--out-dir", str(folder)]
    subprocess.run([*build, str(folder / "source")], check=True)
    (wheel,) = folder.glob("*.whl")
    zipfile.ZipFile(wheel).extractall(folder / "site")
    return folder / "site"


@pytest.mark.slow
def test_the_wheel_has_every_file_of_the_packages(site: Path) -> None:
    command = ["git", "ls-files", *PACKAGES]
    listed = subprocess.run(command, cwd=ROOT, capture_output=True, text=True, check=True)
    files = [name for name in listed.stdout.splitlines() if (ROOT / name).is_file()]
    assert len(files) > 400
    own = [name if name.startswith("dynapix/") else f"dynapix/{name}" for name in files]
    assert not [name for name in own if not (site / name).is_file()]
    assert not (site / "benchmarks").exists()


@pytest.mark.slow
def test_folders_of_a_user_hide_nothing_of_the_package(site: Path, tmp_path: Path) -> None:
    for name in PACKAGES[:-1]:
        (tmp_path / name).mkdir()
        (tmp_path / name / "__init__.py").write_text("raise SystemExit('of the user')")
    names = "; ".join(f"dynapix.{name}" for name in dynapix.__all__)
    code = f"import dynapix; {names}; print(dynapix.__file__)"
    env = {**os.environ, "PYTHONPATH": str(site)}
    for arguments in (["-c", code], ["-m", "dynapix"], ["-m", "dynapix.train.sft", "--help"]):
        command = [sys.executable, *arguments]
        done = subprocess.run(command, cwd=tmp_path, env=env, capture_output=True, text=True)
        assert done.returncode == 0, done.stderr
        assert arguments[0] != "-c" or done.stdout.startswith(str(site))
    for command in ("data.build", "teacher.narrate", "train.sft", "evaluation.select"):
        elsewhere = tmp_path / "elsewhere"
        elsewhere.mkdir(exist_ok=True)
        subprocess.run(
            [sys.executable, "-m", command, "--help"],
            cwd=elsewhere, env=env, check=True, capture_output=True,
        )  # fmt: skip
