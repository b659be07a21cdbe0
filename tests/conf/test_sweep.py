"""Sweeps of the toy command, run as processes."""

import csv
import json
import os
import shutil
import signal
import sys
from pathlib import Path

import psutil
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from dynapix.conf.errors import import_extra
from dynapix.conf.files import write_json
from dynapix.conf.gpus import visible_gpus
from dynapix.conf.multirun.search import STUDY_FILE, Search, distribution
from dynapix.conf.multirun.table import (
    JOB_FILE,
    is_lower_better,
    read_job,
    read_jobs,
    write_sweep_table,
)
from tests.conf.toy_process import run_toy, start_toy
from tests.user_errors import raises_user_error
from tests.waiting import wait_until

SEARCH = ("-m", "x=interval(0.5,3.0)", "hydra/sweeper=optuna", "hydra.sweeper.n_trials=2")
BY_LOSS = "hydra.sweeper.metric=loss"
TWO_GPUS = {**os.environ, "CUDA_VISIBLE_DEVICES": "0,1"}


def wait_for(*paths: Path) -> None:
    wait_until(lambda: all(path.exists() and path.read_text() for path in paths))


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture(scope="module")
def searched(tmp_path_factory) -> Path:
    """A working folder with the finished search `s`, which minimises the loss."""
    folder = tmp_path_factory.mktemp("searched")
    shutil.copy(Path(__file__).with_name("toy.py"), folder)
    done = run_toy(folder, *SEARCH, BY_LOSS, "run=s")
    assert done.returncode == 0, done.stderr
    table = rows(folder / "checkpoints/toy/s")
    best = min(table, key=lambda row: float(row["loss"]))
    assert f"best: #{best['job']} x={best['x']}, loss" in done.stderr
    assert all(0.5 <= float(row["x"]) <= 3 for row in table)
    return folder


@pytest.mark.slow
def test_sweep_survives_a_failed_job_and_resumes(folder):
    sweep = ("-m", "x=1,2", "end=well,bug", "run=s")
    done = run_toy(folder, *sweep, env=TWO_GPUS)
    assert done.returncode == 1
    assert "#1 x=1 end=bug: failed" in done.stderr
    assert "ValueError: a bug" in done.stderr
    runs = folder / "checkpoints/toy/s"
    assert [(r["x"], r["end"], r["status"], r["loss"]) for r in rows(runs)] == [
        ("1", "well", "done", "1.0"),
        ("1", "bug", "failed", ""),
        ("2", "well", "done", "4.0"),
        ("2", "bug", "failed", ""),
    ]
    table = (runs / "sweep.txt").read_text()
    assert table == done.stdout
    assert table.splitlines()[1].split()[:6] == ["0", "1", "well", "1*", "1*", "done"]
    assert "x is 2.0" in (runs / "2/output.log").read_text()
    assert "x: 2.0" in (runs / "2/config.yaml").read_text()

    again = run_toy(folder, *sweep, env=TWO_GPUS)
    assert "#0 x=1 end=well: already finished, skipped" in again.stderr
    assert "#1 x=1 end=bug: started" in again.stderr
    assert json.loads((runs / "0/run.json").read_text())["earlier_starts"] == []

    shorter = run_toy(folder, "-m", "x=1", "end=well", "run=s")
    assert shorter.returncode == 0
    assert [row["job"] for row in rows(runs)] == ["0"]


@pytest.mark.slow
def test_killed_sweep_ends_its_children(folder):
    sweep = start_toy(folder, "-m", "x=1,2,3", "end=never", "run=s", env=TWO_GPUS)
    jobs = [folder / "checkpoints/toy/s" / str(number) for number in range(3)]
    wait_for(*(job / "output.log" for job in jobs[:2]))
    children = psutil.Process(sweep.pid).children(recursive=True)
    assert len(children) == 2
    sweep.send_signal(signal.SIGTERM)
    assert sweep.wait(timeout=60) == 130
    assert psutil.wait_procs(children, timeout=10)[1] == []
    assert not list((folder / "checkpoints/toy/s").glob("*/job.json"))
    assert [job.exists() for job in jobs] == [True, True, False]


