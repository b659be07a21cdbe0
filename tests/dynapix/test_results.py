"""Results: they are saved, read back, and shown in the report."""

from __future__ import annotations

import json

import numpy as np
import pandas as pd
import pytest

import dynapix
from dynapix.data.checks import observer
from dynapix.data.checks.observer import ERRORS, EXTRAPOLATES, SIMULATES
from tests.dynapix.models import always_a, nearest
from tests.evaluation.reporting.measured import run_report
from tests.user_errors import raises_user_error


@pytest.mark.parametrize("predict", [always_a, nearest])
def test_a_saved_result_is_read_back_unless_it_is_damaged(bench, tmp_path, predict) -> None:
    def sometimes(item: dynapix.Item) -> object:
        return None if item.item_id == bench.selection[3].item_id else predict(item)

    result = dynapix.evaluate(bench.selection, sometimes, name="mine", progress=False)
    folder = result.save(tmp_path / "mine")
    again = dynapix.Result.load(folder, bench)
    assert (again.name, again.outcomes) == (result.name, result.outcomes)
    assert again.failures == result.failures
    assert again.report == result.report
    # Saving again replaces the result.
    assert result.save(folder) == folder

    report = json.loads((folder / "report.json").read_text())
    (folder / "report.json").write_text(json.dumps({**report, "build": "other"}))
    with raises_user_error("different-builds", contains=str(folder)):
        dynapix.Result.load(folder, bench)
    (folder / "report.json").write_text(json.dumps(report))
    [rows] = [path for path in folder.glob("*s.jsonl") if path.name != "failures.jsonl"]
    rows.write_text('{"text": "A"}\n')
    with raises_user_error("damaged-file", contains="item_id"):
        dynapix.Result.load(folder, bench)
    with raises_user_error("damaged-file", contains=str(tmp_path / "none")):
        dynapix.Result.load(tmp_path / "none", bench)


def test_embeddings_that_find_every_target_have_full_recall(bench) -> None:
    frames = np.eye(len(bench.database), dtype=np.float32)
    names = [frame.name for frame in bench.database]
    queries = frames[[names.index(query.target.name) for query in bench.retrieval]]
    ids = [query.query_id for query in bench.retrieval]
    by_name = dict(zip(ids, queries, strict=True)), dict(zip(names, frames, strict=True))
    expected = {"recall@1": 1, "recall@10": 1, "recall@50": 1, "mrr": 1, "median_rank": 1}
    for embeddings in ((queries, frames), by_name):
        scores = dynapix.evaluate_retrieval(bench.retrieval, *embeddings)
        assert scores.metrics == {**expected, "tie_rate": 0}
    constant = dynapix.evaluate_retrieval(
        bench.retrieval, np.ones_like(queries), np.ones_like(frames)
    )
    assert constant.metrics["recall@1"] == pytest.approx(1 / len(names))


def test_a_retriever_of_counterfactual_frames_ranks_no_factual_twin_above(bench) -> None:
    bench = dynapix.load(bench.store.folder, pool="counterfactual")
    frames = np.eye(len(bench.database), dtype=np.float32)
    rows = dict(zip((frame.name for frame in bench.database), frames, strict=True))
    by_oracle = {q.query_id: rows[q.target.name] for q in bench.retrieval}
    by_factual_scene = {q.query_id: rows[q.hard_negatives[0].name] for q in bench.retrieval}
    constant = dict.fromkeys(by_oracle, np.ones_like(frames[0]))
    for queries, share in ((by_oracle, 0), (by_factual_scene, 1), (constant, 0.5)):
        scores = dynapix.evaluate_retrieval(bench.retrieval, queries, rows)
        assert scores.metrics["twin_above"] == share
        assert (scores.metrics["recall@1"] == 1) == (share == 0)


