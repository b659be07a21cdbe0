"""The report over finished runs: what it writes, and what it refuses."""

from __future__ import annotations

import json
import re
import shutil
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from conf.errors import UserError
from conf.schema import ReportCommand
from data.records import LETTERS
from data.tracks.controls import MATCHED_ANCHOR
from evaluation.reporting.run_responses import Scored
from tests.evaluation.reporting.measured import (
    reported,
    retrieve_run,
    right,
    select_run,
    similarity_run,
)


def page_data(folder: Path) -> dict:
    page = (folder / "report.html").read_text()
    return json.loads(re.search(r'id="data">(.*?)</script>', page, re.DOTALL)[1])


def test_everything_is_written_in_the_papers_shape(runs, micro_store):
    folder = reported(runs, micro_store.folder.parent, items=12)
    names = {path.stem for path in (folder / "tables").glob("*.tex")}
    assert names == {path.stem for path in (folder / "tables").glob("*.md")}
    assert names == {
        "selection-micro", "retrieval-micro", "distillation-selection-micro",
        "distillation-retrieval-micro", "ranks-apart-micro", "apart-micro", "paired-micro",
        "ablation", "costs-micro",
        "widths-micro", "subtypes-micro", "readings-micro", "positions-micro", "training",
    }  # fmt: skip
    table = (folder / "tables" / "distillation-selection-micro.md").read_text()
    best = " | ".join(["**100.0**"] * 5)
    assert f"| cot (reasoning) | {best} | 100.0 |" in table
    assert table.count("**100.0**") == 5
    told = " | ".join(f"**{percent}**" for percent in (92.4, 45.4, 96.7, 78.2, 87.5))
    assert f"| Physics-grounded CoT | {told} | - |" in table
    ablation = (folder / "tables" / "ablation.tex").read_text()
    assert r"full student (cot) & \textbf{100.0} & - & - \\" in ablation
    assert r"- match layout & 86.8 & \textbf{40.3} & 68.9 \\" in ablation
    text = (folder / "report.txt").read_text()
    scorers = text.partition("similarity scorers")[2].partition("generative models")[0]
    assert "untrained clip (similarity)" in scorers
    assert max(map(len, text.splitlines())) <= 100
    assert {path.stem for path in (folder / "figures").glob("*.svg")} >= {
        "zero-shot-micro", "families-micro", "horizons-micro", "positions-micro", "widths-micro",
        "recall-micro", "training-sft-cot",
    }  # fmt: skip
    data = page_data(folder)
    assert len(data["items"]) == 12
    assert all(len(item["said"]) == 5 for item in data["items"])


def test_students_are_held_against_what_they_should_surpass(runs, micro, micro_store):
    # What the other students say is B.
    items = micro_store.selection("test")
    wrong = sum(item.letter != "B" for item in items)
    select_run(runs, micro_store, micro, "plain", right, mode="reasoning")
    folder = reported(runs, micro_store.folder.parent, items=0)
    table = (folder / "tables" / "apart-micro.md").read_text()
    parts = re.split(r"^\| \*less (.*?)\*.*$", table, flags=re.MULTILINE)[1:]
    rows = {
        other: {
            line.split(" | ")[0].removeprefix("| "): line for line in lines.splitlines() if line
        }
        for other, lines in zip(parts[::2], parts[1::2], strict=True)
    }
    ablated = r"cot\_no\_candidate\_analysis (reasoning)"
    alone = rows[r"answer\_only (answer)"]
    assert f"| {wrong} | 0 |" in alone["cot (reasoning)"]
    assert f"| {100 * wrong / len(items):+.1f} |" in alone["cot (reasoning)"]
    assert "| +0.0 | +0.0 to +0.0 | 0 | 0 | 1 |" in alone[ablated]
    assert f"| 0 | {wrong} |" in rows["small base (reasoning)"][ablated]
    assert next(iter(rows[ablated])) == "cot (reasoning)"
    # Nobody else was asked as a student of answers alone was, or as the base was.
    assert len(parts) == 6


