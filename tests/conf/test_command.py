"""The toy command as a process: the files of its run, its exit status and its error messages."""

import importlib
import json
import shutil
import sys

import pytest
import yaml

from dynapix.conf.failures import report_failures
from tests.children import run_child
from tests.conf import toy
from tests.conf.toy_process import run_toy

RESUME = "fix this and run the same command again to resume  [file-error]\n"


def test_run_writes_its_record_and_can_be_repeated(folder):
    done = run_toy(folder, "x=2", "workers=1")
    assert (done.returncode, done.stdout) == (0, "")
    assert done.stderr == "x is 2.0 in checkpoints/toy/x-2\n"
    run = folder / "checkpoints/toy/x-2"
    files = {".lock", "config.yaml", "metrics.json", "run.json", "run.log"}
    assert {p.name for p in run.iterdir()} == files
    assert json.loads((run / "metrics.json").read_text())["loss"] == 4
    assert json.loads((run / "run.json").read_text())["overrides"] == ["x=2", "workers=1"]
    assert "x is 2.0" in (run / "run.log").read_text()
    assert run_toy(folder, "x=2").returncode == 0
    refused = run_toy(folder, "x=3", "run=x-2")
    assert refused.returncode == 2
    assert "[other-settings]" in refused.stderr


def test_unfinished_run_without_results_accepts_other_settings(folder):
    assert run_toy(folder, "end=mistake", "run=one").returncode == 1
    assert run_toy(folder, "x=3", "run=one").returncode == 0
    run = folder / "checkpoints/toy/one"
    assert json.loads((run / "metrics.json").read_text())["loss"] == 9
    record = json.loads((run / "run.json").read_text())
    assert (record["overrides"], record["earlier_starts"]) == (["x=3", "run=one"], [])


@pytest.mark.parametrize(
    ("arguments", "status", "end"),
    [
        (["end=mistake"], 1, "error: this end is a mistake: set end=well  [toy-mistake]\n"),
        (["end=disk"], 1, f"error: some/file: No space left on device; {RESUME}"),
        (["end=interrupt"], 130, "interrupted; run the same command again to resume\n"),
        (["+teacher.sed=1"], 2, "did you mean teacher.seed?  [unknown-key]\n"),
        (["checkpoints=toy.py"], 1, f"error: toy.py/toy/default: Not a directory; {RESUME}"),
    ],
)
def test_failed_command_prints_no_traceback(folder, arguments, status, end):
    done = run_toy(folder, *arguments)
    assert done.returncode == status
    assert done.stderr.endswith(end)
    assert "Traceback" not in done.stderr


@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["-m", "--cfg", "job"], "conflicting-options"),
        (["--resolve"], "conflicting-options"),
        (["--cfg", "job", "--package", "x"], "unknown-key"),
        (["+sweep=lr_rank"], "needs-multirun"),
        (["--config-dir", "folder"], "unsupported-option"),
        (["-cn", "other"], "unsupported-option"),
    ],
)
def test_invalid_options_are_named(monkeypatch, capsys, arguments, code):
    monkeypatch.setattr(sys, "argv", ["toy", *arguments])
    with pytest.raises(SystemExit) as ended:
        toy.main()
    assert ended.value.code == 2
    assert capsys.readouterr().err.endswith(f"[{code}]\n")


def test_a_log_that_cannot_be_opened_is_named(folder):
    (folder / "checkpoints/toy/default/run.log").mkdir(parents=True)
    done = run_toy(folder)
    log = folder.resolve() / "checkpoints/toy/default/run.log"
    assert (done.returncode, done.stderr) == (1, f"error: {log}: Is a directory; {RESUME}")


@pytest.mark.parametrize("closed", [">&-", "<&- >&- 2>&-"])
def test_closed_streams_change_nothing(folder, closed):
    done = run_child(["bash", "-c", f"{sys.executable} -m toy {closed}"], cwd=folder)
    assert done.returncode == 0
    assert "Traceback" not in done.stderr
    run = folder / "checkpoints/toy/default"
    assert json.loads((run / "metrics.json").read_text())["loss"] == 1
    assert (run / ".lock").read_bytes() == b""


def test_library_error_on_a_full_disk_is_a_failed_write(monkeypatch, tmp_path, capsys):
    with pytest.raises(RuntimeError), report_failures(str(tmp_path)):
        raise RuntimeError("shapes do not match")
    full = shutil.disk_usage(tmp_path)._replace(free=0)
    monkeypatch.setattr("dynapix.conf.failures.shutil.disk_usage", lambda _: full)
    with pytest.raises(SystemExit) as ended, report_failures(str(tmp_path)):
        raise RuntimeError("shapes do not match")
    assert ended.value.code == 1
    assert capsys.readouterr().err == f"error: {tmp_path}: No space left on device; {RESUME}"


def test_bug_keeps_its_traceback(folder):
    done = run_toy(folder, "end=bug")
    assert done.returncode == 1
    assert "Traceback" in done.stderr
    assert done.stderr.endswith("ValueError: a bug\n")


def test_help_describes_the_settings_and_imports_nothing_heavy(folder):
    script = (
        "import runpy, sys; sys.argv = ['toy', '--help', 'all', 'x=5']\n"
        "runpy.run_module('toy', run_name='__main__', alter_sys=True)\n"
        "heavy = {'torch', 'transformers', 'pybullet', 'matplotlib', 'pandas'} & set(sys.modules)\n"
        "assert not heavy, heavy"
    )
    done = run_child([sys.executable, "-c", script], check=True, cwd=folder)
    assert "A toy that squares x." in done.stdout
    assert "teacher: qwen3_32b, template" in done.stdout
    lines = [line.split() for line in done.stdout.splitlines()]
    assert ["x", "=", "5.0", "Number", "to", "square."] in lines
    assert not (folder / "checkpoints").exists()
    brief = run_child([sys.executable, "-m", "toy", "--help"], check=True, cwd=folder)
    assert "--help all lists the other" in brief.stdout
    assert "Number to square" not in brief.stdout


def test_options_may_stand_among_the_overrides(folder):
    for arguments in (("x=5", "--cfg", "job", "workers=1"), ("--cfg", "job", "x=5", "workers=1")):
        done = run_toy(folder, *arguments)
        settings = yaml.safe_load(done.stdout)
        assert (settings["x"], settings["workers"]) == (5, 1)
    for arguments in (("x=5", "--help", "all"), ("--help", "all", "x=5")):
        assert "x = 5.0" in run_toy(folder, *arguments).stdout


def test_help_can_be_piped_to_head(folder):
    command = "set -o pipefail; python -m toy --help all | true"
    done = run_child(["bash", "-c", command.replace("python", sys.executable)], cwd=folder)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_package_that_is_not_installed_is_named(capsys):
    with pytest.raises(SystemExit) as ended, report_failures():
        importlib.import_module("not_installed.part")
    assert ended.value.code == 1
    error = capsys.readouterr().err
    assert "the package not_installed" in error
    assert error.endswith("[missing-package]\n")
    # A missing module of an installed package is a bug.
    with pytest.raises(ModuleNotFoundError), report_failures():
        importlib.import_module("conf.not_there")


def test_a_command_without_hydra_says_what_to_install(folder):
    script = "import sys; sys.modules['hydra'] = None; import data.build"
    done = run_child([sys.executable, "-c", script], cwd=folder)
    assert done.returncode == 1
    assert done.stderr.startswith("error: commands need hydra")
    assert done.stderr.count("\n") == 1
