"""The report on finished runs: its files, and the runs that it refuses."""

from __future__ import annotations

import json
import re
import shutil
from collections import Counter
from pathlib import Path

import numpy as np
import pandas as pd
import pytest

from dynapix.conf.schema import ExportStudyCommand
from dynapix.conf.schema.benchmark import MATCHED_ANCHOR
from dynapix.data.checks.observer import ERRORS, EXTRAPOLATES, SIMULATES
from dynapix.evaluation.reporting import item_results
from tests.evaluation.reporting.measured import (
    finish,
    read_table,
    retrieve_run,
    right,
    select_run,
    similarity_run,
)
from tests.user_errors import raises_user_error

pytestmark = pytest.mark.slow


def page_data(folder: Path) -> dict:
    """Return the data of the browser of items on the page."""
    page = (folder / "report.html").read_text()
    return json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])


def read_groups(table: str) -> dict[str, str]:
    """Return the rows of a Markdown table as text, by the label of their group."""
    parts = re.split(r"^\| \*(.*?)\*.*$", table, flags=re.MULTILINE)[1:]
    return dict(zip(parts[::2], parts[1::2], strict=True))


def update_report(report: Path, **entries: object) -> None:
    """Change entries of a report.json."""
    report.write_text(json.dumps(json.loads(report.read_text()) | entries))


def test_the_report_has_every_table_and_figure(unchanged):
    names = {path.stem for path in (unchanged / "tables").glob("*.tex")}
    assert names == {path.stem for path in (unchanged / "tables").glob("*.md")}
    assert names == {
        "selection-micro", "retrieval-micro", "distillation-selection-micro",
        "distillation-retrieval-micro", "rank-differences-retrieve-emb", "differences-micro",
        "paired-micro", "ablation", "widths-micro", "subtypes-micro", "parsing-micro",
    }  # fmt: skip
    table = read_table(unchanged, "distillation-selection-micro")
    best = " | ".join(["**100.0**"] * 5)
    assert f"| cot (reasoning) | {best} | 100.0 |" in table
    assert table.count("**100.0**") == 5
    paper = " | ".join(f"**{percent}**" for percent in (92.4, 45.4, 96.7, 78.2, 87.5))
    assert f"| Physics-grounded CoT | {paper} |" in table
    ablation = (unchanged / "tables" / "ablation.tex").read_text()
    assert r"full student (cot) & \textbf{100.0} & - & - \\" in ablation
    assert r"- match layout & 86.8 & \textbf{40.3} & 68.9 \\" in ablation
    text = (unchanged / "report.txt").read_text()
    scorers = text.partition("similarity scorers")[2].partition("generative models")[0]
    assert "untrained clip (similarity)" in scorers
    assert {path.stem for path in (unchanged / "figures").glob("*.svg")} >= {
        "zero-shot-micro", "families-micro", "horizons-micro", "widths-micro", "training-sft-cot",
    }  # fmt: skip
    items = page_data(unchanged)["items"]
    assert len(items) == 12
    assert all(len(item["responses"]) == 5 for item in items)


def test_students_are_compared_with_their_bases_and_with_other_regimes(
    runs, micro, micro_store, report
):
    # The student `cot` and this base always answer correctly, the other students always answer B.
    items = micro_store.selection("test")
    wrong = sum(item.letter != "B" for item in items)
    select_run(runs, micro_store, micro, "plain", right, mode="reasoning")
    folder = report(items=0)
    cot, base = "cot (reasoning)", "small base (reasoning)"
    ablated, plain = "cot_no_candidate_analysis (reasoning)", "answer_only (answer)"
    expected = {
        (cot, plain): f"| {100 * wrong / len(items):+.1f} |", (cot, ablated): f"| {wrong} | 0 |",
        (cot, base): "| +0.0 | +0.0 to +0.0 | 1 | 1 | 0 | 0 | 1 |",
        (ablated, base): f"| 0 | {wrong} |",
        (ablated, plain): "| +0.0 | +0.0 to +0.0 | 1 | 1 | 0 | 0 | 1 |",
    }  # fmt: skip
    # No base was measured in answer mode, and no student in record mode.
    groups = read_groups(read_table(folder, "paired-micro").replace("\\", ""))
    assert set(groups) == {f"{left} (left) minus {other} (right)" for left, other in expected}
    for (left, other), cells in expected.items():
        [overall] = [
            line
            for line in groups[f"{left} (left) minus {other} (right)"].splitlines()
            if line.startswith("| all |")
        ]
        assert cells in overall


