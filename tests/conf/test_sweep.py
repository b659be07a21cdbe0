"""Sweeps from the command line: processes of a toy command, and the sweep presets."""

import csv
import json
import os
import shutil
import signal
import subprocess
import sys
import time
from importlib.resources import files
from pathlib import Path

import psutil
import pytest
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.override_parser.overrides_parser import OverridesParser
from omegaconf import OmegaConf
from optuna.distributions import CategoricalDistribution, FloatDistribution, IntDistribution

from conf.compose import compose, preflight
from conf.gpus import visible_gpus
from conf.multirun.optuna_sweeper import STUDY_FILE, _import_optuna, distribution
from conf.multirun.table import is_lower_better, varying_overrides
from conf.schema import ContrastiveCommand, SftCommand
from conf.schema.training import REGIMES
from tests.conf.test_presets import SCHEMAS
from tests.user_errors import raises_user_error

PRESETS = Path(str(files("conf"))) / "sweep"
SEARCH = ("-m", "x=interval(0.5,3.0)", "hydra/sweeper=optuna", "hydra.sweeper.n_trials=2")
BY_LOSS = "hydra.sweeper.metric=loss"
TWO_GPUS = {**os.environ, "CUDA_VISIBLE_DEVICES": "0,1"}
NO_GPU = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}


def toy(folder: Path, *arguments: str, env=NO_GPU) -> subprocess.CompletedProcess[str]:
    command = [sys.executable, "-m", "toy", *arguments]
    return subprocess.run(command, cwd=folder, capture_output=True, text=True, env=env, timeout=300)


def start_toy(folder: Path, *arguments: str, env=NO_GPU) -> subprocess.Popen[str]:
    command = [sys.executable, "-m", "toy", *arguments]
    return subprocess.Popen(command, cwd=folder, stderr=subprocess.PIPE, text=True, env=env)


def wait_for(*paths: Path) -> None:
    deadline = time.monotonic() + 60
    while not all(path.exists() and path.read_text() for path in paths):
        assert time.monotonic() < deadline, f"still waiting for {paths}"
        time.sleep(0.05)


def rows(folder: Path) -> list[dict[str, str]]:
    with (folder / "sweep.csv").open() as file:
        return list(csv.DictReader(file))


@pytest.fixture
def folder(tmp_path: Path) -> Path:
    """A working folder that contains the toy command."""
    shutil.copy(Path(__file__).with_name("toy.py"), tmp_path)
    return tmp_path


@pytest.fixture(scope="module")
def searched(tmp_path_factory) -> Path:
    """A working folder with a finished search by loss."""
    folder = tmp_path_factory.mktemp("searched")
    shutil.copy(Path(__file__).with_name("toy.py"), folder)
    done = toy(folder, *SEARCH, BY_LOSS, "run=s")
    assert done.returncode == 0, done.stderr
    (folder / "stderr").write_text(done.stderr)
    return folder


@pytest.mark.slow
def test_sweep_survives_a_failed_job_and_resumes(folder):
    sweep = ("-m", "x=1,2", "end=well,bug", "run=s")
    done = toy(folder, *sweep, env=TWO_GPUS)
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

    again = toy(folder, *sweep, env=TWO_GPUS)
    assert "#0 x=1 end=well: already finished, skipped" in again.stderr
    assert "#1 x=1 end=bug: started" in again.stderr
    assert json.loads((runs / "0/run.json").read_text())["earlier_starts"] == []

    shorter = toy(folder, "-m", "x=1", "end=well", "run=s")
    assert shorter.returncode == 0
    assert [row["job"] for row in rows(runs)] == ["0"]


@pytest.mark.slow
@pytest.mark.parametrize(("env", "concurrent"), [(NO_GPU, 1), (TWO_GPUS, 2)])
def test_killed_sweep_ends_its_children(folder, env, concurrent):
    sweep = start_toy(folder, "-m", "x=1,2,3", "end=never", "run=s", env=env)
    jobs = [folder / "checkpoints/toy/s" / str(number) for number in range(3)]
    wait_for(*(job / "output.log" for job in jobs[:concurrent]))
    children = psutil.Process(sweep.pid).children(recursive=True)
    assert len(children) == concurrent
    sweep.send_signal(signal.SIGTERM)
    assert sweep.wait(timeout=60) == 130
    assert psutil.wait_procs(children, timeout=10)[1] == []
    assert not list((folder / "checkpoints/toy/s").glob("*/job.json"))
    assert [job.exists() for job in jobs] == [number < concurrent for number in range(3)]


