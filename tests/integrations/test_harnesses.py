"""Harnesses get the same responses and scores from a student as `evaluation.select`."""

from __future__ import annotations

import json

import pytest

import dynapix
from tests.integrations.conftest import Served
from tests.user_errors import raises_user_error


def check_result(result: dynapix.Result, served: Served) -> None:
    """Check that a result has the responses and the score of `evaluation.select`."""
    assert {o.item_id: o.text for o in result.outcomes} == served.texts
    assert result.accuracy.macro.value == pytest.approx(served.accuracy)


def open_benchmark(served: Served) -> dynapix.Benchmark:
    return dynapix.load(served.store.folder, frames=8, image_size=120)


def test_inspect(served, run_harness, tmp_path) -> None:
    run_harness(
        "inspect", "eval", "dynapix/selection", "--model", f"openai-api/local/{served.model}",
        "-T", f"benchmark={served.store.folder}", "-T", "frames=8", "-T", "image_size=120",
        "-T", "mode=answer", "--display", "plain",
        LOCAL_API_KEY="none", LOCAL_BASE_URL=served.url,
    )  # fmt: skip
    [log] = tmp_path.glob("logs/*.eval")
    bench = open_benchmark(served)
    result = dynapix.Result.from_inspect(log, bench)
    check_result(result, served)
    shown = run_harness("inspect", "log", "dump", "--header-only", str(log))
    header = json.loads(shown[shown.index("{") :])
    metrics = {
        name: metric["value"]
        for score in header["results"]["scores"]
        for name, metric in score["metrics"].items()
    }
    assert metrics["macro"] == pytest.approx(served.accuracy)
    assert metrics["accuracy"] == pytest.approx(result.accuracy.micro.value)
    assert metrics["stderr"] > 0

    folder = result.save(tmp_path / "runs" / "inspect")
    check_result(dynapix.Result.load(folder, bench), served)
    [entry] = result.to_eval_results("someone/moving-objects")
    assert entry["value"] == round(100 * served.accuracy, 2)
    assert entry["dataset"] == {"id": "someone/moving-objects", "task_id": "selection"}

    log.write_bytes(log.read_bytes()[:-100])
    with raises_user_error("damaged-file", contains=log.name):
        dynapix.Result.from_inspect(log, bench)


def test_lmms_eval(served, run_harness, tmp_path) -> None:
    tasks = run_harness("python", "-m", "dynapix.integrations.lmms").strip()
    settings = {"BENCHMARK": served.store.folder, "FRAMES": 8, "IMAGE_SIZE": 120, "MODE": "answer"}
    shown = run_harness(
        "python", "-m", "lmms_eval", "--include_path", tasks, "--tasks", "dynapix_selection",
        "--model", "openai", "--log_samples", "--output_path", "logs",
        "--model_args", f"model={served.model},base_url={served.url},api_key=none",
        **{f"DYNAPIX_{name}": str(value) for name, value in settings.items()},
    )  # fmt: skip
    [samples] = tmp_path.glob("logs/*/*_samples_dynapix_selection.jsonl")
    result = dynapix.Result.from_lmms_eval(samples, open_benchmark(served))
    check_result(result, served)
    [totals] = tmp_path.glob("logs/*/*_results.json")
    scores = json.loads(totals.read_text())["results"]["dynapix_selection"]
    assert scores["macro,none"] == pytest.approx(served.accuracy), shown
    with raises_user_error("damaged-file", contains=totals.name):
        dynapix.Result.from_lmms_eval(totals, open_benchmark(served))