def test_models_with_the_same_name_get_the_names_of_their_runs(runs, micro, micro_store, report):
    select_run(runs, micro_store, micro, "again", right, mode="record")
    folder = report(items=1)
    names = ["small base, base (record)", "small base, again (record)"]
    for table in ("selection-micro", "parsing-micro", "subtypes-micro"):
        assert all(name in read_table(folder, table) for name in names), table
    assert {r["model"] for r in page_data(folder)["items"][0]["responses"]} > set(names)
    folder = report(runs=["select/again"], items=1)
    assert "small base (record)" in read_table(folder, "selection-micro")


def test_the_page_is_self_contained(unchanged):
    page = (unchanged / "report.html").read_text()
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    addresses = re.findall(r'(?:src|href)="([^"]*)"', markup)
    assert all(address.startswith(("#", "data:")) for address in addresses)
    assert "url(http" not in page
    assert "@import" not in page
    assert "document.title='taken'</script>" not in page
    # Ids are unique over all figures.
    ids = re.findall(r'\bid="([^"]+)"', markup)
    assert len(ids) == len(set(ids))
    for name in re.findall(r'(?:url\(#|href="#)([^")]+)', markup):
        assert name in ids


def test_equal_runs_give_equal_pages(unchanged, report):
    content = (unchanged / "report.html").read_bytes()
    assert (report(items=12) / "report.html").read_bytes() == content
    assert (report(items=12, seed=1) / "report.html").read_bytes() != content


def test_runs_are_chosen_by_name_and_pattern(unchanged, runs, report):
    assert list(unchanged.glob("tables/*retrieval*"))
    folder = report(runs=["select/cot*", "select/base"], items=1)
    responses = page_data(folder)["items"][0]["responses"]
    assert {r["model"].split(" (")[0] for r in responses} == {
        "cot", "cot_no_candidate_analysis", "small base",
    }  # fmt: skip
    assert not list(folder.glob("tables/*retrieval*"))
    folder = report(runs=[f"{runs}/select/cot"], items=1)
    assert len(page_data(folder)["items"][0]["responses"]) == 1


def test_responses_with_other_settings_and_incomplete_lines_are_left_out(runs, report):
    log = runs / "select" / "cot" / "answers.jsonl"
    lines = log.read_text().splitlines()
    stale = [json.loads(line) for line in lines]
    for row in stale:
        row["key"] = "0" * 16
        if "text" in row:
            row["text"] = "stale"
    before = "".join(json.dumps(row) + "\n" for row in stale)
    log.write_text(before + "\n".join(lines) + '\n{"item_id": "incomplete')
    folder = report(runs=["select/cot"], items=5)
    texts = [r["text"] for item in page_data(folder)["items"] for r in item["responses"]]
    assert texts
    assert "stale" not in texts


def test_responses_to_a_suite_are_shown_beside_those_to_all_items(runs, micro, micro_store, report):
    settings = {"runs": ["select/*"], "items": 500}
    before = page_data(report(**settings))["items"]
    pairs = micro_store.selection("test")[:6]
    suite = {"model": "cot", "mode": "reasoning", "suite": MATCHED_ANCHOR}
    select_run(runs, micro_store, micro, "pairs", right, pairs, **suite)
    after = page_data(report(**settings))["items"]
    models = {item["id"]: {r["model"] for r in item["responses"]} for item in after}
    for item in before:
        assert {r["model"] for r in item["responses"]} <= models[item["id"]]
    in_suite = {k for k, labels in models.items() if "cot (reasoning), matched_anchor" in labels}
    assert in_suite == {item.item_id for item in pairs}


def test_the_report_has_controls_and_their_differences(runs, report):
    path = runs / "select" / "cot" / "report.json"
    [row] = json.loads(path.read_text())["rows"]
    controls = [
        {"mode": "reasoning", "left": "unchanged", "right": "candidate_only", "n": 63,
         "of": "all", "left_accuracy": 0.75, "right_accuracy": 0.5, "difference": 0.25,
         "low": 0.1, "high": 0.375, "p": 0.002, "mcnemar": 0.001, "only_left": 20,
         "only_right": 4},
    ]  # fmt: skip
    update_report(path, rows=[row, row | {"control": "candidate_only"}], controls=controls)
    folder = report(items=1)
    row = "| all | 75.0 | 50.0 | +25.0 | +10.0 to +37.5 | 0.002 | 0.002 | 20 | 4 | 0.001 | 63 |"
    assert row in read_table(folder, "paired-select-cot")
    assert read_table(folder, "control-micro-candidate_only")


