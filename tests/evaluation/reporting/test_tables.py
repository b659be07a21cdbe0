"""The tables and figures of single evaluations."""

import json
from dataclasses import replace
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from PIL import Image

from data.records import Candidate, FrameRef, RetrievalQuery, SelectionItem
from evaluation.metrics.accuracy import accuracy_by_family
from evaluation.metrics.breakdown import (
    compare_retrievers,
    recall_curves,
    retrieval_rows,
    selection_row,
)
from evaluation.metrics.intervals import Interval, wilson_interval
from evaluation.metrics.ranking import query_metrics, ranking_metrics
from evaluation.reporting import figures
from evaluation.reporting.reference import COT_STUDENT
from evaluation.reporting.results import RECALLS, UNTRAINED, RetrievalResult, SelectionResult
from evaluation.reporting.tables import (
    builder_tables,
    cost_table,
    index_table,
    rank_differences_table,
    retrieval_table,
    selection_table,
)
from evaluation.retrieval.exact_search import Ranks
from tests.evaluation.metrics.reference import scene_interval
from train.common.curves import plot_curves

SCENES = 15


@pytest.fixture(scope="module")
def selections() -> list[SelectionResult]:
    families = ["event"] * 20 + ["time"] * 30 + ["window"] * 50
    quarter = [1, 0, 0, 0] * 25
    name = "a student with a name that is much too long for any table"
    return [
        SelectionResult.of("tiny", UNTRAINED, "answer", accuracy_by_family(families, quarter), 0.9),
        SelectionResult.of("tiny", name, "reasoning", accuracy_by_family(families, [1] * 100), 1.0),
        SelectionResult.of("tiny", "transfer", "similarity", accuracy_by_family(["event"], [1]),
                           None),
    ]  # fmt: skip


@pytest.fixture(scope="module")
def queries() -> list[RetrievalQuery]:
    """Four for each scene, of builders 1 to 6 in turn."""
    return [
        RetrievalQuery(
            f"q{k}", "test", "future", k % 6 + 1, "time", "Which?", f"scene-{k % SCENES}", 0, 50,
            FrameRef("scene", k), (),
        )
        for k in range(4 * SCENES)
    ]  # fmt: skip


@pytest.fixture(scope="module")
def ranks(queries) -> Ranks:
    rng = np.random.default_rng(0)
    shape = (3, len(queries))
    greater = np.floor(10 ** rng.uniform(0, 3.5, shape)).astype(int) - 1
    tied = rng.integers(3, size=shape) * (rng.random(shape) < 0.2)
    costs = ((4096 * 40_000, 256 * 40_000, 64 * 40_000), (12.3456, 1234.5, 0.01234))
    return Ranks((4096, 256, 64), greater, tied, rng.random(shape) > 0.05, 10_000, *costs)


@pytest.fixture(scope="module")
def retrievals(ranks, queries) -> list[RetrievalResult]:
    names = ("contrastive", UNTRAINED)
    return [row for n in names for row in retrieval_rows("tiny", n, ranks, queries, seed=0)]


def test_retrieval_rows_are_the_metrics_of_their_queries_with_intervals(ranks, queries):
    rows = retrieval_rows("tiny", "one", ranks, queries, seed=3)
    assert [(r.builder, r.width) for r in rows] == [
        (builder, width) for builder in (None, 1, 2, 3, 4, 5, 6) for width in ranks.widths
    ]
    for row in rows:
        of = [k for k, q in enumerate(queries) if row.builder in (None, q.builder)]
        k = ranks.widths.index(row.width)
        counts = (ranks.greater[k, of], ranks.tied[k, of], ranks.found[k, of])
        metrics = ranking_metrics(*counts, 10_000, RECALLS)
        assert {name: measure.value for name, measure in row.measures.items()} == metrics
        assert (row.queries, row.frames) == (len(of), 10_000)
        for measure in row.measures.values():
            assert measure.low <= measure.value <= measure.high
            assert measure.n == len(of)
    each = query_metrics(ranks.greater[1], ranks.tied[1], ranks.found[1], 10_000, RECALLS)
    scenes = [q.scene_id for q in queries]
    for name, statistic in (("mrr", np.mean), ("median_rank", np.median), ("recall@10", np.mean)):
        measure = rows[1].measures[name]
        resampled = scene_interval(each[name], scenes, statistic, seed=3)
        assert (measure.low, measure.high) == pytest.approx(resampled)
    assert rows == retrieval_rows("tiny", "one", ranks, queries, seed=3)
    assert rows != retrieval_rows("tiny", "one", ranks, queries, seed=4)