def test_the_report_shows_saved_results(bench, tmp_path) -> None:
    runs, rng = tmp_path / "runs", np.random.default_rng(0)
    for name, predict in (("letters", always_a), ("scores", nearest)):
        dynapix.evaluate(bench.selection, predict, name=name, progress=False).save(runs / name)
    saved = {}
    for pool in ("future", "counterfactual"):
        of_pool = dynapix.load(bench.store.folder, pool=pool)
        rows = [rng.normal(size=(len(r), 8)) for r in (of_pool.retrieval, of_pool.database)]
        widths = [4, 8] if pool == "future" else None
        scores = dynapix.evaluate_retrieval(of_pool.retrieval, *rows, widths=widths, name=pool)
        folder = scores.save(runs / pool)
        assert json.loads((folder / "metrics.json").read_text()) == scores.metrics
        assert (folder / "report.txt").read_text() == f"{scores}\n"
        assert len((folder / "ranks.jsonl").read_text().splitlines()) == len(of_pool.retrieval)
        saved[pool] = scores
    (tmp_path / "other").mkdir()
    (tmp_path / "other" / "file").touch()
    with raises_user_error("other-files", contains=str(tmp_path / "other")):
        scores.save(tmp_path / "other")

    folder = run_report(tmp_path, bench.store.folder.parent, items=3, saved=str(runs))
    tables = {path.stem: path.read_text() for path in (folder / "tables").glob("*.md")}
    selection = tables["selection-micro"]
    for row in ("letters (text)", "scores (similarity)", "nearest to the last observed frame"):
        assert row in selection
    assert "letters (text)" in (folder / "report.html").read_text()
    future, twins = tables["retrieval-micro"], tables["retrieval-micro-counterfactual-queries"]
    assert f"{100 * saved['future'].metrics['recall@10']:.1f}" in future
    assert "Twin" in twins
    assert f"{100 * saved['counterfactual'].metrics['twin_above']:.1f}" in twins


def test_observers_state_accuracies_as_errors(bench, monkeypatch) -> None:
    """The observers here are right in 3/4 of the draws with an error of 4 px, and less beyond."""
    names = [item.item_id for item in bench.selection]
    shares = [1.0, 1.0, 1.0, 1.0, 0.9, 0.75, 0.5, 0.25, 0.25]
    seen = pd.DataFrame([shares] * len(names), index=names, columns=[0.0, *ERRORS])
    results = {SIMULATES: seen, EXTRAPOLATES: seen}
    monkeypatch.setattr(observer, "load_observers", lambda store, split: results)
    observers = dynapix.observer(bench, error=4)
    assert observers.ceilings == dict.fromkeys(names, 0.75)
    assert observers.error_of(0.75).value == pytest.approx(4)
    perfect = dynapix.evaluate(bench.selection[:9], lambda item: item.answer, progress=False)
    assert observers.error_of(perfect).value == pytest.approx(1)
    assert observers.curve.loc[("simulates", 8.0), "accuracy"] == pytest.approx(0.5)
    assert "75.0% right" in repr(observers)
    assert "extrapolates" in str(observers)
    with raises_user_error("unknown-option", contains="16"):
        dynapix.observer(bench, error=3)
    with raises_user_error("invalid-setting"):
        observers.error_of(75)
    train = dynapix.load(bench.store.folder, split="train")
    other = dynapix.evaluate(train.selection[:9], lambda item: "A", progress=False)
    with raises_user_error("different-builds", contains="train"):
        observers.error_of(other)


def test_embeddings_of_another_shape_or_database_are_refused(bench) -> None:
    rng = np.random.default_rng(0)
    queries = rng.normal(size=(len(bench.retrieval), 8))
    frames = rng.normal(size=(len(bench.database), 8))
    bad = queries.copy()
    bad[1, 2] = np.nan
    by_name = {f"other/{k}": row for k, row in enumerate(frames)}
    for embeddings, hint in (
        ((queries[1:], frames), f"({len(queries) - 1}, 8)"),
        ((queries, frames[:, :7]), "7"),
        ((queries.ravel(), frames), "shape"),
        ((bad, frames), bench.retrieval[1].query_id),
        ((queries, by_name), bench.database[0].name),
        ((queries, "frames"), "not an array of numbers"),
    ):
        with raises_user_error("invalid-embeddings", contains=hint):
            dynapix.evaluate_retrieval(bench.retrieval, *embeddings)
    with raises_user_error("invalid-setting", contains="1 to 8"):
        dynapix.evaluate_retrieval(bench.retrieval, queries, frames, widths=[9])
