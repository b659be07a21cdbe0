import json
from dataclasses import replace
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from PIL import Image

from data.records import Candidate, FrameRef, RetrievalQuery, SelectionItem
from evaluation.metrics.accuracy import accuracy_by_family
from evaluation.metrics.breakdown import compare_retrievers, recall_curves, selection_row
from evaluation.metrics.breakdown import retrieval_rows as retrieval_rows_of
from evaluation.metrics.intervals import wilson_interval
from evaluation.metrics.ranking import query_metrics, ranking_metrics
from evaluation.reporting import reference as paper
from evaluation.reporting.figures import (
    builders_figure,
    item_figure,
    retrieval_figure,
    selection_figure,
)
from evaluation.reporting.plots import confusion_figure, recall_figure
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
from train.common.curves import curves_figure


@pytest.fixture(scope="module")
def selection_rows() -> list[SelectionResult]:
    families = ["event"] * 20 + ["time"] * 30 + ["window"] * 50
    quarter = [1, 0, 0, 0] * 25
    name = "a student with a name that is much too long for any table"
    return [
        SelectionResult.of("tiny", UNTRAINED, "answer", accuracy_by_family(families, quarter), 0.9),
        SelectionResult.of("tiny", name, "reasoning", accuracy_by_family(families, [1] * 100), 1.0),
        SelectionResult.of(
            "tiny", "transfer", "similarity", accuracy_by_family(["event"], [1]), None
        ),
    ]


SCENES = 15


@pytest.fixture(scope="module")
def queries() -> list[RetrievalQuery]:
    """Four a scene, of builders 1 to 6 in turn."""
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
def retrieval_rows(ranks, queries) -> list[RetrievalResult]:
    names = ("contrastive", UNTRAINED)
    return [row for n in names for row in retrieval_rows_of("tiny", n, ranks, queries, seed=0)]


def test_rows_are_the_metrics_of_their_queries_with_an_interval_around(ranks, queries):
    rows = retrieval_rows_of("tiny", "one", ranks, queries, seed=3)
    assert [(r.builder, r.width) for r in rows] == [
        (builder, width) for builder in (None, 1, 2, 3, 4, 5, 6) for width in ranks.widths
    ]
    for row in rows:
        of = [k for k, q in enumerate(queries) if row.builder in (None, q.builder)]
        k = ranks.widths.index(row.width)
        counts = (ranks.greater[k, of], ranks.tied[k, of], ranks.found[k, of])
        metrics = ranking_metrics(*counts, 10_000, RECALLS)
        assert {name: found.value for name, found in row.measures.items()} == metrics
        assert (row.queries, row.frames) == (len(of), 10_000)
        for found in row.measures.values():
            assert found.low <= found.value <= found.high
            assert found.n == len(of)
    each = query_metrics(ranks.greater[1], ranks.tied[1], ranks.found[1], 10_000, RECALLS)
    scenes = [q.scene_id for q in queries]
    for name, statistic in (("mrr", np.mean), ("median_rank", np.median), ("recall@10", np.mean)):
        found = rows[1].measures[name]
        drawn = scene_interval(each[name], scenes, statistic, seed=3)
        assert (found.low, found.high) == pytest.approx(drawn)
    assert rows == retrieval_rows_of("tiny", "one", ranks, queries, seed=3)
    assert rows != retrieval_rows_of("tiny", "one", ranks, queries, seed=4)


def test_curves_rise_to_all_that_was_found(ranks, queries):
    curves = recall_curves("one", ranks, queries)
    assert [c["builder"] for c in curves] == [None, 1, 2, 3, 4, 5, 6]
    for curve in curves:
        assert (curve["ks"][0], curve["ks"][-1]) == (1, 10_000)
        assert curve["recalls"] == sorted(curve["recalls"])
    assert curves[0]["recalls"][-1] == pytest.approx(ranks.found[0].mean())
    rows = retrieval_rows_of("tiny", "one", ranks, queries, seed=0)
    assert curves[0]["recalls"][0] == pytest.approx(rows[0].recall_1.value)


