"""Sweeps as they are typed: real processes of a toy command, and the presets of train.sft."""

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
from conf.errors import SettingsError, UserError
from conf.multirun.optuna_sweeper import JOURNAL, distribution, open_study
from conf.multirun.processes import visible_gpus
from conf.schema import ContrastiveCommand, SftCommand
from conf.schema.training import REGIMES
from tests.conf.test_presets import SCHEMAS

PRESETS = Path(str(files("conf"))) / "sweep"
SEARCH = ("-m", "x=interval(0.5,3.0)", "hydra/sweeper=optuna", "hydra.sweeper.n_trials=2")
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


@pytest.fixture(scope="module")
def searched(tmp_path_factory) -> Path:
    """A room with a finished search by loss."""
    room = new_room(tmp_path_factory.mktemp("searched"))
    done = toy(room, *SEARCH, "hydra.sweeper.metric=loss", "run=s")
    assert done.returncode == 0, done.stderr
    (room / "stderr").write_text(done.stderr)
    return room


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


@pytest.mark.slow
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
    folder = room / "checkpoints/toy/end-meet+x-1-2"
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


@pytest.mark.slow
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


@pytest.mark.slow
def test_a_search_tells_the_best_by_its_metric(searched):
    table = rows(searched / "checkpoints/toy/s")
    least = min(table, key=lambda row: float(row["loss"]))
    assert f"best: #{least['job']} x={least['x']}, loss" in (searched / "stderr").read_text()
    assert all(0.5 <= float(row["x"]) <= 3 for row in table)


def test_which_way_a_search_goes_is_its_metrics(tmp_path):
    assert open_study(tmp_path / "a", "answer_loss").direction.name == "MINIMIZE"
    assert open_study(tmp_path / "b", "answer_letter_accuracy").direction.name == "MAXIMIZE"
    # The metric was mistyped so far.
    study = open_study(tmp_path / "a", "mrr")
    assert study.direction.name == "MAXIMIZE"
    study.tell(study.ask({"x": FloatDistribution(0, 1)}), 0.5)
    assert open_study(tmp_path / "a", "mrr").trials == study.trials


@pytest.mark.slow
def test_a_killed_search_tries_what_it_would_have_and_a_finished_one_adds_nothing(searched):
    search = (*SEARCH, "hydra.sweeper.metric=loss", "run=k")
    folder = searched / "checkpoints/toy/k"
    killed = started(searched, *search)
    wait_for(folder / "0/job.json")
    killed.send_signal(signal.SIGTERM)
    assert killed.wait(timeout=60) == 130
    resumed = toy(searched, *search)
    assert "#0 x=" in resumed.stderr.partition("finished before")[0]
    undisturbed = rows(searched / "checkpoints/toy/s")
    assert rows(folder) == undisturbed
    again = toy(searched, *search)
    assert again.stderr.count("finished before, skipped") == len(undisturbed) == 2
    assert ": started" not in again.stderr
    assert rows(folder) == undisturbed
    assert len(open_study(folder / JOURNAL, "loss").trials) == 2


@pytest.mark.slow
def test_a_failed_trial_is_tried_again(room):
    # It draws both values.
    seed = "hydra.sweeper.seed=2"
    search = ("-m", "x=range(0,2)", *SEARCH[2:], "hydra.sweeper.metric=loss", seed, "run=s")
    assert toy(room, *search).returncode == 1
    table = rows(room / "checkpoints/toy/s")
    assert sorted((row["x"], row["status"]) for row in table) == [("0", "failed"), ("1", "done")]
    again = toy(room, *search).stderr
    assert again.count(": started") == 1
    assert " x=0: started" in again
    assert " x=1: finished before, skipped" in again


@pytest.mark.slow
def test_an_unknown_metric_is_told_and_may_be_mended(room):
    wrong = toy(room, *SEARCH, "hydra.sweeper.metric=los", "run=s")
    said = (
        "error: hydra.sweeper.metric=los: a job of toy measures accuracy, loss here"
        "  [invalid-setting]\n"
    )
    assert (wrong.returncode, wrong.stderr.endswith(said)) == (1, True)
    right = toy(room, *SEARCH, "hydra.sweeper.metric=loss", "run=s")
    assert right.returncode == 0
    assert right.stderr.count("finished before, skipped") == 1


@pytest.mark.slow
@pytest.mark.parametrize(
    ("changed", "said"),
    [
        (
            ["hydra.sweeper.metric=accuracy", "x=interval(0.5,4.0)", "workers=1,3"],
            "hydra.sweeper.metric is loss there and accuracy now; workers is fixed there and 1,3 "
            "now; x is interval(0.5,3.0) there and interval(0.5,4.0) now. ",
        ),
        (["end=bug"], 'end is "well" there and "bug" now. '),
    ],
)
def test_another_search_in_the_same_folder_is_refused(searched, changed, said):
    table = rows(searched / "checkpoints/toy/s")
    done = toy(searched, *SEARCH, "hydra.sweeper.metric=loss", "run=s", *changed)
    assert done.returncode == 2
    assert done.stderr.startswith("error: checkpoints/toy/s holds a search with other settings: ")
    assert said in done.stderr
    assert rows(searched / "checkpoints/toy/s") == table


