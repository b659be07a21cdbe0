"""The paper's printed numbers are consistent with each other."""

import pytest

from dynapix.evaluation.reporting.reference import COT_STUDENT, reference

ITEMS = {"Event": 249, "Time": 374, "Window": 1585}
HORIZON_ITEMS = {"1 s": 111, "2 s": 263}
SELECTION = [
    row
    for group in ("chance", "human_majority", "selection_similarity", "selection_generative",
                  "selection_distilled")
    for row in reference(group)
]  # fmt: skip


def find_row(group: str, name: str) -> dict:
    return next(row for row in reference(group) if row["name"] == name)


@pytest.mark.parametrize("row", SELECTION, ids=lambda row: row["name"])
def test_printed_macro_accuracies_are_the_means_of_the_families(row):
    # Printed values are rounded to 0.1.
    assert row["Macro"] == pytest.approx(sum(row[f] for f in ITEMS) / 3, abs=0.1)


@pytest.mark.parametrize("row", reference("selection_distilled"), ids=lambda row: row["name"])
def test_printed_micro_and_time_accuracies_are_means_weighted_by_items(row):
    pooled = sum(row[f] * n for f, n in ITEMS.items()) / sum(ITEMS.values())
    assert row["Micro"] == pytest.approx(pooled, abs=0.1)
    if "horizons" in row:
        time = sum(row["horizons"][h] * n for h, n in HORIZON_ITEMS.items()) / ITEMS["Time"]
        assert row["Time"] == pytest.approx(time, abs=0.1)


def test_rows_that_the_paper_prints_twice_agree():
    base = find_row("selection_distilled", "Zero-shot (base)")
    released = find_row("selection_generative", "Qwen3-VL-8B (instruct)")
    assert all(base[key] == released[key] for key in ("Event", "Time", "Window", "Macro"))
    for one, other in (
        (reference("retrieval_two_stage")[0], reference("retrieval_distilled")[0]),
        (reference("retrieval_direct")[-1], reference("retrieval_distilled")[2]),
    ):
        assert all(one[key] == other[key] for key in one if key != "name")
    assert reference("transfer")[0]["In domain"] == base["Micro"]
    cot = find_row("selection_distilled", COT_STUDENT)
    assert reference("ablation")[0]["In domain"] == cot["Micro"]