def test_builder_tables_show_every_width_of_every_builder(retrieval_rows):
    trained, untrained = map(str, builder_tables(retrieval_rows))
    assert "contrastive by builder" in trained
    assert f"{UNTRAINED} by builder" in untrained
    for builder in range(1, 7):
        lines = [line for line in trained.splitlines() if line.startswith(f"builder {builder} ")]
        assert [line.split()[2] for line in lines] == ["4096", "256", "64"]
        assert all(line.count("[") == 6 for line in lines)


def test_an_index_stands_beside_its_size_and_time():
    told = {"name": "one (faiss)", "width": 64, "bytes": 3 << 20, "seconds": 0.5}
    table = str(index_table([told | {"recall@1": 0.981, "recall@10": 1.0, "recall@50": 0.5}]))
    assert table.splitlines()[2].split() == [
        "one", "(faiss)", "64", "98.1", "100.0", "50.0", "3.0", "0.50",
    ]  # fmt: skip


def test_what_a_row_costs_stands_beside_what_it_gives(retrieval_rows, ranks):
    rows = {r.width: r for r in retrieval_rows if r.builder is None and r.name == "contrastive"}
    table = str(cost_table(retrieval_rows)).splitlines()
    lines = [line for line in table if "contrastive" in line]
    assert max(map(len, table)) <= 100
    assert [float(line.split()[3]) for line in lines] == sorted(
        (round(r.mrr.value, 3) for r in rows.values()), reverse=True
    )
    told = {int(line.split()[1]): line.split()[4:] for line in lines}
    assert told == {4096: ["156.25", "12.35"], 256: ["9.77", "1,234.50"], 64: ["2.44", "0.01"]}
    assert {r.width: (r.bytes, r.seconds) for r in rows.values()} == {
        width: (ranks.bytes[k], ranks.seconds[k]) for k, width in enumerate(ranks.widths)
    }
    # In a report of several runs a retriever stands once.
    again = replace(rows[64], seconds=5.0)
    assert again == rows[64]
    assert hash(again) == hash(rows[64])


def test_selection_table(selection_rows):
    table = str(selection_table(selection_rows))
    assert max(map(len, table.splitlines())) <= 100
    assert "26.7" in table  # 8 of the 30 time items
    assert "…" in table
    assert "(reasoning)" in table
    own, reference = table.split("paper (full benchmark)")
    assert paper.COT.name in reference
    assert "96.7" in reference
    assert UNTRAINED in own


def test_the_papers_rows_stand_below_items_of_its_own_suite_alone(selection_rows):
    abroad = str(selection_table(selection_rows, "standin_physion"))
    assert paper.COT.name not in abroad
    assert "paper" not in abroad
    assert str(selection_table(selection_rows)).splitlines()[2:8] == abroad.splitlines()[2:8]


def test_columns_are_aligned(selection_rows, retrieval_rows):
    selection = str(selection_table(selection_rows)).splitlines()
    edge = selection[0].index("Macro") + len("Macro")
    assert selection[2][:edge].endswith(f"{100 * selection_rows[0].macro:.1f}")
    assert all(
        line[edge : edge + 2].strip() == "" for line in selection[2:-1] if line[0] not in "-p"
    )
    retrieval = str(retrieval_table(retrieval_rows)).splitlines()
    edge = retrieval[0].index("MRR") + len("MRR")
    own = [line for line in retrieval if line[0] not in "-pRI "]
    assert len(own) == 10
    assert all(line[edge - 5 : edge - 3] == "0." for line in own)


def test_retrieval_table_sets_the_untrained_row_beside_each_width(retrieval_rows):
    lines = str(retrieval_table(retrieval_rows)).splitlines()
    assert max(map(len, lines)) <= 100
    assert [line.split()[:2] for line in lines[2:14:2]] == [
        [name, str(width)] for width in (4096, 256, 64) for name in (UNTRAINED, "contrastive")
    ]


def test_a_row_holds_the_time_items_by_their_distance_and_macros_interval():
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
        assert row.horizons[horizon].value == pytest.approx(np.mean(of))
        assert (row.horizons[horizon].low, row.horizons[horizon].high) == wilson_interval(
            sum(of), len(of)
        )
    assert row.families == accuracy_by_family(families, credits).families
    assert row.macro_interval.value == pytest.approx(row.macro)
    assert SelectionResult.from_dict(json.loads(json.dumps(row.to_dict()))) == row
    table = str(selection_table([row]))
    assert max(map(len, table.splitlines())) <= 100
    own, reference = table.split("paper (full benchmark)")
    for part, share in ((own, f"{100 * row.horizons['2 s'].value:.1f}"), (reference, "37.6")):
        [line] = [x for x in part.splitlines() if "time, 2 s" in x and share in x]
        assert line.index(share) == table.index("Time")
    # An older report's row has neither.
    old = {k: v for k, v in row.to_dict().items() if k not in ("macro_interval", "horizons")}
    assert SelectionResult.from_dict(old).micro == row.micro


