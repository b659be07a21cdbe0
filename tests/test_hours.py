"""GPU hours follow from measured rates only; a missing rate gives no figure."""

from __future__ import annotations

import json
from pathlib import Path

import pytest

from benchmarks.speed import hours
from tests.user_errors import raises_user_error

FAST = hours.Rate("sft_gpu", "qwen3_vl_8b", "nf4", 10.0, "a card", "2026-01-31")


@pytest.fixture(scope="module")
def steps() -> dict[str, hours.Step]:
    return {s.name: s for s in hours.steps("qwen3_vl_8b", "qwen3_vl_emb_8b")}


def test_hours_are_passes_over_the_rate() -> None:
    assert hours.hours(36_000, 10.0) == 1.0
    assert hours.hours(36_000, 2.5) == 4 * hours.hours(36_000, 10.0)


def test_a_run_passes_what_the_paper_trains_on_each_epoch(steps: dict[str, hours.Step]) -> None:
    items, queries, epochs = 1_151 + 1_619 + 6_598, 18_000, 3
    assert steps["train.sft +exp=answer_only"].passes == items * epochs
    assert steps["train.sft +exp=cot"].passes == 2 * items * epochs
    assert steps["train.contrastive"].passes == queries * epochs


def test_a_rate_gives_the_hours_of_the_steps_that_it_measures(
    steps: dict[str, hours.Step],
) -> None:
    shown = hours.table(list(steps.values()), [FAST])
    cot = next(line for line in shown.splitlines() if line.startswith("train.sft +exp=cot "))
    assert f"{2 * 9_368 * 3 / 10 / 3600:.1f}  a card, 2026-01-31" in cot
    (missing,) = [line for line in shown.splitlines() if "No rate" in line]
    assert "train.contrastive" in missing
    assert "python -m benchmarks.speed.contrastive_gpu qwen3_vl_8b --base nf4" in missing


def test_without_a_rate_no_figure_is_given(steps: dict[str, hours.Step]) -> None:
    other = [FAST, hours.Rate("sft_gpu", "qwen3_vl_2b", "nf4", 30.0, "a card", "2026-01-31")]
    for rates in ([], [r for r in other if r.preset == "qwen3_vl_2b"]):
        shown = hours.table(list(steps.values()), rates)
        assert all(line.startswith("No rate is measured for") for line in shown.splitlines())
        assert "python -m benchmarks.speed.sft_gpu qwen3_vl_8b --base nf4" in shown


def test_of_a_card_the_last_rate_counts(tmp_path: Path, steps: dict[str, hours.Step]) -> None:
    path = tmp_path / "rates.jsonl"
    assert hours.read(path) == []
    for rate, card in ((1.0, "a card"), (4.0, "another card"), (8.0, "a card")):
        hours.add("sft_gpu", "qwen3_vl_8b", "nf4", rate, card, path)
    shown = hours.table([steps["train.sft +exp=cot"]], hours.read(path)).splitlines()
    assert [float(line.split()[3]) for line in shown[1:]] == [8.0, 4.0]


@pytest.mark.parametrize(
    "line", ["{", json.dumps({"rate": 3}), json.dumps(vars(FAST) | {"rate": 0})]
)
def test_a_line_that_is_no_rate_is_named(tmp_path: Path, line: str) -> None:
    path = tmp_path / "rates.jsonl"
    path.write_text(f"{json.dumps(vars(FAST))}\n{line}\n")
    with raises_user_error("damaged-file", contains="rates.jsonl, line 2"):
        hours.read(path)