@pytest.mark.slow
def test_one_job_runs_on_each_gpu(folder):
    done = run_toy(folder, "-m", "x=1,2", "end=meet", env=TWO_GPUS)
    assert done.returncode == 0, done.stderr
    # Without run=, the name of the sweep's folder is made from its overrides.
    runs = folder / "checkpoints/toy/end-meet+x-1-2"
    logs = [(runs / f"{number}/run.log").read_text() for number in range(2)]
    gpus = [line for log in logs for line in log.splitlines() if "sees GPU" in line]
    assert sorted(line[-1] for line in gpus) == ["0", "1"]


def test_a_copied_job_folder_is_not_a_job(tmp_path):
    for name in ("0", "1", "0.bak"):
        (tmp_path / name).mkdir()
        (tmp_path / name / JOB_FILE).write_text('{"overrides": [], "status": "failed"}')
    assert [job["job"] for job in read_jobs(tmp_path)] == [0, 1]


@pytest.mark.parametrize("rest", ["", "-1", "NoDevFiles", "-1,1"])
@pytest.mark.parametrize("gpus", [[], ["3"], ["0", "2"], ["GPU-a1", "MIG-b2"]])
def test_gpus_before_the_first_invalid_one_are_visible(monkeypatch, gpus, rest):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", ", ".join([*gpus, rest]))
    assert visible_gpus() == gpus


def test_driver_lists_the_gpus(monkeypatch, tmp_path):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert visible_gpus() == []
    driver = tmp_path / "nvidia-smi"
    driver.write_text(f"#!{sys.executable}\nprint('GPU 0: A (UUID: GPU-1)\\nGPU 1: A (UUID: ...)')")
    driver.chmod(0o755)
    assert visible_gpus() == ["0", "1"]


@pytest.mark.slow
def test_cluster_writes_the_same_table_and_run_folders(folder):
    done = run_toy(folder, "-m", "x=2", "end=well,bug", "run=s", "hydra/launcher=submitit_local")
    assert done.returncode == 1
    assert "ValueError: a bug" in done.stderr
    runs = folder / "checkpoints/toy/s"
    assert rows(runs) == [
        {"job": "0", "end": "well", "accuracy": "0.5", "loss": "4.0", "status": "done"},
        {"job": "1", "end": "bug", "accuracy": "", "loss": "", "status": "failed"},
    ]
    assert (runs / "sweep.txt").read_text() == done.stdout
    run = json.loads((runs / "0/run.json").read_text())
    assert run["overrides"] == ["x=2", "end=well", "run=s", "run='s/0'"]
    assert "x is 2.0" in (runs / "0/output.log").read_text()


@pytest.mark.slow
@pytest.mark.parametrize(
    "options",
    [
        ["hydra/launcher=submitit_slurm"],
        ["hydra/launcher=submitit_local", "+hydra.launcher.nope=1"],
    ],
)
def test_cluster_that_cannot_be_used_is_a_user_error(folder, options):
    done = run_toy(folder, "-m", "x=1,2", *options)
    assert done.stderr.startswith(f"sweep checkpoints/toy/x-1-2: 2 jobs\nerror: {options[0]}: ")
    assert done.stderr.endswith("[cluster-refused]\n")


@pytest.mark.slow
def test_killed_search_resumes_with_its_trials_and_finished_search_adds_none(searched):
    search = (*SEARCH, BY_LOSS, "run=k")
    runs = searched / "checkpoints/toy/k"
    killed = start_toy(searched, *search)
    wait_for(runs / "0/job.json")
    killed.send_signal(signal.SIGTERM)
    assert killed.wait(timeout=60) == 130
    resumed = run_toy(searched, *search)
    assert "#0 x=" in resumed.stderr.partition("already finished")[0]
    undisturbed = rows(searched / "checkpoints/toy/s")
    assert rows(runs) == undisturbed
    again = run_toy(searched, *search)
    assert again.stderr.count("already finished, skipped") == len(undisturbed) == 2
    assert ": started" not in again.stderr
    assert rows(runs) == undisturbed
    assert len(json.loads((runs / STUDY_FILE).read_text())["trials"]) == 2


