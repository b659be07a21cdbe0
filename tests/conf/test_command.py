"""A command from its command line: real processes, with a toy for `main`."""

import json
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from conf.entry import _sentences

GO_ON = "once that is mended, the same command goes on where it was\n"


@pytest.fixture
def room(tmp_path: Path) -> Path:
    shutil.copy(Path(__file__).with_name("toy.py"), tmp_path)
    return tmp_path


def toy(room: Path, *arguments: str) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "toy", *arguments], cwd=room, capture_output=True, text=True
    )


def test_a_run_leaves_its_record_and_can_be_run_again(room):
    done = toy(room, "x=2", "workers=1")
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == "x is 2.0 in checkpoints/toy/x-2\n"
    folder = room / "checkpoints/toy/x-2"
    assert {p.name for p in folder.iterdir()} == {
        "config.yaml",
        "metrics.json",
        "run.json",
        "run.log",
    }
    assert json.loads((folder / "metrics.json").read_text())["loss"] == 4
    assert json.loads((folder / "run.json").read_text())["overrides"] == ["x=2", "workers=1"]
    assert "x is 2.0" in (folder / "run.log").read_text()
    assert toy(room, "x=2").returncode == 0
    refused = toy(room, "x=3", "run=x-2")
    assert refused.returncode == 2
    assert "error: checkpoints/toy/x-2 holds a run with other settings: x is 2.0 there" in (
        refused.stderr
    )


def test_a_run_that_made_nothing_takes_other_settings(room):
    assert toy(room, "end=mistake", "run=one").returncode == 1
    assert toy(room, "x=3", "run=one").returncode == 0
    folder = room / "checkpoints/toy/one"
    assert json.loads((folder / "metrics.json").read_text())["loss"] == 9
    record = json.loads((folder / "run.json").read_text())
    assert (record["overrides"], record["earlier_starts"]) == (["x=3", "run=one"], [])


@pytest.mark.parametrize(
    ("arguments", "code", "said"),
    [
        (["end=mistake"], 1, "error: this end is a mistake: set end=well  [user-error]\n"),
        (["end=disk"], 1, f"error: some/file: No space left on device; {GO_ON}"),
        (["end=interrupt"], 130, "interrupted; run the same command again to go on\n"),
        (
            ["+teacher.sed=1"],
            2,
            "+teacher.sed: toy has no such key, did you mean teacher.seed?  [invalid-setting]\n",
        ),
        (["checkpoints=toy.py"], 1, f"error: toy.py/toy/default: Not a directory; {GO_ON}"),
    ],
)
def test_a_mistake_is_a_sentence(room, arguments, code, said):
    done = toy(room, *arguments)
    assert done.returncode == code
    assert done.stderr.endswith(said)
    assert "Traceback" not in done.stderr


def test_a_librarys_own_error_on_a_full_disk_is_a_sentence(monkeypatch, tmp_path, capsys):
    with pytest.raises(RuntimeError), _sentences(str(tmp_path)):
        raise RuntimeError("unexpected pos 304000 vs 303892")
    full = shutil.disk_usage(tmp_path)._replace(free=0)
    monkeypatch.setattr("conf.entry.shutil.disk_usage", lambda _: full)
    with pytest.raises(SystemExit) as ended, _sentences(str(tmp_path)):
        raise RuntimeError("unexpected pos 304000 vs 303892")
    assert ended.value.code == 1
    assert capsys.readouterr().err == f"error: {tmp_path}: No space left on device; {GO_ON}"


def test_a_bug_keeps_its_traceback(room):
    done = toy(room, "end=bug")
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert done.stderr.endswith("ValueError: a bug\n")


def test_help_tells_the_settings_and_imports_nothing_heavy(room):
    script = (
        "import runpy, sys; sys.argv = ['toy', '--help', 'x=5']\n"
        "runpy.run_module('toy', run_name='__main__', alter_sys=True)\n"
        "heavy = {'torch', 'transformers', 'pybullet', 'matplotlib'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = subprocess.run(
        [sys.executable, "-c", script], cwd=room, capture_output=True, text=True, check=True
    )
    assert "A toy that squares x." in done.stdout
    assert "teacher: qwen3_32b, template" in done.stdout
    assert any(
        line.split() == ["x", "=", "5.0", "How", "much."] for line in done.stdout.split("\n")
    )
    assert not (room / "checkpoints").exists()


def test_help_may_be_read_in_part(room):
    command = "set -o pipefail; python -m toy --help | true"
    done = subprocess.run(
        ["bash", "-c", command.replace("python", sys.executable)], cwd=room, capture_output=True
    )
    assert (done.returncode, done.stderr) == (0, b"")
