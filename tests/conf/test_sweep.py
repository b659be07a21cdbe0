"""Sweeps as they are typed: real processes of a toy command."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from pathlib import Path

import psutil
import pytest

from conf.processes import visible_gpus

TWO_GPUS = {**os.environ, "CUDA_VISIBLE_DEVICES": "0,1"}
NO_GPU = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}


def toy(room: Path, *arguments: str, env=NO_GPU) -> subprocess.CompletedProcess[str]:
    return subprocess.run(
        [sys.executable, "-m", "toy", *arguments],
        cwd=room,
        capture_output=True,
        text=True,
        env=env,
    )


def started(room: Path, *arguments: str, env=NO_GPU) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "toy", *arguments],
        cwd=room,
        stderr=subprocess.PIPE,
        text=True,
        env=env,
    )


def wait_for(*paths: Path) -> None:
    until = time.monotonic() + 60
    while not all(path.exists() and path.read_text() for path in paths):
        assert time.monotonic() < until, f"still waiting for {paths}"
        time.sleep(0.05)


def rows(folder: Path) -> list[dict[str, str]]:
    """A sweep's table without the times, which differ from run to run."""
    found = list(csv.DictReader((folder / "sweep.csv").open()))
    return [{key: value for key, value in row.items() if key != "seconds"} for row in found]


def new_room(folder: Path) -> Path:
    shutil.copy(Path(__file__).with_name("toy.py"), folder)
    return folder


@pytest.fixture
def room(tmp_path: Path) -> Path:
    return new_room(tmp_path)


@pytest.mark.slow
def test_a_sweep_outlives_a_failed_job_and_goes_on(room):
    sweep = ("-m", "x=1,2", "end=well,bug", "run=s")
    done = toy(room, *sweep, env=TWO_GPUS)
    assert done.returncode == 1
    assert "#1 x=1 end=bug: failed" in done.stderr
    assert "ValueError: a bug" in done.stderr
    folder = room / "checkpoints/toy/s"
    assert [(r["x"], r["end"], r["status"], r["loss"]) for r in rows(folder)] == [
        ("1", "well", "done", "1.0"),
        ("1", "bug", "failed", ""),
        ("2", "well", "done", "4.0"),
        ("2", "bug", "failed", ""),
    ]
    table = (folder / "sweep.txt").read_text()
    assert table == done.stdout
    assert table.splitlines()[1].split()[:6] == ["0", "1", "well", "1*", "1*", "done"]
    assert (folder / "sweep.png").stat().st_size > 1000
    assert "x is 2.0" in (folder / "2/output.log").read_text()
    assert "x: 2.0" in (folder / "2/config.yaml").read_text()

    again = toy(room, *sweep, env=TWO_GPUS)
    assert "#0 x=1 end=well: finished before, skipped" in again.stderr
    assert "#1 x=1 end=bug: started" in again.stderr
    assert json.loads((folder / "0/run.json").read_text())["earlier_starts"] == []


@pytest.mark.parametrize(("env", "at_once"), [(NO_GPU, 1), (TWO_GPUS, 2)])
def test_a_killed_sweep_takes_its_children_along(room, env, at_once):
    sweep = started(room, "-m", "x=1,2,3", "end=never", "run=s", env=env)
    folders = [room / "checkpoints/toy/s" / str(number) for number in range(3)]
    wait_for(*(folder / "output.log" for folder in folders[:at_once]))
    children = psutil.Process(sweep.pid).children(recursive=True)
    assert len(children) == at_once
    sweep.send_signal(signal.SIGTERM)
    assert sweep.wait(timeout=60) == 130
    assert psutil.wait_procs(children, timeout=10)[1] == []
    assert not list((room / "checkpoints/toy/s").glob("*/job.json"))
    assert [folder.exists() for folder in folders] == [number < at_once for number in range(3)]


@pytest.mark.slow
def test_as_many_jobs_run_at_once_as_there_are_gpus_and_each_sees_one(room):
    done = toy(room, "-m", "x=1,2", "end=meet", env=TWO_GPUS)
    assert done.returncode == 0, done.stderr
    # A sweep without a name is named by its overrides.
    folder = room / "checkpoints/toy/x-1-2+end-meet"
    logs = [(folder / f"{number}/run.log").read_text() for number in range(2)]
    seen = [line for log in logs for line in log.splitlines() if "sees GPU" in line]
    assert sorted(line[-1] for line in seen) == ["0", "1"]


@pytest.mark.parametrize(
    ("named", "gpus"),
    [
        ("", []),
        ("-1", []),
        ("NoDevFiles", []),
        ("3", ["3"]),
        ("0, 2", ["0", "2"]),
        ("0,-1,1", ["0"]),
        ("GPU-a1,MIG-b2", ["GPU-a1", "MIG-b2"]),
    ],
)
def test_the_environment_says_which_gpus_may_be_used(monkeypatch, named, gpus):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", named)
    assert visible_gpus() == gpus


def test_the_driver_says_how_many_gpus_there_are(monkeypatch, tmp_path):
    monkeypatch.delenv("CUDA_VISIBLE_DEVICES", raising=False)
    monkeypatch.setenv("PATH", str(tmp_path))
    assert visible_gpus() == []
    driver = tmp_path / "nvidia-smi"
    driver.write_text(f"#!{sys.executable}\nprint('GPU 0: A (UUID: GPU-1)\\nGPU 1: A (UUID: ...)')")
    driver.chmod(0o755)
    assert visible_gpus() == ["0", "1"]


@pytest.mark.slow
def test_a_cluster_comes_to_the_same_table_and_run_folders(room):
    done = toy(room, "-m", "x=2", "end=well,bug", "run=s", "hydra/launcher=submitit_local")
    assert done.returncode == 1
    assert "ValueError: a bug" in done.stderr
    folder = room / "checkpoints/toy/s"
    assert rows(folder) == [
        {"job": "0", "end": "well", "accuracy": "0.5", "loss": "4.0", "status": "done"},
        {"job": "1", "end": "bug", "accuracy": "", "loss": "", "status": "failed"},
    ]
    assert (folder / "sweep.txt").read_text() == done.stdout
    run = json.loads((folder / "0/run.json").read_text())
    assert run["overrides"] == ["x=2", "end=well", "run=s", "run='s/0'"]
    assert "x is 2.0" in (folder / "0/output.log").read_text()


@pytest.mark.parametrize(
    ("options", "said"),
    [
        (["hydra/launcher=submitit_slurm"], "error: hydra/launcher=submitit_slurm: Could not det"),
        (["hydra/launcher=submitit_local", "+hydra.launcher.nope=1"], "error: hydra/launcher=sub"),
    ],
)
def test_a_cluster_that_cannot_be_used_is_told(room, options, said):
    done = toy(room, "-m", "x=1,2", *options)
    assert said in done.stderr
    assert "Traceback" not in done.stderr
