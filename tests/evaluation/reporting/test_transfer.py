"""The tables of results on other benchmarks than that of the training."""

from __future__ import annotations

import shutil

import pytest
from omegaconf import OmegaConf

from tests.evaluation.reporting.measured import read_table, run_report

pytestmark = pytest.mark.slow


def test_results_on_a_benchmark_without_trained_models_are_transfer(runs, report):
    for name in ("base", "cot"):
        shutil.copytree(runs / "select" / name, runs / "select" / f"{name}-elsewhere")
        path = runs / "select" / f"{name}-elsewhere" / "report.json"
        path.write_text(path.read_text().replace('"micro"', '"elsewhere"', 1))
    folder = report(items=1)
    table = read_table(folder, "transfer")
    assert "| In domain | MoVi-A | Physion | elsewhere |" in table
    assert "| cot (reasoning) | **100.0** | - | - | **100.0** |" in table
    assert read_table(folder, "transfer-selection-elsewhere")
    assert not (folder / "tables" / "distillation-selection-elsewhere.tex").exists()
    # That benchmark is not built, so its items cannot be shown.
    page = (folder / "report.html").read_text()
    assert "python -m data.build benchmark=elsewhere" in page


def test_results_in_the_world_of_the_training_are_no_transfer(runs):
    path = runs / "select" / "cot" / "report.json"
    path.write_text(path.read_text().replace('"micro"', '"micro-above"', 1))
    for run, key, value in (
        ("sft/cot", "benchmark.world.name", "above"),
        ("select/cot", "model", str(runs / "sft" / "cot")),
    ):
        settings = OmegaConf.load(runs / run / "config.yaml")
        OmegaConf.update(settings, key, value)
        OmegaConf.save(settings, runs / run / "config.yaml")
    folder = run_report(runs, runs, items=1, runs=["select/cot"])
    names = {path.stem for path in (folder / "tables").glob("*.md")}
    assert "transfer" not in names
    assert "distillation-selection-micro-above" in names


@pytest.mark.parametrize("key", ["simulator", "recipe"])
def test_a_base_on_a_transfer_suite_is_not_in_the_zero_shot_table(runs, key):
    config = runs / "select" / "base" / "config.yaml"
    settings = OmegaConf.load(config)
    settings.benchmark[key] = "physion"
    OmegaConf.save(settings, config)
    folder = run_report(runs, runs, items=1, runs=["select/base"])
    names = {path.stem for path in (folder / "tables").glob("*.md")}
    assert {"transfer", "transfer-selection-micro"} <= names
    assert "selection-micro" not in names


def test_two_benchmarks_of_a_simulator_have_separate_columns(runs):
    for name in ("one", "two"):
        shutil.copytree(runs / "select" / "cot", runs / "select" / name)
        path = runs / "select" / name / "report.json"
        path.write_text(path.read_text().replace('"micro"', f'"{name}"', 1))
        config = runs / "select" / name / "config.yaml"
        settings = OmegaConf.load(config)
        settings.benchmark.simulator, settings.benchmark.name = "movi_a", name
        OmegaConf.save(settings, config)
    table = read_table(run_report(runs, runs, items=1), "transfer")
    head = "| In domain | MoVi-A | Physion | MoVi-A (one) | MoVi-A (two) |"
    assert head in table
    assert "| cot (reasoning) | 100.0 | - | - | 100.0 | 100.0 |" in table