def test_recall_curves_rise_to_the_ranked_share(ranks, queries, retrievals):
    curves = recall_curves("one", ranks, queries)
    assert [c["builder"] for c in curves] == [None, 1, 2, 3, 4, 5, 6]
    for curve in curves:
        assert (curve["ks"][0], curve["ks"][-1]) == (1, 10_000)
        assert curve["recalls"] == sorted(curve["recalls"])
    assert curves[0]["recalls"][-1] == pytest.approx(ranks.found[0].mean())
    assert curves[0]["recalls"][0] == pytest.approx(retrievals[0].recall_1.value)


def test_selection_rows_hold_horizons_and_the_interval_of_macro():
    families = ["event"] * 20 + ["time"] * 30 + ["window"] * 50
    items = [
        SelectionItem(
            f"i{k}", "test", "dynapix", family, ("in_1s", "in_2s")[k % 2], "Which?", f"s{k % 9}",
            0, 20, 40, tuple(Candidate(f"s{k % 9}", f, "x") for f in (40, 50, 60, 70)), 0, 12.0,
        )
        for k, family in enumerate(families)
    ]  # fmt: skip
    credits = [1.0, 0.0, 0.0, 0.5] * 25
    row = selection_row("tiny", "one", "answer", items, credits, 1.0, seed=4)
    for k, horizon in enumerate(("1 s", "2 s")):
        of = [c for n, c in enumerate(credits) if families[n] == "time" and n % 2 == k]
        share = row.horizons[horizon]
        assert share.value == pytest.approx(np.mean(of))
        assert (share.low, share.high) == wilson_interval(sum(of), len(of))
    assert row.families == accuracy_by_family(families, credits).families
    assert row.macro_interval.value == pytest.approx(row.macro)
    assert SelectionResult.from_dict(json.loads(json.dumps(row.to_dict()))) == row
    table = str(selection_table([row]))
    own, paper = table.split("paper (full benchmark)")
    for part, share in ((own, f"{100 * row.horizons['2 s'].value:.1f}"), (paper, "37.6")):
        [line] = [x for x in part.splitlines() if "time, 2 s" in x and share in x]
        assert line.index(share) == table.index("Time")


def test_rows_survive_json(selections, retrievals):
    for row in (*selections, *retrievals):
        assert json.loads(json.dumps(row.to_dict())) == row.to_dict()
        assert type(row).from_dict(row.to_dict()) == row


def test_selection_table_fits_the_screen_and_ends_with_the_paper(selections):
    table = str(selection_table(selections))
    assert max(map(len, table.splitlines())) <= 100
    assert "26.7" in table  # 8 of the 30 time items
    own, paper = table.split("paper (full benchmark)")
    assert UNTRAINED in own
    assert COT_STUDENT in paper
    edge = table.index("Macro") + len("Macro")
    assert table.splitlines()[2][:edge].endswith(f"{100 * selections[0].macro:.1f}")
    other_suite = str(selection_table(selections, "standin_physion"))
    assert "paper" not in other_suite
    assert table.splitlines()[2:8] == other_suite.splitlines()[2:8]


def test_retrieval_table_puts_the_untrained_row_beside_each_width(retrievals):
    lines = str(retrieval_table(retrievals)).splitlines()
    assert max(map(len, lines)) <= 100
    assert [line.split()[:2] for line in lines[2:14:2]] == [
        [name, str(width)] for width in (4096, 256, 64) for name in (UNTRAINED, "contrastive")
    ]


def test_builder_tables_show_every_width_of_every_builder(retrievals):
    trained, untrained = map(str, builder_tables(retrievals))
    assert "contrastive by builder" in trained
    assert f"{UNTRAINED} by builder" in untrained
    for builder in range(1, 7):
        lines = [line for line in trained.splitlines() if line.startswith(f"builder {builder} ")]
        assert [line.split()[2] for line in lines] == ["4096", "256", "64"]
        assert all(line.count("[") == 6 for line in lines)


def test_index_table_shows_recall_size_and_time():
    index = {"name": "one (faiss)", "width": 64, "bytes": 3 << 20, "seconds": 0.5}
    table = str(index_table([index | {"recall@1": 0.981, "recall@10": 1.0, "recall@50": 0.5}]))
    assert table.splitlines()[2].split() == [
        "one", "(faiss)", "64", "98.1", "100.0", "50.0", "3.0", "0.50",
    ]  # fmt: skip


def test_cost_table_is_sorted_by_quality_and_time_does_not_distinguish_rows(retrievals, ranks):
    rows = {r.width: r for r in retrievals if r.builder is None and r.name == "contrastive"}
    table = str(cost_table(retrievals)).splitlines()
    lines = [line for line in table if "contrastive" in line]
    assert max(map(len, table)) <= 100
    assert [float(line.split()[3]) for line in lines] == sorted(
        (round(r.mrr.value, 3) for r in rows.values()), reverse=True
    )
    costs = {int(line.split()[1]): line.split()[4:] for line in lines}
    assert costs == {4096: ["156.25", "12.35"], 256: ["9.77", "1,234.50"], 64: ["2.44", "0.01"]}
    again = replace(rows[64], seconds=5.0)
    assert again == rows[64]
    assert hash(again) == hash(rows[64])


