"""Accuracy, majority and agreement of votes, compared with formulas."""

from __future__ import annotations

import itertools
import json
from collections import Counter
from dataclasses import asdict
from typing import Any

import numpy as np
import pandas as pd
import pytest

from dynapix.conf.entry import Run
from dynapix.conf.schema import ReportCommand
from dynapix.data.records import FAMILIES
from dynapix.evaluation import report
from dynapix.evaluation.metrics.results import StudyReport, from_json
from dynapix.evaluation.reporting.tables import human_table
from dynapix.evaluation.study.agreement import (
    fleiss_kappa,
    majority,
    summarize_votes,
)
from tests.user_errors import raises_user_error


def vote(
    annotator: str, item: int, choice: int, family: str = "event", **changes
) -> dict[str, Any]:
    """Return a vote on an item whose first candidate is correct."""
    return {
        "annotator": annotator, "item_id": f"i{item}", "scene_id": f"s{item}", "answer": 0,
        "family": family,
        "choice": choice, "right": choice == 0, "seconds": 10.0 + item,
        "loads": 1, **changes,
    }  # fmt: skip


def summarize(
    votes: list[dict[str, Any]], items: int, annotators: list[str], build: str = "build"
) -> StudyReport:
    return summarize_votes(pd.DataFrame(votes), items, annotators, "tiny", build, seed=0)


def sample_votes(rng, items: int, depths: list[int]) -> list[list[int]]:
    """Return the votes on each item, which agree more often than by chance."""
    truth = rng.integers(4, size=items)
    return [
        [int(t) if rng.random() < 0.6 else int(rng.integers(4)) for _ in range(rng.choice(depths))]
        for t in truth
    ]


def count(items: list[list[int]]) -> pd.DataFrame:
    """Return the number of votes for each candidate (items, 4)."""
    return pd.DataFrame([np.bincount(choices, minlength=4) for choices in items], columns=range(4))


def test_fleiss_kappa_equals_its_definition() -> None:
    items = sample_votes(np.random.default_rng(0), 30, [3])
    pairs = [a == b for c in items for a, b in itertools.combinations(c, 2)]
    votes = Counter(itertools.chain(*items))
    chance = sum((n / sum(votes.values())) ** 2 for n in votes.values())
    observed = sum(pairs) / len(pairs)
    assert fleiss_kappa(count(items)) == pytest.approx(
        (observed - chance) / (1 - chance), abs=1e-12
    )


@pytest.mark.parametrize("items", [[], [[2, 2, 2], [2, 2, 2]]])
def test_agreement_is_undefined_without_variation(items) -> None:
    assert fleiss_kappa(count(items)) is None


@pytest.mark.parametrize(
    ("choices", "wins"),
    [([2], 2), ([1, 1], 1), ([1, 2], None), ([0, 1, 2], None), ([3, 1, 3], 3), ([0, 0, 1, 1], None),
     ([0, 0, 1, 2], None), ([0, 0, 0, 1], 0)],
)  # fmt: skip
def test_majority_is_strictly_more_than_half(choices, wins) -> None:
    [found] = majority(count([choices]))
    assert found == wins or (np.isnan(found) and wins is None)


def test_a_study_of_the_papers_size_is_summarized() -> None:
    """59 items, of which 10 have one vote, 30 two and 19 three: 127 judgments."""
    rng = np.random.default_rng(0)
    depths = [1] * 10 + [2] * 30 + [3] * 19
    votes = [
        vote(name, k, int(rng.integers(2)), FAMILIES[k % 3])
        for k, depth in enumerate(depths)
        for name in rng.permutation(["A1", "A2", "A3"])[:depth]
    ]
    found = summarize(votes, 60, ["A1", "A2", "A3"])
    assert (found.items, found.judgments) == (60, 127)
    assert found.depth == {"0": 1, "1": 10, "2": 30, "3": 19}
    assert found.kappa_items == 19
    assert sum(accuracy.micro.n for accuracy in found.accuracy.values()) == 127
    assert found.majority.micro.n == 59
    by_item = {k: [v["choice"] for v in votes if v["item_id"] == f"i{k}"] for k in range(59)}
    ties = sum(len(c) == 2 and c[0] != c[1] for c in by_item.values())
    assert found.majority.undecided == ties > 0
    right = sum(c.count(0) * 2 > len(c) for c in by_item.values())
    assert found.majority.micro.value == pytest.approx(right / 59)
    for name, accuracy in found.accuracy.items():
        own = [v["right"] for v in votes if v["annotator"] == name]
        assert accuracy.micro.value == pytest.approx(sum(own) / len(own))
    assert from_json(StudyReport, json.loads(json.dumps(asdict(found), allow_nan=False))) == found
    table = str(human_table(found))
    assert "10 with 1, 30 with 2, 19 with 3" in " ".join(table.split())
    assert max(map(len, table.splitlines())) <= 100


def test_annotators_without_votes_are_left_out() -> None:
    votes = [vote(name, k, (k + (name == "A3")) % 2) for k in range(4) for name in ("A1", "A3")]
    found = summarize(votes, 4, ["A1", "A2", "A3"])
    assert found == summarize(votes, 4, ["A1", "A3"])
    assert list(found.accuracy) == found.annotators == ["A1", "A3"]
    assert (found.fleiss_kappa, found.kappa_items) == (pytest.approx(-1.0), 4)


def test_the_agreement_of_a_single_annotator_is_undefined() -> None:
    found = summarize([vote("A1", k, 0) for k in range(3)], 3, ["A1", "A2"])
    assert (found.fleiss_kappa, found.kappa_items) == (None, 0)
    assert "undefined" in str(human_table(found))


def test_times_are_medians_over_pages_that_were_loaded_once() -> None:
    votes = [vote("A1", k, 0, seconds=s) for k, s in enumerate([4, 9, 5])]
    votes.append(vote("A1", 3, 0, seconds=1e5, loads=2))
    found = summarize(votes, 4, ["A1"]).seconds
    assert found == {"event": 5.0}


def test_the_report_covers_an_exported_study_without_models(tmp_path) -> None:
    exported = tmp_path / "export_study" / "pilot"
    exported.mkdir(parents=True)
    (exported / "metrics.json").write_text("{}")
    (exported / "run.json").write_text('{"started": "2026-01-01", "earlier_starts": []}')
    (exported / "config.yaml").write_text("run: pilot\n")
    votes = [vote(name, k, k % 3, FAMILIES[k % 3]) for k in range(6) for name in ("A1", "A2")]
    found = summarize(votes, 6, ["A1", "A2"])
    (exported / "report.json").write_text(json.dumps(asdict(found)))
    run = Run("x", tmp_path / "report")
    run.folder.mkdir()
    report.main.__wrapped__(ReportCommand(checkpoints=str(tmp_path)), run)
    page = (run.folder / "report.txt").read_text()
    caption, _, cells = str(human_table(found)).partition("\n")
    assert page == f"{caption}: study pilot on benchmark tiny\n{cells}\n"
    assert (run.folder / "tables" / "human-pilot.tex").exists()

    (exported / "report.json").write_text('{"benchmark": "tiny"}')
    with raises_user_error("missing-run", contains="report.json is missing, damaged"):
        report.main.__wrapped__(ReportCommand(checkpoints=str(tmp_path)), run)
