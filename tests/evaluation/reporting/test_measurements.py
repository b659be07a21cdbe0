"""The rows of the report's tables: which results share a row or have one of their own."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict

import numpy as np
import pytest

from dynapix.conf.schema import ExportStudyCommand
from dynapix.data.records import FAMILIES, SelectionItem
from dynapix.data.store import Store
from dynapix.evaluation.reporting import measurements
from tests.evaluation.reporting import measured
from tests.evaluation.reporting.measured import finish, read_table, retrieve_run, run_report
from tests.evaluation.study.test_agreement import summarize, vote

pytestmark = pytest.mark.slow


def test_results_of_a_model_on_two_benchmarks_share_a_row(runs):
    shutil.copytree(runs / "select" / "cot", runs / "select" / "elsewhere")
    report = runs / "select" / "elsewhere" / "report.json"
    report.write_text(report.read_text().replace('"micro"', '"elsewhere"', 1))
    folder = run_report(runs, runs, items=1)
    for name, line in (("transfer", "cot (reasoning)"), ("ablation", "full student (cot)")):
        table = read_table(folder, name)
        [row] = [row for row in table.splitlines() if row.startswith(f"| {line} |")]
        assert row.count("100.0") == 2


def test_trainings_with_several_seeds_are_compared(runs, micro, micro_store, report):
    right, wrong = measured.right, measured.always_a
    for name, regime, respond in (("ours", "cot", right), ("plain", "cot_no_match_layout", wrong)):
        for seed in range(2):
            run = f"{name}-{seed}"
            measured.trained_student(runs, micro, run, regime, seed)
            measured.select_run(runs, micro_store, micro, run, respond, model=run)
            if name == "ours":
                other = {"model": run, "mode": "reasoning", "prompt_regime": "cot_no_match_layout"}
                measured.select_run(runs, micro_store, micro, f"{run}-other", wrong, **other)
    folder = report(items=1)
    table = read_table(folder, "seeds-micro")
    share = 100 * np.mean(
        [np.mean([i.letter == "A" for i in items]) for items in by_family(micro_store).values()]
    )
    [ours] = [row for row in table.splitlines() if row.startswith("| ours (answer) |")]
    [plain] = [row for row in table.splitlines() if row.startswith("| plain (answer) |")]
    assert ours.split("|")[5].strip() == "100.0"
    assert plain.split("|")[5].strip() == f"{share:.1f}"
    assert plain.split("|")[6].strip() == " ".join([f"{share:.1f}"] * 2)
    # Markdown escapes the underscores of a regime's name.
    asked = r"ours (reasoning, cot\_no\_match\_layout)"
    [other] = [row for row in table.splitlines() if row.startswith(f"| {asked} |")]
    assert other.split("|")[5].strip() == f"{share:.1f}"
    # Runs of one seed have no row, and neither has the student whose items differ.
    assert "cot (reasoning)" not in table
    differences = read_table(folder, "seed-differences-micro")
    start = "| ours (answer) minus plain (answer) |"
    [row] = [line for line in differences.splitlines() if line.startswith(start)]
    assert row.split("|")[5].strip() == f"{100 - share:+.1f}"


@pytest.mark.parametrize(
    ("name", "seed", "stripped"),
    [
        ("cot-0", 0, "cot"), ("cot_seed1", 1, "cot"), ("cot, seed=2", 2, "cot"),
        ("exp-cot+seed-4+train.lr-1e-4", 4, "exp-cot+train.lr-1e-4"), ("seed-10+x", 1, "seed-10+x"),
        ("cot_300", 0, "cot_300"), ("lr-10", 0, "lr-10"), ("v2", 2, "v2"), ("3", 3, "3"),
        ("checkpoints/sft/qwen3_vl_2b-cot-2", 2, "checkpoints/sft/qwen3_vl_2b-cot"),
    ],
)  # fmt: skip
def test_only_the_seed_of_a_name_is_left_out(name, seed, stripped) -> None:
    assert measurements._strip_seed(name, seed) == stripped


def by_family(store: Store) -> dict[str, list[SelectionItem]]:
    found: dict[str, list[SelectionItem]] = {}
    for item in store.selection("test"):
        found.setdefault(item.family, []).append(item)
    return found


def test_an_untrained_base_that_two_runs_measured_has_one_row(runs, micro, micro_store, report):
    retrieve_run(runs, micro_store, micro, "other")
    folder = report(runs=["retrieve/*"], items=1)
    table = read_table(folder, "distillation-retrieval-micro")
    assert table.count("| untrained small |") == 1
    assert table.count("| emb |") == table.count("| other |") == 1


def test_the_majority_vote_on_the_same_build_has_a_row_that_is_not_bold(runs, micro_store, report):
    votes = [vote(name, k, 0, FAMILIES[k % 3]) for k in range(6) for name in ("A1", "A2")]
    report_of = summarize(votes, 6, ["A1", "A2"], micro_store.identity)
    found = {**asdict(report_of), "benchmark": "micro"}
    finish(runs / "export_study" / "pilot", ExportStudyCommand(run="pilot"), found)
    folder = report(items=0)
    # Every vote is correct, and no cell is bold.
    cells = " | ".join(["100.0"] * 5)
    row = f"| Majority vote, pilot | {cells} | - | 6 |"
    assert row in read_table(folder, "selection-micro")
    other = {**found, "build": "before"}
    (runs / "export_study" / "pilot" / "report.json").write_text(json.dumps(other))
    folder = report(items=0)
    assert "Majority vote, pilot" not in read_table(folder, "selection-micro")