def test_responses_to_another_build_are_not_shown(runs, report):
    for path in (runs / "select").glob("*/report.json"):
        update_report(path, build="before")
    folder = report(runs=["select/*"])
    page = (folder / "report.html").read_text()
    assert "The items of micro cannot be shown" in page
    assert 'id="data"' not in page
    assert not list((folder / "tables").glob("paired-*"))
    assert read_table(folder, "selection-micro")


def test_a_failing_report_keeps_the_previous_one(runs, report):
    folder = report(items=1)
    before = {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}
    (runs / "select" / "cot" / "answers.jsonl").unlink()
    with raises_user_error("damaged-file", contains="answers.jsonl"):
        report(runs=["select/*"], items=1)
    assert {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()} == before


def test_runs_over_different_items_have_separate_tables(
    unchanged, runs, micro, micro_store, report
):
    before = read_table(unchanged, "selection-micro")
    items = micro_store.selection("test")
    select_run(runs, micro_store, micro, "few", right, items[3:], model="cot", mode="answer")
    folder = report(items=500)
    assert read_table(folder, "selection-micro") == before
    [few] = (folder / "tables").glob(f"distillation-selection-micro-{len(items) - 3}-items-*.md")
    assert "cot (answer)" in few.read_text()
    assert "cot (reasoning)" not in few.read_text()
    counts = Counter(entry["benchmark"] for entry in page_data(folder)["items"])
    assert sorted(counts.values()) == [len(items) - 3, len(items)]


def test_pools_of_queries_have_separate_tables(unchanged, runs, micro, micro_store, report, caplog):
    before = {path.name: path.read_text() for path in (unchanged / "tables").glob("*.md")}
    retrieve_run(runs, micro_store, micro, "emb", pool="counterfactual")
    caplog.set_level("INFO")
    folder = report(items=1)
    after = {path.name: path.read_text() for path in (folder / "tables").glob("*.md")}
    assert {name: after[name] for name in before} == before
    own = {name: text for name, text in after.items() if name not in before}
    assert {
        f"{key}-micro-counterfactual-queries.md"
        for key in ("retrieval", "distillation-retrieval", "widths")
    } < set(own)
    for text in own.values():
        assert "Twin" in text
        assert "paper, " not in text
    assert "Twin" not in "".join(before.values())
    overview = next(m for m in caplog.messages if "is right in" in m)
    [line] = [each for each in overview.splitlines() if "finds the counterfactual frame" in each]
    assert "the factual scene's frame higher in" in line


def test_a_retriever_is_compared_with_its_untrained_base(runs, micro, micro_store, report):
    similarity_run(runs, micro_store, micro, "small", model="emb")
    # The untrained base was also measured alone, with the same result.
    similarity_run(runs, micro_store, micro, "small")
    # Another base of the same name answers differently.
    similarity_run(runs, micro_store, micro, "small", model="other", untrained=(0, 1, 0, 0))
    folder = report(runs=["similarity/*"], items=40)
    table = read_table(folder, "paired-micro")
    assert {name.split(" minus ")[1] for name in read_groups(table)} == {
        "untrained small, emb (similarity) (right)", "untrained small, other (similarity) (right)"
    }  # fmt: skip
    first = np.mean([item.answer == 0 for item in micro_store.selection("test")])
    assert f"| {100 * (1 - first):+.1f} |" in table
    entries = page_data(folder)["items"]
    by_model = {r["model"]: r for r in entries[0]["responses"]}
    assert by_model["emb (similarity)"]["verdict"] == "correct"
    base = "untrained small, emb (similarity)"
    assert by_model[base]["text"] == "A 0.5000, B 0.2500, C 0.1250, D 0.0000"
    letters = {r["letter"] for e in entries for r in e["responses"] if r["model"] == base}
    assert letters == {"A"}


@pytest.mark.parametrize("kind", ["select", "retrieve"])
def test_runs_on_different_builds_have_separate_tables(runs, kind, report):
    name = "retrieval" if kind in ("retrieve", "two_stage") else "selection"
    [other] = sorted((runs / kind).iterdir())[:1]
    update_report(other / "report.json", build="earlier-build")
    (other / "run.json").write_text('{"started": "2020-01-01", "earlier_starts": []}')
    folder = report(items=1)
    tables = {path.stem for path in (folder / "tables").glob("*.md")}
    assert {table for table in tables if "build-earlier" in table and name in table}
    # The build of the most recent run keeps the plain names.
    assert any(table.endswith(f"{name}-micro") for table in tables)