def test_models_of_one_name_are_told_apart_by_their_runs(runs, micro, micro_store):
    select_run(runs, micro_store, micro, "drawn", right, mode="record")
    folder = reported(runs, micro_store.folder.parent, items=1)
    names = ["small base, base (record)", "small base, drawn (record)"]
    for table in ("selection-micro", "readings-micro", "subtypes-micro", "positions-micro"):
        text = (folder / "tables" / f"{table}.md").read_text()
        assert all(name in text for name in names), table
    assert {s["by"] for s in page_data(folder)["items"][0]["said"]} > set(names)
    # Of one run alone, the model's name will do.
    folder = reported(runs, micro_store.folder.parent, runs=["select/drawn"], items=1)
    assert "small base (record)" in (folder / "tables" / "selection-micro.md").read_text()


def test_the_page_holds_all_that_it_shows(runs, micro_store):
    page = (reported(runs, micro_store.folder.parent, items=4) / "report.html").read_text()
    markup = re.sub(r"<script.*?</script>", "", page, flags=re.DOTALL)
    addresses = re.findall(r'(?:src|href)="([^"]*)"', markup)
    assert all(address.startswith(("#", "data:")) for address in addresses)
    assert "url(http" not in page
    assert "@import" not in page
    assert "document.title='taken'</script>" not in page
    # A figure's names are its own.
    ids = re.findall(r'\bid="([^"]+)"', markup)
    assert len(ids) == len(set(ids))
    for name in re.findall(r'(?:url\(#|href="#)([^")]+)', markup):
        assert name in ids


@pytest.mark.slow
def test_the_same_runs_give_the_same_page(runs, micro_store):
    page = reported(runs, micro_store.folder.parent, items=3) / "report.html"
    whole = page.read_bytes()
    assert (
        reported(runs, micro_store.folder.parent, items=3).joinpath(page.name).read_bytes() == whole
    )
    reported(runs, micro_store.folder.parent, items=3, seed=1)
    assert page.read_bytes() != whole


@pytest.mark.slow
def test_runs_are_chosen_by_name_and_pattern(runs, micro_store):
    assert list(reported(runs, micro_store.folder.parent, items=0).glob("tables/*retrieval*"))
    folder = reported(runs, micro_store.folder.parent, runs=["select/cot*", "select/base"], items=1)
    said = page_data(folder)["items"][0]["said"]
    assert {s["by"].split(" (")[0] for s in said} == {
        "cot", "cot_no_candidate_analysis", "small base",
    }  # fmt: skip
    assert "retrieval" not in (folder / "report.txt").read_text().lower()
    assert not list(folder.glob("tables/*retrieval*"))
    named = f"{runs}/select/cot"
    folder = reported(runs, micro_store.folder.parent, runs=[named], items=1)
    assert len(page_data(folder)["items"][0]["said"]) == 1


def test_what_was_said_before_a_model_changed_is_left_out(runs, micro_store):
    log = runs / "select" / "cot" / "answers.jsonl"
    lines = log.read_text().splitlines()
    stale = [json.loads(line) for line in lines]
    for row in stale:
        row["key"] = "0" * 16
        if "text" in row:
            row["text"] = "stale"
    before = "".join(json.dumps(row) + "\n" for row in stale)
    log.write_text(before + "\n".join(lines) + '\n{"item_id": "torn')
    folder = reported(runs, micro_store.folder.parent, runs=["select/cot"], items=5)
    assert all(s["text"] != "stale" for i in page_data(folder)["items"] for s in i["said"])


def test_what_a_suite_is_answered_stands_beside_what_all_items_are(
    runs, micro, micro_store
) -> None:
    """Both of one model, whose answers are told apart."""
    everything = {"runs": ["select/*"], "items": 500}
    before = page_data(reported(runs, micro_store.folder.parent, **everything))["items"]
    pairs = micro_store.selection("test")[:6]
    suite = {"model": "cot", "mode": "reasoning", "suite": MATCHED_ANCHOR}
    select_run(runs, micro_store, micro, "pairs", right, pairs, **suite)
    after = page_data(reported(runs, micro_store.folder.parent, **everything))["items"]
    said = {item["id"]: {s["by"] for s in item["said"]} for item in after}
    for item in before:
        assert {s["by"] for s in item["said"]} <= said[item["id"]]
    of_suite = {name for name, by in said.items() if "cot (reasoning), matched_anchor" in by}
    assert of_suite == {item.item_id for item in pairs}


