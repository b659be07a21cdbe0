"""Which rows stand in a table, and under which names."""

from __future__ import annotations

import json
import shutil
from pathlib import Path

import pytest
from omegaconf import OmegaConf

from conf.errors import UserError
from conf.schema import ExportStudyCommand
from data.records import FAMILIES
from evaluation.study.agreement import summary
from tests.evaluation.reporting.measured import finish, reported, retrieve_run, similarity_run
from tests.evaluation.study.test_agreement import vote


def changed(report: Path, **row: object) -> None:
    """Change a report's first row."""
    told = json.loads(report.read_text())
    told["rows"][0] |= row
    report.write_text(json.dumps(told))


def test_a_model_that_is_measured_twice_keeps_its_line(runs):
    """As by another seed, which draws other intervals."""
    again = runs / "select" / "again"
    shutil.copytree(runs / "select" / "cot", again)
    drawn = {"value": 1.0, "low": 0.9, "high": 1.0, "n": 8}
    changed(again / "report.json", macro_interval=drawn)
    abroad = runs / "select" / "abroad"
    shutil.copytree(runs / "select" / "cot", abroad)
    changed(abroad / "report.json", benchmark="elsewhere")
    folder = reported(runs, runs, items=1)
    for name, line in (("transfer", "cot (reasoning)"), ("ablation", "full student (cot)")):
        table = (folder / "tables" / f"{name}.md").read_text()
        (found,) = [row for row in table.splitlines() if row.startswith(f"| {line} |")]
        assert "100.0" in found.split("|")[2]
        assert "cot, cot" in table


def test_items_that_are_not_known_are_told_apart_by_how_they_were_drawn(
    runs, micro, micro_store
) -> None:
    of = ["similarity/one", "similarity/two"]
    for seed, name in enumerate(("one", "two")):
        folder = similarity_run(runs, micro_store, micro, name, limit=9)
        (folder / "scores.jsonl").unlink()
        settings = OmegaConf.load(folder / "config.yaml")
        settings.seed = seed
        OmegaConf.save(settings, folder / "config.yaml")
    with pytest.raises(UserError, match=r"of limit and seed \(9, [01]\) and \(9, [01]\)"):
        reported(runs, micro_store.folder.parent, runs=of)


def test_a_base_has_one_curve_and_two_runs_have_names(runs, micro, micro_store):
    retrieve_run(runs, micro_store, micro, "other")
    folder = reported(runs, micro_store.folder.parent, runs=["retrieve/*"], items=1)
    drawn = (folder / "figures" / "recall-micro.svg").read_text()
    assert drawn.count(">untrained small<") == 1
    assert drawn.count(">emb<") == drawn.count(">other<") == 1


def test_what_people_chose_stands_beside_models(runs, micro_store):
    votes = [vote(name, k, 0, FAMILIES[k % 3]) for k in range(6) for name in ("A1", "A2")]
    found = {"benchmark": "micro", "build": micro_store.identity, **summary(votes, 6, ["A1", "A2"])}
    finish(runs / "export_study" / "pilot", ExportStudyCommand(run="pilot"), found)
    folder = reported(runs, micro_store.folder.parent, items=0)
    table = (folder / "tables" / "selection-micro.md").read_text()
    # All that they said is right, and they are no model that would be a column's best.
    whole = " | ".join(["100.0"] * 5)
    assert f"| Majority vote, pilot | {whole} | - | 6 |" in table
    for other in ({"benchmark": "elsewhere"}, {"build": "before"}):
        (runs / "export_study" / "pilot" / "report.json").write_text(json.dumps({**found, **other}))
        folder = reported(runs, micro_store.folder.parent, items=0)
        table = (folder / "tables" / "selection-micro.md").read_text()
        assert "Majority vote, pilot" not in table
