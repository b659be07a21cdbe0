"""Sweeps and searches: their jobs, their tables, and what a killed one leaves."""

import csv
import json
import os
import signal
import sys
from pathlib import Path
from typing import Any

import psutil
import pytest
from hydra.core.override_parser.overrides_parser import OverridesParser
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from dynapix.conf.files import write_json
from dynapix.conf.gpus import visible_gpus
from dynapix.conf.multirun.launchers import Job, SubmititLauncher
from dynapix.conf.multirun.search import STUDY_FILE, Search, distribution
from dynapix.conf.multirun.table import is_lower_better, read_jobs, write_sweep_table
from tests.conf.toy_process import run_toy, start_toy
from tests.user_errors import raises_user_error
from tests.waiting import wait_until

TWO_GPUS = {**os.environ, "CUDA_VISIBLE_DEVICES": "0,1"}


def wait_for(*paths: Path) -> None:
    wait_until(lambda: all(path.exists() and path.read_text() for path in paths))


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


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

    shorter = run_toy(folder, "-m", "x=1", "end=well,bug", "run=s", env=TWO_GPUS)
    assert "#0 end=well: already finished, skipped" in shorter.stderr
    assert "#1 end=bug: started" in shorter.stderr
    assert json.loads((runs / "0/run.json").read_text())["earlier_starts"] == []
    assert [row["job"] for row in rows(runs)] == ["0", "1"]


@pytest.mark.slow
def test_killed_sweep_ends_its_children_which_had_one_gpu_each(folder):
    sweep = start_toy(folder, "-m", "x=1,2,3", "end=never", env=TWO_GPUS)
    # Without run=, the name of the sweep's folder is made from its overrides.
    runs = folder / "checkpoints/toy/end-never+x-1-2-3"
    jobs = [runs / str(number) for number in range(3)]
    wait_until(lambda: all("GPU" in log.read_text() for log in logs(jobs[:2])))
    assert sorted(log.read_text().split("sees GPU ")[1][0] for log in logs(jobs[:2])) == ["0", "1"]
    children = psutil.Process(sweep.pid).children(recursive=True)
    assert len(children) == 2
    sweep.send_signal(signal.SIGTERM)
    assert sweep.wait(timeout=60) == 130
    assert psutil.wait_procs(children, timeout=10)[1] == []
    assert not list(runs.glob("*/job.json"))
    assert [job.exists() for job in jobs] == [True, True, False]


def logs(jobs: list[Path]) -> list[Path]:
    """Return the logs of jobs, as soon as all of these have begun to write one."""
    found = [job / "run.log" for job in jobs]
    wait_for(*found)
    return found


def test_visible_gpus_are_those_of_the_environment_or_of_the_driver(monkeypatch, tmp_path):
    # Like CUDA, everything from the first invalid device on is ignored.
    for rest in ("", "-1", "NoDevFiles", "-1,1"):
        for gpus in ([], ["0", "2"], ["GPU-a1", "MIG-b2"]):
            monkeypatch.setenv("CUDA_VISIBLE_DEVICES", ", ".join([*gpus, rest]))
            assert visible_gpus() == gpus
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES")
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


@pytest.mark.parametrize(("cluster", "parameters"), [("slurm", {}), ("local", {"nope": 1})])
def test_cluster_that_cannot_be_used_is_a_user_error(tmp_path, cluster, parameters):
    launcher = SubmititLauncher(cluster, str(tmp_path), **parameters)
    with raises_user_error("cluster-refused", contains=f"hydra/launcher=submitit_{cluster}"):
        next(launcher.run([Job(tmp_path, "#0", [], ["true"])]))


@pytest.mark.slow
def test_killed_search_resumes_and_names_the_best_trial(folder):
    search = ("-m", "x=interval(0.5,3.0)", "hydra/sweeper=optuna", "hydra.sweeper.n_trials=2")
    search += ("hydra.sweeper.metric=loss", "run=k")
    runs = folder / "checkpoints/toy/k"
    killed = start_toy(folder, *search)
    wait_for(runs / "0/job.json")
    killed.send_signal(signal.SIGTERM)
    assert killed.wait(timeout=60) == 130
    resumed = run_toy(folder, *search)
    assert "#0 x=" in resumed.stderr.partition("already finished")[0]
    assert resumed.returncode == 0, resumed.stderr
    table = rows(runs)
    best = min(table, key=lambda row: float(row["loss"]))
    assert f"best: #{best['job']} x={best['x']}, loss" in resumed.stderr
    assert len(table) == len(json.loads((runs / STUDY_FILE).read_text())["trials"]) == 2