def test_controls_are_gathered_with_their_differences(runs, micro_store):
    path = runs / "select" / "cot" / "report.json"
    told = json.loads(path.read_text())
    row = dict(told["rows"][0], control="candidate_only")
    told["rows"].append(row)
    told["controls"] = [
        {"mode": "reasoning", "left": "items as they are", "right": "candidate_only", "n": 63,
         "of": "all", "left_accuracy": 0.75, "right_accuracy": 0.5, "difference": 0.25,
         "low": 0.1, "high": 0.375, "p": 0.001, "only_left": 20,
         "only_right": 4},
    ]  # fmt: skip
    path.write_text(json.dumps(told))
    folder = reported(runs, micro_store.folder.parent, items=1)
    table = (folder / "tables" / "controls.md").read_text()
    assert "| all | 75.0 | 50.0 | +25.0 | +10.0 to +37.5 | 20 | 4 | 0.001 | 63 |" in table
    assert (folder / "tables" / "control-micro-candidate_only.md").exists()


def test_a_model_on_a_benchmark_that_it_was_not_trained_on_is_transfer(runs, micro_store):
    for name in ("base", "cot"):
        shutil.copytree(runs / "select" / name, runs / "select" / f"{name}-abroad")
        path = runs / "select" / f"{name}-abroad" / "report.json"
        path.write_text(path.read_text().replace('"micro"', '"elsewhere"', 1))
    folder = reported(runs, micro_store.folder.parent, items=1)
    table = (folder / "tables" / "transfer.md").read_text()
    assert "| Overall accuracy, % | In domain | MoVi-A | Physion | elsewhere |" in table
    assert "| cot (reasoning) | **100.0** | - | - | **100.0** |" in table
    assert (folder / "tables" / "transfer-elsewhere.tex").exists()
    assert not (folder / "tables" / "distillation-selection-elsewhere.tex").exists()
    # Nobody built that benchmark here.
    page = (folder / "report.html").read_text()
    assert "python -m data.build benchmark=elsewhere" in page


@pytest.mark.parametrize("of", ["simulator", "standin"])
def test_a_base_alone_on_a_transfer_suite_is_no_zero_shot_row_of_the_papers_benchmark(runs, of):
    config = runs / "select" / "base" / "config.yaml"
    settings = OmegaConf.load(config)
    settings.benchmark[of] = "physion"
    OmegaConf.save(settings, config)
    folder = reported(runs, runs, items=1, runs=["select/base"])
    names = {path.stem for path in (folder / "tables").glob("*.md")}
    assert {"transfer", "transfer-micro"} <= names
    assert "selection-micro" not in names


def test_two_benchmarks_of_a_simulator_have_columns_of_their_own(runs):
    for name in ("one", "two"):
        shutil.copytree(runs / "select" / "cot", runs / "select" / name)
        path = runs / "select" / name / "report.json"
        path.write_text(path.read_text().replace('"micro"', f'"{name}"', 1))
        config = runs / "select" / name / "config.yaml"
        settings = OmegaConf.load(config)
        settings.benchmark.simulator, settings.benchmark.name = "movi_a", name
        OmegaConf.save(settings, config)
    folder = reported(runs, runs, items=1)
    table = (folder / "tables" / "transfer.md").read_text()
    head = "| Overall accuracy, % | In domain | MoVi-A | Physion | MoVi-A (one) | MoVi-A (two) |"
    assert head in table
    assert "| cot (reasoning) | 100.0 | - | - | 100.0 | 100.0 |" in table


def test_answers_are_not_judged_by_another_build_of_their_benchmark(runs, micro_store):
    """It has other items by the same names."""
    for path in (runs / "select").glob("*/report.json"):
        _add(path, build="before")
    folder = reported(runs, micro_store.folder.parent, runs=["select/*"])
    page = (folder / "report.html").read_text()
    assert "The items of micro cannot be shown" in page
    assert "was built anew since they were answered" in page
    assert 'id="data"' not in page
    assert not list((folder / "figures").glob("positions-*"))
    assert not list((folder / "tables").glob("apart-*"))
    assert (folder / "tables" / "selection-micro.md").exists()


