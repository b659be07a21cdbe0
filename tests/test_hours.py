"""GPU hours are computed from measured rates; a run without a measured rate has no hours."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.speed import hours
from tests.user_errors import raises_user_error

FAST = hours.Rate("sft", "qwen3_vl_8b", "nf4", 10.0, "a card", "2026-01-31", "torch 2.14.0")
COT = "train.sft +exp=cot"


@pytest.fixture(scope="module")
def runs() -> dict[str, hours.TrainingRun]:
    return {run.name: run for run in hours.list_runs("qwen3_vl_8b", "qwen3_vl_emb_8b")}


def test_a_run_trains_on_the_papers_samples_in_each_epoch(runs) -> None:
    items, queries, epochs = 1_151 + 1_619 + 6_598, 20_498, 3
    assert runs["train.sft +exp=answer_only"].samples == items * epochs
    assert runs[COT].samples == 2 * items * epochs
    assert runs["train.contrastive"].samples == queries * epochs


def test_hours_are_samples_divided_by_the_rate(runs) -> None:
    table = hours.format_table(list(runs.values()), [FAST])
    cot = next(line for line in table.splitlines() if line.startswith(f"{COT} "))
    assert f"{2 * 9_368 * 3 / 10 / 3600:.1f}  a card, 2026-01-31, torch 2.14.0" in cot
    (missing,) = [line for line in table.splitlines() if "train.contrastive" in line]
    assert missing.startswith("No rate is measured for train.contrastive: ")
    assert "python -m benchmarks.speed.contrastive qwen3_vl_emb_8b --quantization nf4" in missing


def test_the_last_rate_of_a_card_is_used(tmp_path: Path, runs) -> None:
    path = tmp_path / "rates.jsonl"
    assert hours.read_rates(path) == []
    for rate, card in ((1.0, "a card"), (4.0, "another card"), (8.0, "a card")):
        hours.add_rate("sft", "qwen3_vl_8b", "nf4", rate, card, path)
    table = hours.format_table([runs[COT]], hours.read_rates(path)).splitlines()
    assert [float(line.split()[3]) for line in table[1:]] == [8.0, 4.0]


@pytest.mark.parametrize(
    "line", ["{", json.dumps({"rate": 3}), json.dumps(vars(FAST) | {"rate": 0})]
)
def test_an_invalid_line_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "rates.jsonl"
    path.write_text(f"{json.dumps(vars(FAST))}\n{line}\n")
    with raises_user_error("damaged-file", contains="rates.jsonl, line 2"):
        hours.read_rates(path)
