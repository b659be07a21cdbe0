"""The results, tables and figures of single evaluations."""

import json
import re
from dataclasses import asdict, replace
from types import SimpleNamespace

import matplotlib
import numpy as np
import pytest
from PIL import Image

from dynapix.data.checks.intervals import SceneBootstrap
from dynapix.data.records import Candidate, FrameRef, RetrievalQuery, SelectionItem
from dynapix.evaluation.metrics.ranking import query_metrics
from dynapix.evaluation.metrics.results import (
    MEASURES,
    RECALLS,
    UNTRAINED,
    CounterfactualResult,
    RetrievalReport,
    RetrievalResult,
    SelectionResult,
    accuracy_by_family,
    compare_retrievers,
    from_json,
    retrieval_results,
)
from dynapix.evaluation.metrics.selection import Choices, build_selection_report
from dynapix.evaluation.reporting import figures
from dynapix.evaluation.reporting.reference import COT_STUDENT
from dynapix.evaluation.reporting.tables import (
    rank_differences_table,
    retrieval_table,
    selection_table,
)
from dynapix.evaluation.retrieval.exact_search import Ranks
from dynapix.train.common.curves import plot_curves
from tests.evaluation.metrics.reference import ranking_metrics, scene_interval

SCENES = 15
FAMILIES = ["event"] * 20 + ["time"] * 30 + ["window"] * 50
CREDITS = [1.0, 0.0, 0.0, 0.5] * 25


@pytest.fixture(scope="module")
def selection() -> SelectionResult:
    items = [
        SelectionItem(
            f"i{k}", "test", "dynapix", family, ("in_1s", "in_2s")[k % 2], "Which?", f"s{k % 9}",
            0, 20, 40, tuple(Candidate(f"s{k % 9}", f, "x") for f in (40, 50, 60, 70)), 0, 12.0,
            horizon=(8, 16)[k % 2],
        )
        for k, family in enumerate(FAMILIES)
    ]  # fmt: skip
    choices = Choices("one", "answer", None, CREDITS, ["A"] * len(items))
    store = SimpleNamespace(name="tiny", identity="build")
    return build_selection_report([choices], items, store, seed=4).rows[0]


@pytest.fixture(scope="module")
def queries() -> list[RetrievalQuery]:
    """Four queries for each scene, which builders 1 to 6 made in turn."""
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
    above = np.floor(10 ** rng.uniform(0, 3.5, shape)).astype(int) - 1
    tied = rng.integers(3, size=shape) * (rng.random(shape) < 0.2)
    found = rng.random(len(queries)) > 0.05
    return Ranks((4096, 256, 64), above, tied, found, 10_000, vectors=10_000, seconds=1234.5)


@pytest.fixture(scope="module")
def retrievals(ranks, queries) -> list[RetrievalResult]:
    names = ("contrastive", UNTRAINED)
    return [row for n in names for row in retrieval_results("tiny", n, ranks, queries, seed=0)]


def test_retrieval_results_match_reference_metrics_and_intervals(ranks, queries):
    results = retrieval_results("tiny", "one", ranks, queries, seed=3)
    assert [(r.builder, r.width) for r in results] == [
        (builder, width) for builder in (None, 1, 2, 3, 4, 5, 6) for width in ranks.widths
    ]
    for result in results:
        indices = [i for i, q in enumerate(queries) if result.builder in (None, q.builder)]
        k = ranks.widths.index(result.width)
        counts = (ranks.above[k, indices], ranks.tied[k, indices], ranks.found[indices])
        metrics = ranking_metrics(*counts, 10_000, RECALLS)
        assert {name: measure.value for name, measure in result.measures.items()} == metrics
        assert (result.queries, result.frames) == (len(indices), 10_000)
        for measure in result.measures.values():
            assert measure.low <= measure.value <= measure.high
            assert measure.n == len(indices)
    each = query_metrics(ranks.above[1], ranks.tied[1], ranks.found, 10_000, RECALLS)
    scenes = [q.scene_id for q in queries]
    for name, statistic in (("mrr", np.mean), ("median_rank", np.median), ("recall@10", np.mean)):
        measure = results[1].measures[name]
        resampled = scene_interval(each[name], scenes, statistic, seed=3)
        assert (measure.low, measure.high) == pytest.approx(resampled)
    assert results == retrieval_results("tiny", "one", ranks, queries, seed=3)
    assert results != retrieval_results("tiny", "one", ranks, queries, seed=4)


def test_selection_results_have_horizons_and_an_interval_of_macro(selection):
    assert list(selection.horizons) == ["8 frames", "16 frames", "1 s", "2 s"]
    for name, accuracy in selection.horizons.items():
        family = "time" if name.endswith(" s") else "window"
        parity = name in ("2 s", "16 frames")
        credits = [c for k, c in enumerate(CREDITS) if FAMILIES[k] == family and k % 2 == parity]
        assert (accuracy.value, accuracy.n) == (pytest.approx(np.mean(credits)), len(credits))
    scenes = SceneBootstrap([f"s{k % 9}" for k in range(len(CREDITS))], seed=4)
    accuracy = accuracy_by_family(FAMILIES, CREDITS, scenes)
    assert selection.families == accuracy.families
    assert (selection.macro, selection.micro) == (accuracy.macro, accuracy.micro)
    table = str(selection_table([selection]))
    own, paper = table.split("paper (full benchmark)")
    assert COT_STUDENT in paper
    for part, share in ((own, f"{100 * selection.horizons['2 s'].value:.1f}"), (paper, "37.6")):
        [line] = [x for x in part.splitlines() if "time, 2 s" in x and share in x]
        head = table.splitlines()[2]
        assert line.index(share) == head.index("Time")
    assert "paper" not in str(selection_table([selection], "standin_physion"))


