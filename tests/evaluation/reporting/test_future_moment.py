"""The report splits the accuracy on balanced time items of finished runs into future and moment."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import pytest

import dynapix
from dynapix.conf.compose import compose
from dynapix.conf.schema import BuildCommand, Quota, SelectionConfig
from dynapix.data.build import ensure_items
from dynapix.data.parallel import Workers
from dynapix.data.records import LETTERS, SelectionItem
from tests.evaluation.reporting.measured import read_table, run_report, select_run


def shown_future(item: SelectionItem) -> str:
    """Answer with the true future at the wrong moment, if the item has this candidate."""
    [letter] = [
        x
        for x, c in zip(LETTERS, item.candidates, strict=True)
        if c.scene_id == item.scene_id and c.frame != item.target_frame
    ]
    return f"Answer: {letter}"


@pytest.mark.slow
def test_runs_and_results_are_split(tmp_path: Path) -> None:
    cfg = compose("data.build", BuildCommand, ["benchmark=horizons"]).benchmark
    few = {"in_250ms": Quota(0, 2), "in_1s": Quota(0, 3), "in_3s": Quota(0, 2)}
    cfg = replace(cfg, name="few", scenes=30, test_share=1.0, selection=SelectionConfig(time=few))
    store = ensure_items(cfg, tmp_path / "store", Workers(1))
    items = store.selection("test")
    select_run(tmp_path, store, cfg, "one", shown_future, mode="record")
    folder = run_report(tmp_path, store.folder.parent, items=0)
    table = read_table(folder, f"future-moment-{store.name}")
    assert f"| small base (record) | 0.0 | 100.0 | 0.0 | {len(items)} |" in table
    for cell, horizon in (("in_250ms", "0.25 s"), ("in_1s", "1 s"), ("in_3s", "3 s")):
        count = sum(item.subtype == cell for item in items)
        assert count
        assert f"| {horizon} | 0.0 | 100.0 | 0.0 | {count} |" in table

    bench = dynapix.load(store.folder, split="test")
    by_letter, by_scores = (
        dynapix.evaluate(bench.selection, predict, progress=False).future_moment
        for predict in (lambda item: shown_future(item.record), lambda item: [0.0] * 4)
    )
    assert (by_letter.total.future.value, by_letter.total.moment.value) == (1, 0)
    shares = by_scores.total
    assert (shares.accuracy.value, shares.future.value, shares.moment.value) == (0.25, 0.5, 0.5)