def test_differences_between_retrievers_are_paired_by_query():
    rng = np.random.default_rng(0)
    greater, found = rng.integers(40, size=(1, 60)), np.ones((1, 60), bool)
    none = np.zeros_like(greater)
    one = Ranks((8,), greater, none, found, 41)
    # Every target is one rank lower.
    other = Ranks((8,), greater + 1, none, found, 41)
    scenes = [SimpleNamespace(scene_id=f"s{k // 3}") for k in range(60)]
    (same,) = compare_retrievers({"one": one, "again": one}, scenes, 0)
    for measure in same["measures"].values():
        assert (measure["value"], measure["low"], measure["high"]) == (0, 0, 0)
    (different,) = compare_retrievers({"one": one, "other": other}, scenes, 0)
    assert different["measures"]["recall@1"]["value"] == (greater == 0).mean()
    assert all(0 <= m["low"] <= m["value"] <= m["high"] for m in different["measures"].values())
    text = str(rank_differences_table([same, different]))
    assert "one less again" in text
    assert "+0.0 to +0.0" in text


def test_horizons_pool_their_subtypes():
    def share(value, n):
        return Interval(value, 0.0, 1.0, n)

    horizons = figures.accuracy_by_horizon(
        {
            "time/in_2s": share(0.25, 8),
            "window/G1_A_h16_easy": share(0.5, 4),
            "window/G2_B_h16_hard": share(1.0, 2),
            "window/G2_B_h8_hard": share(1.0, 1),
            "time/in_1s": share(0.5, 2),
            "event/contact_cross": share(1.0, 9),
        }
    )
    assert list(horizons) == ["8 frames", "16 frames", "1 s", "2 s"]
    assert (horizons["16 frames"].value, horizons["16 frames"].n) == (pytest.approx(4 / 6), 6)
    assert all(i.low <= i.value <= i.high for i in horizons.values())


def test_confusions_count_every_answer_once():
    pairs = [("A", "A"), ("A", "B"), ("B", None), ("D", "D"), ("D", "D")]
    counts = figures.count_confusions(pairs)
    assert counts.sum() == len(pairs)
    assert counts[0].tolist() == [1, 1, 0, 0, 0]
    assert counts[1].tolist() == [0, 0, 0, 0, 1]
    assert np.trace(counts) == 3


def test_figures_are_written(selections, retrievals, ranks, queries, tmp_path):
    figures.selection_figure(selections, tmp_path / "selection.png")
    figures.retrieval_figure(retrievals, tmp_path / "retrieval.png")
    curves = recall_curves("contrastive", ranks, queries)
    figures.builders_figure(retrievals, curves, tmp_path / "builders.png")
    plot_curves(
        [{"step": 2, "loss": 1.0}, {"step": 1, "loss": 2.0}, {"step": 2, "eval_loss": 1.5,
         "eval_accuracy": 0.4, "eval_runtime": 3.0}, {"step": 2, "train_runtime": 9.0}],
        tmp_path / "losses.png",
    )  # fmt: skip
    plot_curves([], tmp_path / "no_losses.png")
    for path in tmp_path.iterdir():
        with Image.open(path) as image:
            assert image.width > 800
    assert len(list(tmp_path.iterdir())) == 5


def test_a_dollar_sign_in_a_name_begins_no_formula(tmp_path):
    name = r"run $\frac$"
    curve = {"name": name, "ks": [1, 10], "recalls": [0.1, 0.5]}
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        figures.recall_figure([curve], tmp_path / "recall.svg")
        figures.confusion_figure({name: np.eye(4, 5)}, tmp_path / "confusion.svg")
    for path in tmp_path.iterdir():
        assert f">{name}<" in path.read_text()


@pytest.mark.parametrize(("chosen", "wrong"), [("B", False), ("C", True), (None, True)])
def test_item_figure_frames_the_target_green_and_a_wrong_choice_red(tmp_path, chosen, wrong):
    images = [Image.new("RGB", (48, 32), "white")] * 12
    path = tmp_path / "item.png"
    figures.item_figure(images, images[:4], "ABCD", "B", chosen, "Which?", path)
    with Image.open(path) as image:
        pixels = np.asarray(image.convert("RGB")).reshape(-1, 3)
    assert (pixels == [0x22, 0x88, 0x33]).all(1).any()
    assert (pixels == [0xCC, 0x33, 0x11]).all(1).any() == wrong