@pytest.mark.slow
@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (["x=interval(0,1)"], "x=interval(0,1): add hydra/sweeper=optuna, which draws from inter"),
        (["x=interval(0,1)", "hydra/sweeper=optuna"], "toy has no usual metric to search by"),
        ([*SEARCH[2:], "x=1", "hydra.sweeper.metric=loss"], "there is nothing to search"),
        ([*SEARCH[2:], "x=interval(3,1)", "hydra.sweeper.metric=loss"], "x=interval(3,1): `low"),
    ],
)
def test_a_search_that_cannot_be_is_told(room, arguments, said):
    done = toy(room, "-m", *arguments)
    assert done.returncode == 2
    assert done.stderr.startswith(f"error: {said}")
    assert len(done.stderr.splitlines()) == 1


def test_a_search_without_optuna_is_told(monkeypatch, tmp_path):
    monkeypatch.setitem(sys.modules, "optuna", None)
    with pytest.raises(UserError, match=r"pip install -e '\.\[optuna\]'"):
        open_study(tmp_path / JOURNAL, "loss")


def test_a_torn_line_is_dropped_and_the_study_goes_on(tmp_path):
    journal = tmp_path / JOURNAL
    study = open_study(journal, "loss")
    for value in (2.0, 1.0):
        study.tell(study.ask({"x": FloatDistribution(0, 1)}), value)
    whole = journal.read_bytes()
    journal.write_bytes(whole + b'{"op_code":4,"wor')
    study = open_study(journal, "loss")
    assert journal.read_bytes().startswith(whole)
    study.tell(study.ask({"x": FloatDistribution(0, 1)}), 3.0)
    assert [trial.value for trial in open_study(journal, "loss").trials] == [2.0, 1.0, 3.0]


@pytest.mark.parametrize(
    ("typed", "drawn"),
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
def test_what_is_typed_is_what_is_drawn_from(typed, drawn):
    [override] = OverridesParser.create().parse_overrides([typed])
    assert distribution(override) == drawn


def preset_jobs(name: str) -> list[SftCommand | ContrastiveCommand]:
    """The jobs of a preset, over the model that its file names."""
    command, schema, model = told_by(name)
    params = OmegaConf.load(PRESETS / f"{name}.yaml").hydra.sweeper.params
    overrides = [f"{key}={value}" for key, value in params.items()]
    [jobs] = BasicSweeper.split_arguments(OverridesParser.create().parse_overrides(overrides), None)
    return [compose(command, schema, [model, *job]) for job in jobs]


def told_by(name: str) -> tuple[str, type, str]:
    """The command, its settings, and the model of the line in a preset's file."""
    line = (PRESETS / f"{name}.yaml").read_text().splitlines()[1]
    _, _, _, command, _, _, model = line.split()
    return command, SCHEMAS[command], model


def test_the_regimes_are_all_that_a_student_can_be_trained_in():
    assert {job.train.regime for job in preset_jobs("regimes")} == set(REGIMES) - {"describe"}


@pytest.mark.slow
@pytest.mark.parametrize("name", ["lr_rank", "retriever_lr_rank"])
def test_the_scale_of_adapters_stays_the_papers_at_every_rank(name):
    command, schema, model = told_by(name)
    drawn, [paper] = (
        [(cfg.train.lr, getattr(cfg, model.partition("=")[0]).lora) for cfg in of]
        for of in (preset_jobs(name), [compose(command, schema, [model])])
    )
    assert len({(lr, lora.rank) for lr, lora in drawn}) == len(drawn) == 9
    assert {lora.alpha / lora.rank for _, lora in drawn} == {paper[1].alpha / paper[1].rank}
    assert paper in drawn


@pytest.mark.slow
@pytest.mark.parametrize("name", sorted(path.stem for path in PRESETS.glob("*.yaml")))
def test_a_preset_is_checked_before_it_starts(name):
    command, schema, model = told_by(name)
    preflight(command, schema, [f"+sweep={name}", model], sweep=True)
    with pytest.raises(SettingsError, match=rf"\+sweep={name} is a sweep: run it with -m"):
        preflight(command, schema, [f"+sweep={name}", model], sweep=False)


def test_a_preset_of_another_command_is_told():
    with pytest.raises(SettingsError, match=r"student\.lora: train\.contrastive has no such key"):
        preflight("train.contrastive", ContrastiveCommand, ["+sweep=lr_rank"], sweep=True)


def test_a_search_checks_each_value_of_a_choice():
    overrides = ["hydra/sweeper=optuna", "train.lr=1e-3,2e-3", "train.schedule=cosine,linear,x"]
    with pytest.raises(SettingsError, match=r"train\.schedule=x: the options"):
        preflight("train.sft", SftCommand, overrides, sweep=True)


@pytest.mark.slow
def test_a_sweeps_table_and_plot_can_be_drawn_again(searched):
    def report(folder: str) -> subprocess.CompletedProcess[str]:
        command = [sys.executable, "-m", "train.sweep_report", folder]
        return subprocess.run(command, cwd=searched, capture_output=True, text=True)

    folder = searched / "checkpoints/toy/s"
    drawn = [folder / f"sweep.{end}" for end in ("txt", "csv", "png")]
    before = [path.read_bytes() for path in drawn]
    for path in drawn:
        path.unlink()
    done = report("checkpoints/toy/s")
    assert (done.returncode, done.stderr) == (0, "")
    assert [path.read_bytes() for path in drawn] == before
    assert done.stdout.encode() == before[0]
    none = report("checkpoints/toy")
    assert none.returncode == 1
    assert (
        none.stderr
        == "error: checkpoints/toy holds no sweep with a job that has ended  [user-error]\n"
    )
