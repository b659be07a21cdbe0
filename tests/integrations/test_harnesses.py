"""Harnesses get the same responses and scores from a student as `evaluation.select`."""

from __future__ import annotations

import json
import os
from collections.abc import Iterator

import pytest
from openai import OpenAI

import dynapix
from dynapix.conf.files import read_json_lines
from dynapix.conf.schema import TeacherConfig
from dynapix.data.publish.huggingface import ensure_export
from dynapix.evaluation.reporting.runs import gather_runs
from dynapix.integrations.saved_logs import save_log
from dynapix.teacher.predicates.vocabulary import describe_item
from dynapix.train.rewards import REWARDS, judge_response
from tests.evaluation.models import released
from tests.integrations.conftest import Served
from tests.teacher.server_process import ROOT, vllm_server
from tests.user_errors import raises_user_error

UV = ROOT / ".venv" / "bin" / "uv"


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

    store, saved = served.store.folder.parent, tmp_path / "saved"
    check_result(dynapix.Result.load(save_log(log, store, saved), bench), served)
    with raises_user_error("different-builds", contains=log.name):
        save_log(log, tmp_path, saved)

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
        OPENAI_API_KEY="none",
        **{f"DYNAPIX_{name}": str(value) for name, value in settings.items()},
    )  # fmt: skip
    [samples] = tmp_path.glob("logs/*/*_samples_dynapix_selection.jsonl")
    result = dynapix.Result.from_lmms_eval(samples, open_benchmark(served))
    check_result(result, served)
    saved = save_log(samples, served.store.folder.parent, tmp_path / "saved")
    check_result(dynapix.Result.load(saved, open_benchmark(served)), served)
    [totals] = tmp_path.glob("logs/*/*_results.json")
    scores = json.loads(totals.read_text())["results"]["dynapix_selection"]
    assert scores["macro,none"] == pytest.approx(served.accuracy), shown
    with raises_user_error("damaged-file", contains=totals.name):
        dynapix.Result.from_lmms_eval(totals, open_benchmark(served))


MTEB = """
import sys, dynapix, mteb
from mteb.models.model_implementations.clip_models import CLIPModel
from dynapix.integrations.mteb_task import ClipEncoder, RetrievalTask

run, clip, folder = sys.argv[1:]
bench = dynapix.load(folder, image_size=96)
grids = CLIPModel(clip, None)
grids.processor.tokenizer.model_max_length = 77
grids.mteb_model_meta = mteb.get_model_meta("openai/clip-vit-base-patch32")
for name, encoder in (("grids", grids), ("clips", ClipEncoder(bench, run))):
    result = mteb.evaluate(encoder, RetrievalTask(bench), cache=None, prediction_folder=name)
[score] = result.task_results[0].scores["test"]
print({k: score[k] for k in ("recall_at_1", "recall_at_10")})
"""


def test_mteb(ranked, micro_store, run_harness, tmp_path) -> None:
    bench = dynapix.load(micro_store.folder, image_size=96)
    (tmp_path / "run.py").write_text(MTEB)
    released.clip(clip := tmp_path / "clip")
    arguments = map(str, (ranked, clip, bench.store.folder))
    shown = run_harness("python", "run.py", *arguments)
    scores = json.loads(shown.splitlines()[-1].replace("'", '"'))
    # MTEB shows its own models the prefix as a grid.
    [file] = tmp_path.glob("grids/*.json")
    assert 0 < dynapix.RetrievalScores.from_mteb(file, bench).metrics["mrr"] < 1
    [file] = tmp_path.glob("clips/*.json")
    result = dynapix.RetrievalScores.from_mteb(file, bench)
    rows = list(read_json_lines(ranked / "ranked" / "ranks.jsonl"))
    above = [row["above"][0] for row in rows if row["by"] == "moving"]
    assert len(set(above)) > 5
    assert result.ranks.above[0].tolist() == above
    for k in (1, 10):
        assert result.metrics[f"recall@{k}"] == pytest.approx(scores[f"recall_at_{k}"], abs=1e-4)
    assert (save_log(file, bench.store.folder.parent, tmp_path / "runs") / "ranks.jsonl").exists()
    runs, _ = gather_runs(tmp_path, tmp_path / "runs", None)
    assert [run.kind for run in runs] == ["retrieve"]

    file.write_text(file.read_text()[:-9])
    with raises_user_error("damaged-file", contains=file.name):
        dynapix.RetrievalScores.from_mteb(file, bench)


