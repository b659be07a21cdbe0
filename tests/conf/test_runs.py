"""The folder of a run: its name and its records, which are written atomically."""

import json
import os
from itertools import permutations

import pytest

from dynapix.conf.files import write_text
from dynapix.conf.runs import Run, open_run, rank, run_name, world_size
from tests.user_errors import raises_user_error

SETTINGS = {"seed": 0, "run": None, "store": "store", "checkpoints": "c", "workers": 2, "x": 1.0}


@pytest.mark.parametrize(
    ("overrides", "name"),
    [
        ([], "default"),
        (["train.lr=1e-3", "+exp=cot"], "exp-cot+train.lr-1e-3"),
        (["store=/big", "workers=8", "checkpoints=c"], "default"),
        (["train.micro_batch=1", "train.gradient_checkpointing=true", "batch=4"], "default"),
        (["student.model=Qwen/Qwen3 VL"], "student.model-Qwen-Qwen3-VL"),
        (["benchmark.name='2026_11'"], "benchmark.name-2026_11"),
    ],
)
def test_run_name_comes_from_the_overrides(overrides, name):
    assert run_name(None, overrides) == name
    assert run_name("mine", overrides) == "mine"


def test_run_name_is_short_unique_and_independent_of_the_order_of_keys():
    overrides = ["x=1", "+exp=cot", "train.lr=1e-3"]
    assert len({run_name(None, list(order)) for order in permutations(overrides)}) == 1
    assert run_name(None, ["x=1", "x=2"]) != run_name(None, ["x=2", "x=1"])
    one, two = (run_name(None, ["train.lr=1"] * 40 + [f"seed={seed}"]) for seed in (1, 2))
    assert len(one) == len(two) == 120
    assert one != two


def test_record_lists_every_start(tmp_path):
    run = Run("r", tmp_path / "r")
    open_run(run, SETTINGS, "train.sft")
    first = json.loads((run.folder / "run.json").read_text())
    assert first["earlier_starts"] == []
    assert first["seeds"] == {"seed": 0}
    assert first["packages"]["hydra-core"].startswith("1.3")
    open_run(run, SETTINGS | {"workers": 8, "store": "/big"}, "train.sft")
    again = json.loads((run.folder / "run.json").read_text())
    assert again["earlier_starts"] == [first["started"]]
    assert not list(run.folder.glob(".*.partial"))


def test_settings_of_a_run_with_results_may_change_only_in_memory_and_speed(tmp_path):
    run = Run("r", tmp_path / "r")
    before = {"micro_batch": 8, "mini_batch": 8, "sampling_batch": 8, "lr": 1.0}
    before |= {"gradient_checkpointing": False, "reuse_features": True}
    # A dict that is empty and is no setting any more changes nothing.
    open_run(run, SETTINGS | {"train": before | {"bounds": {}}, "batch": 8}, "train.sft")
    (run.folder / "metrics.jsonl").touch()
    after = {"micro_batch": 1, "mini_batch": 1, "sampling_batch": 2, "lr": 1.0}
    after |= {"gradient_checkpointing": True, "reuse_features": False}
    open_run(run, SETTINGS | {"train": after, "batch": 1}, "train.sft")
    assert len(json.loads((run.folder / "run.json").read_text())["earlier_starts"]) == 1
    with raises_user_error("other-settings", contains="train.lr was 1.0 and is now 2.0"):
        open_run(run, SETTINGS | {"train": after | {"lr": 2.0}, "batch": 1}, "train.sft")


@pytest.mark.parametrize("name", ["run.json", "config.yaml"])
def test_damaged_records_are_named(tmp_path, name):
    run = Run("r", tmp_path / "r")
    open_run(run, SETTINGS, "train.sft")
    (run.folder / name).write_text("[")
    with raises_user_error("damaged-file", contains=(name, f"delete {run.folder}")):
        open_run(run, SETTINGS, "train.sft")


def test_ranks_need_a_launcher(monkeypatch):
    monkeypatch.setenv("LOCAL_RANK", "0")
    assert (rank(), world_size()) == (0, 1)
    monkeypatch.setenv("RANK", "3")
    monkeypatch.setenv("WORLD_SIZE", "4")
    assert (rank(), world_size()) == (3, 4)


def test_failed_write_leaves_the_earlier_file(tmp_path, monkeypatch):
    def full(*_: object) -> None:
        raise OSError(28, "No space left on device")

    path = tmp_path / "run.json"
    path.write_text("earlier")
    monkeypatch.setattr(os, "fsync", full)
    with pytest.raises(OSError, match=r"No space left on device: .*run\.json"):
        write_text(path, "new")
    assert [p.read_text() for p in tmp_path.iterdir()] == ["earlier"]