def test_rows_are_json(selection_rows, retrieval_rows):
    for row in (*selection_rows, *retrieval_rows):
        assert json.loads(json.dumps(row.to_dict())) == row.to_dict()
        assert type(row).from_dict(row.to_dict()) == row
    assert selection_rows[0].to_dict()["families"]["time"]["n"] == 30


def test_figures_are_written(selection_rows, retrieval_rows, ranks, queries, tmp_path):
    images = [Image.new("RGB", (48, 32), (i * 20, 90, 90)) for i in range(12)]
    question = "Which image best matches the next scene state?"
    selection_figure(selection_rows, tmp_path / "selection.png")
    retrieval_figure(retrieval_rows, tmp_path / "retrieval.png")
    curves = recall_curves("contrastive", ranks, queries)
    builders_figure(retrieval_rows, curves, tmp_path / "builders.png")
    for chosen in ("B", "C", None):
        path = tmp_path / f"item_{chosen}.png"
        item_figure(images, images[:4], "ABCD", "B", chosen, question, path)
    curves_figure(
        [{"step": 2, "loss": 1.0}, {"step": 1, "loss": 2.0}, {"step": 2, "eval_loss": 1.5,
         "eval_accuracy": 0.4, "eval_runtime": 3.0}, {"step": 2, "train_runtime": 9.0}],
        tmp_path / "losses.png",
    )  # fmt: skip
    curves_figure([], tmp_path / "no_losses.png")
    for path in tmp_path.iterdir():
        with Image.open(path) as image:
            assert image.width > 800
    assert len(list(tmp_path.iterdir())) == 8


def test_a_dollar_in_a_name_begins_no_formula(tmp_path):
    name = r"run $\frac$"
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        recall_figure(
            [{"name": name, "ks": [1, 10], "recalls": [0.1, 0.5]}], tmp_path / "recall.svg"
        )
        confusion_figure({name: np.eye(4, 5)}, tmp_path / "confusion.svg")
    for path in tmp_path.iterdir():
        assert f">{name}<" in path.read_text()


def test_the_frame_says_what_was_right(tmp_path):
    images = [Image.new("RGB", (48, 32), "white")] * 4
    pixels = {}
    for chosen in ("B", "C", None):
        item_figure(images, images, "ABCD", "B", chosen, "Which?", tmp_path / "item.png")
        with Image.open(tmp_path / "item.png") as image:
            pixels[chosen] = np.asarray(image.convert("RGB")).reshape(-1, 3)
    green, red = [0x22, 0x88, 0x33], [0xCC, 0x33, 0x11]
    for chosen, wrong in (("B", False), ("C", True), (None, True)):
        assert (pixels[chosen] == green).all(1).any()
        assert (pixels[chosen] == red).all(1).any() == wrong


def test_retrievers_are_apart_query_by_query():
    rng = np.random.default_rng(0)
    greater, found = rng.integers(40, size=(1, 60)), np.ones((1, 60), bool)
    none = np.zeros_like(greater)
    one = Ranks((8,), greater, none, found, 41)
    # Every target stands one place further back.
    other = Ranks((8,), greater + 1, none, found, 41)
    scenes = [SimpleNamespace(scene_id=f"s{k // 3}") for k in range(60)]
    (same,) = compare_retrievers({"one": one, "again": one}, scenes, 0)
    for measured in same["measures"].values():
        assert (measured["value"], measured["low"], measured["high"]) == (0, 0, 0)
    (apart,) = compare_retrievers({"one": one, "other": other}, scenes, 0)
    assert apart["measures"]["recall@1"]["value"] == (greater == 0).mean()
    assert all(0 <= m["low"] <= m["value"] <= m["high"] for m in apart["measures"].values())
    text = str(rank_differences_table([same, apart]))
    assert "one less again" in text
    assert "+0.0 to +0.0" in text
