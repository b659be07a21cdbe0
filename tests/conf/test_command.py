"""The toy command: the files of its run, its exit status and its error messages."""

import json
import shutil
import sys

import pytest
import yaml

from dynapix.conf.errors import SettingsError, UserError
from dynapix.conf.failures import report_failures
from tests.children import run_child
from tests.conf import toy
from tests.conf.toy_process import run_toy

RESUME = "fix this and run the same command again to resume  [file-error]\n"


@pytest.fixture
def start(monkeypatch, folder):
    """Starts the command in this process, in an empty folder, with some arguments."""
    monkeypatch.chdir(folder)

    def call(*arguments: str) -> None:
        monkeypatch.setattr(sys, "argv", ["toy", *arguments])
        toy.main()

    return call


def test_run_writes_its_record_and_can_be_repeated(folder):
    for _ in range(2):
        done = run_toy(folder, "x=2", "workers=1")
        assert (done.returncode, done.stdout) == (0, "")
        assert done.stderr == "x is 2.0 in checkpoints/toy/x-2\n"
    run = folder / "checkpoints/toy/x-2"
    files = {".lock", "config.yaml", "metrics.json", "run.json", "run.log"}
    assert {p.name for p in run.iterdir()} == files
    assert json.loads((run / "metrics.json").read_text())["loss"] == 4
    assert json.loads((run / "run.json").read_text())["overrides"] == ["x=2", "workers=1"]
    assert "x is 2.0" in (run / "run.log").read_text()


def test_unfinished_run_without_results_accepts_other_settings(folder):
    failed = run_toy(folder, "end=mistake", "run=one")
    assert failed.returncode == 1
    assert failed.stderr.endswith("error: this end is a mistake: set end=well  [toy-mistake]\n")
    assert "Traceback" not in failed.stderr
    assert run_toy(folder, "x=3", "run=one").returncode == 0
    run = folder / "checkpoints/toy/one"
    assert json.loads((run / "metrics.json").read_text())["loss"] == 9
    record = json.loads((run / "run.json").read_text())
    assert (record["overrides"], record["earlier_starts"]) == (["x=3", "run=one"], [])


@pytest.mark.parametrize(
    ("error", "status", "message"),
    [
        (UserError("one\ntwo", "a-code"), 1, "error: one  [a-code]\nerror: two  [a-code]\n"),
        (SettingsError("x=1"), 2, "error: x=1  [invalid-setting]\n"),
        (OSError(28, "Full", "some/file"), 1, f"error: some/file: Full; {RESUME}"),
        (ModuleNotFoundError(name="not_installed.part"), 1, "  [missing-package]\n"),
        (KeyboardInterrupt(), 130, "interrupted; run the same command again to resume\n"),
    ],
)
def test_problem_of_the_user_is_one_message(capsys, error, status, message):
    with pytest.raises(SystemExit) as ended, report_failures():
        raise error
    assert ended.value.code == status
    assert capsys.readouterr().err.endswith(message)


@pytest.mark.parametrize("bug", [RuntimeError("shapes"), ModuleNotFoundError(name="conf.absent")])
def test_a_bug_keeps_its_traceback(bug):
    with pytest.raises(type(bug)), report_failures():
        raise bug


def test_library_error_on_a_full_disk_is_a_failed_write(monkeypatch, tmp_path, capsys):
    full = shutil.disk_usage(tmp_path)._replace(free=0)
    monkeypatch.setattr("dynapix.conf.failures.shutil.disk_usage", lambda _: full)
    with pytest.raises(SystemExit) as ended, report_failures(str(tmp_path)):
        raise RuntimeError("shapes do not match")
    assert ended.value.code == 1
    assert capsys.readouterr().err == f"error: {tmp_path}: No space left on device; {RESUME}"


@pytest.mark.parametrize(
    ("arguments", "status", "code"),
    [
        (["-m", "--cfg", "job"], 2, "conflicting-options"),
        (["--resolve"], 2, "conflicting-options"),
        (["--cfg", "job", "--package", "x"], 2, "unknown-key"),
        (["+sweep=lr_rank"], 2, "needs-multirun"),
        (["--config-dir", "folder"], 2, "unsupported-option"),
        (["checkpoints=toy.py"], 1, "file-error"),
    ],
)
def test_invalid_arguments_are_named(start, capsys, arguments, status, code):
    with pytest.raises(SystemExit) as ended:
        start(*arguments)
    assert ended.value.code == status
    assert capsys.readouterr().err.endswith(f"[{code}]\n")


def test_a_log_that_cannot_be_opened_is_named(folder):
    (folder / "checkpoints/toy/default/run.log").mkdir(parents=True)
    done = run_toy(folder)
    log = folder.resolve() / "checkpoints/toy/default/run.log"
    assert (done.returncode, done.stderr) == (1, f"error: {log}: Is a directory; {RESUME}")


def test_closed_streams_change_nothing(folder):
    done = run_child(["bash", "-c", f"{sys.executable} -m toy <&- >&- 2>&-"], cwd=folder)
    assert done.returncode == 0
    run = folder / "checkpoints/toy/default"
    assert json.loads((run / "metrics.json").read_text())["loss"] == 1
    assert (run / ".lock").read_bytes() == b""


@pytest.mark.parametrize("arguments", [("x=5", "--help", "all"), ("--help", "all", "x=5")])
def test_help_describes_the_settings(start, folder, capsys, arguments):
    start(*arguments)
    shown = capsys.readouterr().out
    assert "teacher: qwen3_32b, template" in shown
    lines = [line.split() for line in shown.splitlines()]
    assert ["x", "=", "5.0", "Number", "to", "square."] in lines
    start("--help")
    brief = capsys.readouterr().out
    assert "--help all lists the other" in brief
    assert "Number to square" not in brief
    assert not (folder / "checkpoints").exists()


@pytest.mark.parametrize("arguments", ["x=5 --cfg job workers=1", "--cfg job x=5 workers=1"])
def test_options_may_stand_among_the_overrides(start, capsys, arguments):
    start(*arguments.split())
    settings = yaml.safe_load(capsys.readouterr().out)
    assert (settings["x"], settings["workers"]) == (5, 1)


def test_help_can_be_piped_to_head(folder):
    command = "set -o pipefail; python -m toy --help all | true"
    done = run_child(["bash", "-c", command.replace("python", sys.executable)], cwd=folder)
    assert (done.returncode, done.stderr) == (141, "")


def test_a_command_without_hydra_says_what_to_install(folder):
    script = "import sys; sys.modules['hydra'] = None; import data.build"
    done = run_child([sys.executable, "-c", script], cwd=folder)
    assert done.returncode == 1
    assert done.stderr.startswith("error: commands need hydra")
    assert done.stderr.count("\n") == 1