class Jobs:
    """Runs the jobs of a search in this process: the loss is the square of x.

    Attributes:
        ran: The values of x, in order.
        stop: Number of the job at which the search is interrupted.
        fails: The value of x whose job fails.
    """

    def __init__(self, stop: int | None = None, fails: str | None = None) -> None:
        self.ran: list[str] = []
        self.stop, self.fails = stop, fails

    def __call__(self, overrides: list[list[str]], first: int) -> list[dict[str, Any]]:
        records = []
        for number, [override] in enumerate(overrides, first):
            if number == self.stop:
                raise KeyboardInterrupt
            self.ran.append(value := override.partition("=")[2])
            status = "failed" if value == self.fails else "done"
            records.append({"status": status, "metrics": {"loss": float(value) ** 2}})
        return records


def search(folder: Path, jobs: Jobs, swept: str, metric: str | None = "loss") -> list[str]:
    """Run three trials of a search, and return the values of x that its jobs had."""
    [parsed] = OverridesParser.create().parse_overrides([swept])
    settings = Search(metric, n_trials=3, n_jobs=1, seed=0, params=None)
    settings.run({"x": parsed}, folder, jobs)
    return jobs.ran


def test_interrupted_search_samples_the_trials_of_an_undisturbed_one(tmp_path):
    interval = "x=interval(0.5,3.0)"
    undisturbed = search(tmp_path / "a", Jobs(), interval)
    assert len({*undisturbed}) == 3
    assert all(0.5 <= float(x) <= 3 for x in undisturbed)
    with pytest.raises(KeyboardInterrupt):
        search(tmp_path / "b", Jobs(stop=1), interval)
    assert search(tmp_path / "b", Jobs(), interval) == undisturbed
    assert search(tmp_path / "b", Jobs(), interval) == undisturbed
    # Another search in the same folder is refused before a job runs.
    with raises_user_error("other-settings", contains="x was "):
        search(tmp_path / "b", Jobs(stop=0), "x=interval(0.5,4.0)")


def test_failed_trial_is_repeated_and_an_unknown_metric_can_be_corrected(tmp_path):
    first = search(tmp_path / "a", Jobs(fails="0"), "x=range(0,2)")
    assert "0" in first
    assert search(tmp_path / "a", Jobs(), "x=range(0,2)") == first
    with raises_user_error("unknown-metric", contains="loss"):
        search(tmp_path / "b", jobs := Jobs(), "x=range(0,2)", "los")
    assert search(tmp_path / "b", Jobs(), "x=range(0,2)")[:1] == jobs.ran


@pytest.mark.parametrize(
    ("override", "metric", "code"),
    [
        ("x=interval(0,1)", None, "missing-metric"),
        ("x=1", "loss", "nothing-to-search"),
        ("x=interval(3,1)", "loss", "invalid-interval"),
    ],
)
def test_invalid_search_is_refused(tmp_path, override, metric, code):
    with raises_user_error(code):
        search(tmp_path, Jobs(stop=0), override, metric)


@pytest.mark.parametrize(
    ("override", "expected"),
    [
        ("x=interval(0,1)", FloatDistribution(0, 1)),
        ("x=int(interval(1,4))", IntDistribution(1, 4)),
        ("x=tag(log,interval(1e-5,1e-3))", FloatDistribution(1e-5, 1e-3, log=True)),
        ("x=range(1,10,3)", IntDistribution(1, 7, step=3)),
        ("x=range(0,1,0.5)", CategoricalDistribution(["0.0", "0.5"])),
        ("x=1e-5,2", CategoricalDistribution(["1e-05", "2"])),
    ],
)
def test_swept_override_becomes_a_distribution(override, expected):
    [parsed] = OverridesParser.create().parse_overrides([override])
    assert distribution(parsed) == expected


def test_tables_begin_with_the_main_metrics(tmp_path):
    metrics = {"answer_loss": 2.0, "reasoning_generated_accuracy": 0.5, "loss_at_start": 3.0}
    # A copied folder of a job is no job.
    for name in ("0", "0.bak"):
        write_json(tmp_path / name / "metrics.json", metrics)
        write_json(tmp_path / name / "job.json", {"overrides": ["x=1"], "status": "done"})
    [job] = read_jobs(tmp_path)
    assert list(job["metrics"]) == [*metrics][1::-1]
    header = write_sweep_table(tmp_path).splitlines()[0]
    assert header.split() == ["job", "reasoning_generated_accuracy", "answer_loss", "status"]


def test_metric_determines_the_direction_of_a_search():
    lower = {"eval_loss", "median_rank", "set_aside", "place_error", "named_place_error/parse"}
    assert {m for m in (*lower, "mrr", "accuracy") if is_lower_better(m)} == lower
