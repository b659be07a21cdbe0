import pytest

from evaluation.reporting import reference as paper
from evaluation.reporting.reference import SelectionReference

SELECTION = [
    paper.CHANCE,
    paper.HUMAN_MAJORITY,
    *paper.SELECTION_SIMILARITY,
    *paper.SELECTION_GENERATIVE,
    *paper.SELECTION_DISTILLED,
]
ITEMS = {"event": 249, "time": 374, "window": 1585}


@pytest.mark.parametrize("row", SELECTION, ids=lambda row: row.name)
def test_macro_is_the_mean_of_the_families(row: SelectionReference):
    # Each printed figure is within 0.05 of the true one.
    assert row.macro == pytest.approx((row.event + row.time + row.window) / 3, abs=0.1)


@pytest.mark.parametrize("row", paper.SELECTION_DISTILLED, ids=lambda row: row.name)
def test_micro_is_the_families_by_their_items(row: SelectionReference):
    pooled = sum(getattr(row, f) * n for f, n in ITEMS.items()) / sum(ITEMS.values())
    assert row.micro == pytest.approx(pooled, abs=0.1)


@pytest.mark.parametrize("row", [paper.ZERO_SHOT, paper.COT], ids=lambda row: row.name)
def test_time_is_its_horizons_by_their_items(row: SelectionReference):
    near, far = paper.TIME_BY_HORIZON[row.name].values()
    assert row.time == pytest.approx((near * 111 + far * 263) / 374, abs=0.1)


def test_rows_that_the_paper_prints_twice_agree():
    base = next(r for r in paper.SELECTION_GENERATIVE if r.name == "Qwen3-VL-8B (instruct)")
    for key in ("event", "time", "window", "macro"):
        assert getattr(base, key) == getattr(paper.ZERO_SHOT, key)
    pairs = [
        (paper.RETRIEVAL_TWO_STAGE[0], paper.RETRIEVAL_DISTILLED[0]),
        (paper.RETRIEVAL_DIRECT[-1], paper.RETRIEVAL_DISTILLED[2]),
    ]
    for one, other in pairs:
        for key in ("recall_1", "recall_10", "recall_50", "mrr", "median_rank"):
            assert getattr(one, key) == getattr(other, key)
    assert paper.TRANSFER[0].clevrer == paper.ZERO_SHOT.micro
    assert paper.ABLATION[0].clevrer == paper.COT.micro


@pytest.mark.parametrize(
    "row",
    [*paper.RETRIEVAL_DIRECT, *paper.RETRIEVAL_TWO_STAGE, *paper.RETRIEVAL_DISTILLED],
    ids=lambda row: row.name,
)
def test_retrieval_rows_are_possible(row):
    assert 0 < row.recall_1 < row.recall_10 < row.recall_50 < 100
    assert row.recall_1 / 100 < row.mrr < 1
    assert (row.median_rank <= 10) == (row.recall_10 >= 50)
    assert (row.median_rank <= 50) == (row.recall_50 >= 50)