def test_results_can_be_read_from_json(selection, retrievals):
    for result in (selection, *retrievals):
        assert from_json(type(result), json.loads(json.dumps(asdict(result)))) == result
    with pytest.raises(ValueError, match="recall_1"):
        from_json(RetrievalResult, {**asdict(retrievals[0]), "recall_1": 0.5})


def test_the_retrieval_table_has_untrained_rows_and_costs_at_each_width(retrievals):
    lines = [line.split() for line in str(retrieval_table(retrievals)).splitlines()[4:16:2]]
    assert [line[:2] for line in lines] == [
        [name, str(width)] for width in (4096, 256, 64) for name in (UNTRAINED, "contrastive")
    ]
    costs = [line[-2:] for line in lines[::2]]
    assert costs == [["156.25", "1,234.50"], ["9.77", "1,234.50"], ["2.44", "1,234.50"]]
    again = replace(retrievals[0], seconds=5.0)
    assert again == retrievals[0]
    assert hash(again) == hash(retrievals[0])


def test_differences_between_retrievers_are_paired_by_query():
    rng = np.random.default_rng(0)
    above, found = rng.integers(40, size=(1, 60)), np.ones(60, bool)
    none = np.zeros_like(above)
    one = Ranks((8,), above, none, found, 41, vectors=41, seconds=0.5)
    # Every target ranks one place worse.
    other = replace(one, above=above + 1)
    scenes = [SimpleNamespace(scene_id=f"s{k // 3}") for k in range(60)]
    (same,) = compare_retrievers({"one": one, "again": one}, scenes, 0)
    for measure in same.measures.values():
        assert (measure.value, measure.low, measure.high) == (0, 0, 0)
    (different,) = compare_retrievers({"one": one, "other": other}, scenes, 0)
    assert different.measures["recall@1"].value == (above == 0).mean()
    assert all(0 <= m.low <= m.value <= m.high for m in different.measures.values())
    text = str(rank_differences_table([same, different]))
    assert "one minus again" in text
    assert "+0.0 to +0.0" in text


def test_counterfactual_results_have_the_share_of_twins_and_tables_of_their_own(ranks, queries):
    rng = np.random.default_rng(1)
    twins = rng.integers(3, size=ranks.above.shape) / 2
    cf = [replace(q, pool="counterfactual", builder=None) for q in queries]
    results = retrieval_results("tiny", "one", replace(ranks, twin_above=twins), cf, seed=3)
    plain = retrieval_results("tiny", "one", ranks, cf, seed=3)
    assert [r.width for r in results] == list(ranks.widths)
    for k, (result, other) in enumerate(zip(results, plain, strict=True)):
        assert [*result.measures] == [*MEASURES, "twin_above"]
        assert {name: result.measures[name] for name in MEASURES} == other.measures
        share = result.twin_above
        assert share.value == pytest.approx(twins[k].mean())
        interval = scene_interval(twins[k], [q.scene_id for q in cf], np.mean, seed=3)
        assert (share.low, share.high) == pytest.approx(interval)
    report = RetrievalReport("build", [results[0], plain[0]])
    again = from_json(RetrievalReport, json.loads(json.dumps(asdict(report))))
    assert again == report
    assert [type(row) for row in again.rows] == [CounterfactualResult, RetrievalResult]
    own, standard = (str(retrieval_table(rows)) for rows in (results, plain))
    assert "Twin" in own.splitlines()[2]
    assert "Twin" not in standard
    assert "paper" in standard
    assert "paper" not in own

    fewer = replace(ranks, twin_above=twins / 2)
    ranked = {"one": replace(ranks, twin_above=twins), "other": fewer}
    for k, difference in enumerate(compare_retrievers(ranked, cf, 0)):
        assert difference.measures["twin_above"].value == pytest.approx(twins[k].mean() / 2)
        assert "Twin" in str(rank_differences_table([difference]))


def test_figures_are_written(selection, retrievals, tmp_path):
    figures.plot_accuracies({"one": selection.families}, tmp_path / "selection.png")
    figures.plot_accuracies({"one": selection.horizons}, tmp_path / "horizons.png")
    figures.plot_recalls([(r.name, r) for r in retrievals], tmp_path / "retrieval.png")
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


def test_dollar_signs_in_labels_are_not_parsed_as_math(selection, tmp_path):
    name = r"run $\frac$"
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        figures.plot_accuracies({name: selection.families}, tmp_path / "accuracy.svg")
    assert f">{name}<" in (tmp_path / "accuracy.svg").read_text()


def test_the_whole_names_of_many_runs_are_in_the_legend(selection, tmp_path):
    words = " ".join(f"word{k}" for k in range(30))
    names = [f"{words} of run {k}" for k in range(8)]
    with matplotlib.rc_context({"svg.fonttype": "none"}):
        figures.plot_accuracies(dict.fromkeys(names, selection.families), tmp_path / "many.svg")
    text = (tmp_path / "many.svg").read_text()
    for k in range(8):
        assert f"of run {k}<" in text
    legend = re.findall(r'<text [^>]*translate\(([\d.]+) ([\d.]+)\)"[^>]*>word0', text)
    width, height = map(float, re.search(r'width="([\d.]+)pt" height="([\d.]+)pt"', text).groups())
    assert len(legend) == 8
    assert all(0 < float(x) < width / 4 and 0 < float(y) < height for x, y in legend)