def test_a_report_that_ends_early_leaves_what_there_was(runs, micro_store):
    folder = reported(runs, micro_store.folder.parent, items=1)
    before = {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()}
    (runs / "sft" / "cot" / "metrics.json").write_text("{")
    with pytest.raises(UserError, match=r"metrics\.json"):
        reported(runs, micro_store.folder.parent, items=1)
    assert {path: path.read_bytes() for path in folder.rglob("*.*") if path.is_file()} == before


def test_without_the_benchmark_the_tables_still_stand(runs, tmp_path):
    folder = reported(runs, tmp_path / "nowhere")
    assert (folder / "tables" / "selection-micro.md").exists()
    page = (folder / "report.html").read_text()
    assert "The items of micro cannot be shown" in page
    assert 'id="data"' not in page


def test_two_item_sets_are_told_apart(runs, micro, micro_store):
    items = micro_store.selection("test")
    few = select_run(runs, micro_store, micro, "few", right, items[3:])
    with pytest.raises(UserError) as told:
        reported(runs, micro_store.folder.parent)
    assert str(few) in str(told.value)
    assert f"3 only in {runs / 'select' / 'base'} (such as " in str(told.value)
    for item in items[:3]:
        assert item.item_id in str(told.value)
    assert reported(runs, micro_store.folder.parent, runs=["select/few"], items=1)


def test_a_retrievers_items_are_told_from_its_scores(runs, micro, micro_store, tmp_path):
    folder = similarity_run(runs, micro_store, micro, "few", limit=9)
    of = ["select/base", "similarity/few"]
    with pytest.raises(UserError, match=r"\d+ only in .*base \(such as"):
        reported(runs, micro_store.folder.parent, runs=of)
    assert reported(runs, micro_store.folder.parent, runs=["similarity/few"])
    # A run of which they are not known hides no difference of others.
    similarity_run(runs, micro_store, micro, "old", limit=9)
    (runs / "similarity" / "old" / "scores.jsonl").unlink()
    with pytest.raises(UserError, match=r"\d+ only in .*base \(such as"):
        reported(runs, micro_store.folder.parent, runs=["similarity/old", *of])
    # Without them, their number has to do.
    (folder / "scores.jsonl").unlink()
    with pytest.raises(UserError, match=r"answered (\d+ and 9|9 and \d+) items"):
        reported(runs, micro_store.folder.parent, runs=of)


def test_a_retriever_is_held_against_what_it_began_from(runs, micro, micro_store):
    similarity_run(runs, micro_store, micro, "small", model="emb")
    # What it began from was measured by itself, too: a row of the same name.
    similarity_run(runs, micro_store, micro, "small")
    # And another of that name answered otherwise.
    similarity_run(runs, micro_store, micro, "small", model="other", untrained=(0, 1, 0, 0))
    of = ["similarity/*"]
    folder = reported(runs, micro_store.folder.parent, runs=of, items=40)
    table = (folder / "tables" / "apart-micro.md").read_text()
    parts = re.split(r"^\| \*less (.*?)\*.*$", table, flags=re.MULTILINE)[1:]
    below = dict(zip(parts[::2], parts[1::2], strict=True))
    assert set(below) == {
        "untrained small, emb (similarity)", "untrained small, other (similarity)"
    }  # fmt: skip
    assert all(text.count("(similarity) |") == 1 for text in below.values())
    first = np.mean([item.answer == 0 for item in micro_store.selection("test")])
    assert f"| {100 * (1 - first):+.1f} |" in table
    shown = page_data(folder)["items"]
    told = {s["by"]: s for s in shown[0]["said"]}
    assert told["emb (similarity)"]["verdict"] == "right"
    assert (
        told["untrained small, emb (similarity)"]["text"]
        == "A 0.5000, B 0.2500, C 0.1250, D 0.0000"
    )
    assert {s["letter"] for i in shown for s in i["said"] if "untrained small, emb" in s["by"]} == {
        "A"
    }


def test_a_tie_is_worth_its_share():
    both = Scored(dict(zip(LETTERS, (0.5, None, 0.5, 0.25), strict=True)))
    assert [both.credit(x) for x in LETTERS] == [0.5, 0, 0.5, 0]
    assert (both.choice.letter, str(both.choice.reason)) == (None, "several")
    assert both.text == "A 0.5000, B no score, C 0.5000, D 0.2500"
    assert Scored(dict.fromkeys(LETTERS)).credit("A") == 0