@pytest.mark.slow
def test_failed_trial_is_repeated(folder):
    # With this seed, the search tries both values.
    seed = "hydra.sweeper.seed=2"
    search = ("-m", "x=range(0,2)", *SEARCH[2:], BY_LOSS, seed, "run=s")
    assert run_toy(folder, *search).returncode == 1
    table = rows(folder / "checkpoints/toy/s")
    assert sorted((row["x"], row["status"]) for row in table) == [("0", "failed"), ("1", "done")]
    again = run_toy(folder, *search).stderr
    assert again.count(": started") == 1
    assert " x=0: started" in again
    assert " x=1: already finished, skipped" in again


@pytest.mark.slow
def test_unknown_metric_can_be_corrected(folder):
    wrong = run_toy(folder, *SEARCH, "hydra.sweeper.metric=los", "run=s")
    assert wrong.returncode == 1
    assert wrong.stderr.endswith("the options are accuracy, loss  [unknown-metric]\n")
    right = run_toy(folder, *SEARCH, BY_LOSS, "run=s")
    assert right.returncode == 0
    assert right.stderr.count("already finished, skipped") == 1


@pytest.mark.slow
@pytest.mark.parametrize("changed", ["x=interval(0.5,4.0)", "end=bug"])
def test_other_search_in_the_same_folder_is_refused(searched, changed):
    table = rows(searched / "checkpoints/toy/s")
    done = run_toy(searched, *SEARCH, BY_LOSS, "run=s", changed)
    assert done.returncode == 2
    assert f"{changed.partition('=')[0]} was " in done.stderr
    assert done.stderr.endswith("[other-settings]\n")
    assert rows(searched / "checkpoints/toy/s") == table


@pytest.mark.parametrize(
    ("override", "metric", "code"),
    [
        ("x=interval(0,1)", None, "missing-metric"),
        ("x=1", "loss", "nothing-to-search"),
        ("x=interval(3,1)", "loss", "invalid-interval"),
    ],
)
def test_invalid_search_is_refused(tmp_path, override, metric, code):
    [parsed] = OverridesParser.create().parse_overrides([override])
    search = Search(metric, n_trials=2, n_jobs=None, seed=0, params=None)
    with raises_user_error(code):
        search.run({"x": parsed}, tmp_path, pytest.fail)


def test_extra_that_is_not_installed_is_a_user_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with raises_user_error("missing-package", contains=("hydra/sweeper=optuna", ".[optuna]")):
        import_extra("optuna", "hydra/sweeper=optuna")


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("x=interval(0,1)", FloatDistribution(0, 1)),
        ("x=int(interval(1,4))", IntDistribution(1, 4)),
        ("x=tag(log,interval(1e-5,1e-3))", FloatDistribution(1e-5, 1e-3, log=True)),
        ("x=range(1,10,3)", IntDistribution(1, 7, step=3)),
        ("x=range(0,1,0.5)", CategoricalDistribution(["0.0", "0.5"])),
        ("x=1e-5,2", CategoricalDistribution(["1e-05", "2"])),
        ("x={a:1},{a:2}", CategoricalDistribution(["{a:1}", "{a:2}"])),
    ],
)
def test_swept_override_becomes_a_distribution(override, expected):
    [parsed] = OverridesParser.create().parse_overrides([override])
    assert distribution(parsed) == expected


def test_tables_begin_with_the_main_metrics(tmp_path):
    metrics = {"answer_loss": 2.0, "reasoning_generated_accuracy": 0.5, "loss_at_start": 3.0}
    write_json(tmp_path / "0/metrics.json", metrics)
    write_json(tmp_path / "0/job.json", {"overrides": ["x=1"], "status": "done"})
    assert list(read_job(tmp_path / "0")["metrics"]) == [*metrics][1::-1]
    header = write_sweep_table(tmp_path).splitlines()[0]
    assert header.split() == ["job", "reasoning_generated_accuracy", "answer_loss", "status"]


def test_metric_determines_the_direction_of_a_search():
    lower = {"eval_loss", "median_rank", "set_aside", "place_error", "named_place_error/parse"}
    assert {m for m in (*lower, "mrr", "accuracy") if is_lower_better(m)} == lower