@pytest.fixture
def vllm_url(served, tmp_path) -> Iterator[str]:
    """The URL of vLLM with the student. verifiers reads a stream that ends with [DONE], which
    `transformers serve` does not send."""
    server = vllm_server(served.weights, tmp_path, "frames=true", "dtype=float32")
    server.start()
    yield server.url
    server.stop()


def test_verifiers(served, vllm_url, run_harness, tmp_path) -> None:
    client, limits = OpenAI(base_url=vllm_url, api_key="none"), {"max_tokens": 16}
    model = client.models.list().data[0].id
    tasks = run_harness("python", "-m", "dynapix.integrations.verifiers").strip()
    settings = {"benchmark": served.store.folder, "split": "test", "frames": 8, "image-size": 120}
    taskset = [f"--env.taskset.{name}={value}" for name, value in settings.items()]
    shown = run_harness(
        "vf-eval", "dynapix-selection", "-m", model, "-c", "1", "--no-push", "--no-rich",
        "--output-dir", "outputs", "--run.dir", "run", "--env.agent.harness.id", "null",
        "--env.agent.runtime.type", "subprocess", "--client.base-url", vllm_url,
        "--client.api-key-var", "NO_KEY", "--sampling.temperature", "0",
        "--sampling.max-tokens", "16", "--select.limit", "16", *taskset,
        "--env.taskset.mode", "answer",
        PYTHONPATH=tasks, NO_KEY="none", PATH=f"{UV.parent}:{os.environ['PATH']}",
    )  # fmt: skip
    bench, store = open_benchmark(served), served.store
    items = {item.item_id: item for item in bench.selection}
    traces = list(read_json_lines(tmp_path / "outputs" / "run" / "traces.jsonl"))
    assert len(traces) == 16, shown
    for trace in traces:
        item = items[trace["task"]["data"]["id"]]
        [played] = trace["traces"]
        text = played["nodes"][-1]["message"]["content"]
        answered = client.chat.completions.create(
            model=model, messages=item.messages("answer"), temperature=0, **limits
        )
        assert text == answered.choices[0].message.content
        predicates = describe_item(item.record, store, TeacherConfig())
        judged = judge_response(text, False, item.record, predicates)
        found = {name: reward["score"] for name, reward in played["rewards"].items()}
        assert found == {name: function(judged) for name, function in REWARDS.items()}
    assert {r["rewards"]["answer"]["score"] for t in traces for r in t["traces"]} == {0.0, 1.0}


LEADERBOARD = """
import sys, yaml
from datasets import load_dataset
from inspect_ai import Task, eval
from inspect_ai._eval.loader import scorer_from_spec, solver_from_spec
from inspect_ai._eval.task.hf import HFTask, _record_to_sample_hf
from inspect_ai.dataset import MemoryDataset
from inspect_ai.scorer._scorer import ScorerSpec
from inspect_ai.solver._solver import SolverSpec

folder, model = sys.argv[1:]
[task] = map(HFTask.model_validate, yaml.safe_load(open(folder + "/eval.yaml"))["tasks"])
rows = load_dataset(folder, task.config, split=task.split).select(range(12))
[solver], [scorer] = task.solvers, task.scorers
[log] = eval(
    Task(
        dataset=MemoryDataset([_record_to_sample_hf(row, task.field_spec) for row in rows]),
        solver=solver_from_spec(SolverSpec(solver.name, solver.args, solver.args)),
        scorer=scorer_from_spec(ScorerSpec(scorer=scorer.name), task_path=None, **scorer.args),
    ),
    model=model, display="none", max_tokens=16,
)
for sample in log.samples:
    print("SCORED", sample.target, sample.scores["pattern"].value, sample.output.completion)
"""


def test_inspect_reads_the_leaderboard_of_a_dataset(
    served, micro_store, run_harness, tmp_path
) -> None:
    ensure_export({"micro": micro_store}, tmp_path / "dataset", images=True)
    (tmp_path / "run.py").write_text(LEADERBOARD)
    model = f"openai-api/local/{served.model}"
    shown = run_harness(
        "python", "run.py", str(tmp_path / "dataset"), model,
        LOCAL_API_KEY="none", LOCAL_BASE_URL=served.url,
    )  # fmt: skip
    rows = [line.split() for line in shown.splitlines() if line.startswith("SCORED")]
    targets = [item.letter for item in micro_store.selection("test")[:12]]
    assert [row[1] for row in rows] == targets
    assert all((row[2] == "C") == (row[1] == row[-1]) for row in rows), shown
    assert {row[2] for row in rows} == {"C", "I"}