@pytest.mark.slow
def test_one_job_runs_on_each_gpu(folder):
    done = toy(folder, "-m", "x=1,2", "end=meet", env=TWO_GPUS)
    assert done.returncode == 0, done.stderr
    # Without run=, the name of a sweep comes from its overrides.
    runs = folder / "checkpoints/toy/end-meet+x-1-2"
    logs = [(runs / f"{number}/run.log").read_text() for number in range(2)]
    gpus = [line for log in logs for line in log.splitlines() if "sees GPU" in line]
    assert sorted(line[-1] for line in gpus) == ["0", "1"]


@pytest.mark.parametrize(
    ("visible", "gpus"),
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
def test_environment_limits_the_visible_gpus(monkeypatch, visible, gpus):
    monkeypatch.setenv("CUDA_VISIBLE_DEVICES", visible)
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
    done = toy(folder, "-m", "x=2", "end=well,bug", "run=s", "hydra/launcher=submitit_local")
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
    done = toy(folder, "-m", "x=1,2", *options)
    assert done.stderr.startswith(f"sweep checkpoints/toy/x-1-2: 2 jobs\nerror: {options[0]}: ")
    assert done.stderr.endswith("[cluster-refused]\n")


@pytest.mark.slow
def test_search_logs_the_best_by_its_metric(searched):
    table = rows(searched / "checkpoints/toy/s")
    lowest = min(table, key=lambda row: float(row["loss"]))
    assert f"best: #{lowest['job']} x={lowest['x']}, loss" in (searched / "stderr").read_text()
    assert all(0.5 <= float(row["x"]) <= 3 for row in table)


@pytest.mark.slow
def test_killed_search_repeats_its_trials_and_finished_search_adds_none(searched):
    search = (*SEARCH, BY_LOSS, "run=k")
    runs = searched / "checkpoints/toy/k"
    killed = start_toy(searched, *search)
    wait_for(runs / "0/job.json")
    killed.send_signal(signal.SIGTERM)
    assert killed.wait(timeout=60) == 130
    resumed = toy(searched, *search)
    assert "#0 x=" in resumed.stderr.partition("already finished")[0]
    undisturbed = rows(searched / "checkpoints/toy/s")
    assert rows(runs) == undisturbed
    again = toy(searched, *search)
    assert again.stderr.count("already finished, skipped") == len(undisturbed) == 2
    assert ": started" not in again.stderr
    assert rows(runs) == undisturbed
    assert len(json.loads((runs / STUDY_FILE).read_text())["trials"]) == 2


@pytest.mark.slow
def test_failed_trial_is_repeated(folder):
    # With this seed, the search tries both values.
    seed = "hydra.sweeper.seed=2"
    search = ("-m", "x=range(0,2)", *SEARCH[2:], BY_LOSS, seed, "run=s")
    assert toy(folder, *search).returncode == 1
    table = rows(folder / "checkpoints/toy/s")
    assert sorted((row["x"], row["status"]) for row in table) == [("0", "failed"), ("1", "done")]
    again = toy(folder, *search).stderr
    assert again.count(": started") == 1
    assert " x=0: started" in again
    assert " x=1: already finished, skipped" in again


@pytest.mark.slow
def test_unknown_metric_can_be_corrected(folder):
    wrong = toy(folder, *SEARCH, "hydra.sweeper.metric=los", "run=s")
    assert wrong.returncode == 1
    assert wrong.stderr.endswith("the options are accuracy, loss  [unknown-metric]\n")
    right = toy(folder, *SEARCH, BY_LOSS, "run=s")
    assert right.returncode == 0
    assert right.stderr.count("already finished, skipped") == 1


@pytest.mark.slow
@pytest.mark.parametrize("changed", ["x=interval(0.5,4.0)", "end=bug"])
def test_other_search_in_the_same_folder_is_refused(searched, changed):
    table = rows(searched / "checkpoints/toy/s")
    done = toy(searched, *SEARCH, BY_LOSS, "run=s", changed)
    assert done.returncode == 2
    assert f"{changed.partition('=')[0]} was " in done.stderr
    assert done.stderr.endswith("[other-settings]\n")
    assert rows(searched / "checkpoints/toy/s") == table


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "code"),
    [
        (["x=interval(0,1)"], "needs-search"),
        (["x=interval(0,1)", "hydra/sweeper=optuna"], "missing-metric"),
        ([*SEARCH[2:], "x=1", BY_LOSS], "nothing-to-search"),
        ([*SEARCH[2:], "x=interval(3,1)", BY_LOSS], "invalid-interval"),
    ],
)
def test_invalid_search_is_one_sentence(folder, arguments, code):
    done = toy(folder, "-m", *arguments)
    assert done.returncode == 2
    assert done.stderr.startswith("error: ")
    assert done.stderr.endswith(f"[{code}]\n")
    assert len(done.stderr.splitlines()) == 1