def test_two_databases_are_told_apart(runs, micro, micro_store):
    retrieve_run(runs, micro_store, micro, "larger", frames=70)
    with pytest.raises(UserError, match=r"ranked 60 frames of micro .* and .*larger 70 for"):
        reported(runs, micro_store.folder.parent)


@pytest.mark.parametrize("kind", ["select", "similarity", "retrieve", "two_stage"])
def test_what_was_built_anew_is_told_from_what_it_was_before(runs, micro_store, kind):
    [newest] = sorted((runs / kind).iterdir())[-1:]
    _add(newest / "report.json", build="anew")
    with pytest.raises(UserError, match=f"{newest.name} measured different builds of .* micro|"
                       f"{newest.name} and .* measured different builds"):  # fmt: skip
        reported(runs, micro_store.folder.parent)


@pytest.mark.parametrize(
    ("damage", "settings", "said"),
    [
        (lambda runs: (runs / "select/cot/config.yaml").unlink(), {}, "config.yaml is missing"),
        (
            lambda runs: (runs / "select/cot/config.yaml").write_text("a: [1"),
            {},
            "config.yaml is damaged",
        ),
        (lambda runs: (runs / "select/cot/report.json").unlink(), {}, "report.json is missing"),
        (lambda runs: (runs / "select/cot/report.json").write_text("[]"), {}, "another version"),
        (lambda runs: _add(runs / "select/cot/report.json", positions={"reasoning": {"A": 1}}),
         {}, "cot/report.json is .* of another version"),
        (lambda runs: _add(runs / "select/cot/report.json", calibration={"reasoning": {"bins": 1}}),
         {}, "cot/report.json is .* of another version"),
        (lambda runs: _add(runs / "select/cot/report.json", asked=[["reasoning", None]]),
         {}, "cot/report.json is .* of another version"),
        (lambda runs: (runs / "select/cot/config.yaml").write_text("model: 5"),
         {}, "cot/config.yaml is .* of another version"),
        (lambda runs: (runs / "similarity/clip/scores.jsonl").write_text('{"by": "clip"}'),
         {}, "clip/scores.jsonl is .* of another version"),
        (lambda runs: (runs / "similarity/clip/scores.jsonl").write_text(
            '{"by": "clip", "item_id": "a", "scores": [0.5]}'
         ),
         {}, "clip/scores.jsonl is .* of another version"),
        (lambda runs: (runs / "select/cot/run.json").write_text("{}"), {}, "cot/run.json is miss"),
        (lambda runs: (runs / "sft/cot/metrics.json").write_text("{"), {}, "cot/metrics.json is"),
        (lambda runs: None, {"runs": ["a**"]}, "a\\*\\* is no pattern of folders"),
        (lambda runs: (runs / "select/cot/metrics.json").unlink(), {"runs": ["select/cot"]},
         "no finished run"),
        (lambda runs: (runs / "study/friends").mkdir(parents=True), {"runs": ["study/friends"]},
         "once they are counted: run python -m evaluation.study.export run=friends"),
        (lambda runs: None, {"runs": ["select/cto"]}, "names no run .*; there are .*select/cot"),
        (lambda runs: None, {"runs": ["sft/*"]}, "nothing is measured"),
        (lambda runs: shutil.rmtree(runs / "select"), {"runs": ["select/*"]}, "names no run"),
    ],
)  # fmt: skip
def test_what_cannot_be_read_is_named(runs, micro_store, damage, settings, said):
    damage(runs)
    with pytest.raises(UserError, match=said) as told:
        reported(runs, micro_store.folder.parent, **settings)
    assert "\n" not in str(told.value)
    assert not (runs / "report" / "default" / "report.html").exists()


def _add(report: Path, **told: object) -> None:
    report.write_text(json.dumps(json.loads(report.read_text()) | told))


def test_patterns_are_checked_before_anything_is_read():
    assert ReportCommand(runs=[]).check()
    assert ReportCommand(runs=["", "select/*"]).check()
    assert ReportCommand(items=-1).check()
    assert not ReportCommand(runs=["select/*"]).check()