@pytest.mark.parametrize(
    ("file", "content"),
    [
        ("select/cot/config.yaml", "a: [1"),
        ("select/cot/report.json", None),
        ("select/cot/report.json", {"readings": {"reasoning": {"A": "x"}}}),
        ("select/cot/report.json", {"asked": [["reasoning", None]]}),
        ("select/cot/run.json", "{}"),
        ("select/cot/answers.jsonl", None),
        ("similarity/clip/scores.jsonl", '{"by": "clip", "item_id": "a", "scores": [0.5]}'),
    ],
)
def test_a_damaged_file_is_named(runs, file, content, report):
    run, _, name = file.rpartition("/")
    for other in {*runs.glob("*/*")} - {runs / run, runs / "select" / "base"}:
        shutil.rmtree(other)
    if content is None:
        (runs / file).unlink()
    elif isinstance(content, dict):
        update_report(runs / file, **content)
    else:
        (runs / file).write_text(content)
    with raises_user_error("damaged-file", contains=file):
        report(runs=["select/*", run])
    assert not (runs / "report" / "default" / "report.html").exists()
    # A report on all runs leaves this one out and says so.
    page = (report(items=1) / "report.html").read_text()
    assert f"{run} is left out" in page
    assert name in page


def test_a_damaged_study_or_training_does_not_end_a_report_on_all_runs(measured, runs, report):
    finish(runs / "export_study" / "pilot", ExportStudyCommand(run="pilot"), {"benchmark": "micro"})
    (runs / "sft" / "cot" / "config.yaml").write_text("a: [1")
    settings = runs / "select" / "cot" / "config.yaml"
    settings.write_text(settings.read_text().replace(str(measured), str(runs)))
    page = (report(items=1) / "report.html").read_text()
    assert "export_study/pilot is left out" in page
    assert "select/cot is left out" in page
    assert "sft/cot/config.yaml" in page
    assert "select/base is left out" not in page


@pytest.mark.parametrize(
    ("pattern", "code", "hint"),
    [
        ("study/friends", "unfinished-run", "evaluation.study.export"),
        ("select/cto", "missing-run", "select/cot"),
        ("sft/*", "missing-run", "evaluation.select"),
    ],
)
def test_patterns_without_a_finished_evaluation_are_refused(runs, pattern, code, hint, report):
    (runs / "study" / "friends").mkdir(parents=True)
    with raises_user_error(code, contains=hint):
        report(runs=[pattern])


def test_the_overview_names_the_student_and_the_retriever(report, caplog):
    caplog.set_level("INFO")
    report(items=12)
    overview = next(m for m in caplog.messages if "is right in" in m)
    first, *rest = overview.strip().splitlines()
    assert re.match(r"\w+ \(reasoning\) is right in \d+\.\d% \[", first)
    assert "chance 25%" in first
    assert "trained on answers alone" in first
    assert any(line.startswith("emb finds the future frame among the first 10") for line in rest)


def test_accuracies_are_reported_as_errors_of_observers(
    unchanged, report, micro_store, monkeypatch
):
    """The observers are right in 3/4 of the draws with an error of 4 px, and less beyond it."""
    assert "python -m data.statistics" in (unchanged / "report.html").read_text()
    assert "Observer" not in read_table(unchanged, "distillation-selection-micro")
    names = [item.item_id for item in micro_store.selection("test")]
    shares = [1.0, 1.0, 1.0, 1.0, 0.9, 0.75, 0.5, 0.25, 0.25]
    seen = pd.DataFrame([shares] * len(names), index=names, columns=[0.0, *ERRORS])
    results = {SIMULATES: seen, EXTRAPOLATES: seen}
    monkeypatch.setattr(item_results, "load_observers", lambda store, split: results)
    folder = report(items=3)
    table = read_table(folder, "distillation-selection-micro")
    [right] = [line for line in table.splitlines() if line.startswith("| cot (reasoning)")]
    assert "| 1 | 100.0 |" in right
    assert "observer-micro" in {path.stem for path in (folder / "figures").glob("*.svg")}
    for item in page_data(folder)["items"]:
        assert "is right in 100% of its draws" in item["truth"][-1]