def test_search_without_optuna_is_a_user_error(monkeypatch):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with raises_user_error("missing-package", contains=".[optuna]"):
        _import_optuna()


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
def test_sweep_syntax_becomes_a_distribution(override, expected):
    [parsed] = OverridesParser.create().parse_overrides([override])
    assert distribution(parsed) == expected


def test_direction_follows_from_the_metric():
    lower = {"eval_loss", "median_rank", "set_aside"}
    assert {m for m in (*lower, "mrr", "accuracy") if is_lower_better(m)} == lower


def test_table_has_columns_for_varying_overrides_only():
    jobs = [["+exp=cot", "x=1", "y=3"], ["+exp=cot", "x=2", "y=3"]]
    assert varying_overrides(jobs) == [{"x": "1"}, {"x": "2"}]


def parse_preset(name: str) -> tuple[str, type, str]:
    """The command, its schema and the model override in the comment of a sweep preset."""
    line = (PRESETS / f"{name}.yaml").read_text().splitlines()[1]
    _, _, _, command, _, _, model = line.split()
    return command, SCHEMAS[command], model


def preset_jobs(name: str) -> list[SftCommand | ContrastiveCommand]:
    """The settings of each job of a sweep preset."""
    command, schema, model = parse_preset(name)
    params = OmegaConf.load(PRESETS / f"{name}.yaml").hydra.sweeper.params
    overrides = [f"{key}={value}" for key, value in params.items()]
    [jobs] = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(overrides), None)
    return [compose(command, schema, [model, *job]) for job in jobs]


def test_regimes_preset_has_every_student_regime():
    assert {job.train.regime for job in preset_jobs("regimes")} == set(REGIMES) - {"describe"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lr_rank", "retriever_lr_rank"])
def test_adapter_scale_is_the_papers_at_every_rank(name):
    command, schema, model = parse_preset(name)
    swept, [paper] = (
        [(cfg.train.lr, getattr(cfg, model.partition("=")[0]).lora) for cfg in settings]
        for settings in (preset_jobs(name), [compose(command, schema, [model])])
    )
    assert len({(lr, lora.rank) for lr, lora in swept}) == len(swept) == 9
    assert {lora.alpha / lora.rank for _, lora in swept} == {paper[1].alpha / paper[1].rank}
    assert paper in swept


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.stem for path in PRESETS.glob("*.yaml")))
def test_preset_composes_and_needs_multirun(name):
    command, schema, model = parse_preset(name)
    preflight(command, schema, [f"+sweep={name}", model], sweep=True)
    with raises_user_error("needs-multirun", contains=f"+sweep={name}"):
        preflight(command, schema, [f"+sweep={name}", model], sweep=False)


def test_preset_of_another_command_is_refused():
    with raises_user_error("unknown-key", contains="student"):
        preflight("train.contrastive", ContrastiveCommand, ["+sweep=lr_rank"], sweep=True)
