"""The library: it imports fast, reads a benchmark, and scores as the commands do."""

from __future__ import annotations

import base64
import json
import pickle
import shutil
import sys
from concurrent.futures import ProcessPoolExecutor
from dataclasses import replace
from io import BytesIO
from multiprocessing import get_context

import numpy as np
import pytest
import torch
from PIL import Image

import dynapix
from dynapix.__main__ import COMMANDS, overview
from dynapix.benchmark import _reopen
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import SPLITS, Rationale
from dynapix.data.store import MANIFEST, RATIONALES, Store
from dynapix.evaluation.metrics.selection import Choices, build_selection_report
from dynapix.evaluation.reporting.tables import selection_table
from dynapix.selection import MIN_FAILURES_TO_STOP
from dynapix.teacher.journal import save_accepted
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.extraction import extract_predicates
from tests.children import run_child
from tests.conf.schemas import SCHEMAS
from tests.dynapix.models import always_a, describe, nearest
from tests.user_errors import raises_user_error

READING = {"numpy", "pyarrow", "PIL"}
"""The packages that reading a benchmark may import."""
PRESETS = ["tiny_balanced", "tiny_balanced-above", "small", "small-clevrer"]
"""Names that open the folders tiny_balanced-above and small."""


IMPORTS = (
    ("import dynapix; dir(dynapix)", set()),
    (
        "bench = dynapix.load(built)\n"
        "item = bench.selection[0]; item.prefix, item.times, item.candidates\n"
        "bench.retrieval[0].target.image, bench.database[0].image",
        READING,
    ),
    (
        "items = bench.selection[:8]; results = [\n"
        "    dynapix.evaluate(items, lambda item, letter=letter: letter, progress=False)\n"
        "    for letter in 'AB'\n"
        "]\n"
        "str(results[0]), str(results[0].compare(results[1])), items[0].messages()\n"
        "dynapix.score_rationale(items[0], 'Prediction: the cube stops.')",
        READING | {"yaml", "tqdm"},
    ),
    (
        # A built preset opens without the extra that builds.
        "sys.modules |= dict.fromkeys(['hydra', 'omegaconf'])\n"
        f"opened = [dynapix.load(name, store=store) for name in {PRESETS}]\n"
        "assert [len(each.selection) for each in opened] == [len(bench.selection)] * len(opened)",
        READING | {"yaml", "tqdm", "hydra", "omegaconf"},
    ),
)
"""Steps of one program, each with the packages that it may have imported at its end."""


def test_the_library_imports_only_what_its_work_needs(micro_store, tmp_path) -> None:
    for name in ("tiny_balanced-above", "small"):
        (tmp_path / name).symlink_to(micro_store.folder)
    report = (
        "print(json.dumps([*{n.split('.')[0] for n in sys.modules} - sys.stdlib_module_names]))"
    )
    lines = ["import json, sys", f"built, store = {str(micro_store.folder)!r}, {str(tmp_path)!r}"]
    for code, _ in IMPORTS:
        lines += [code, report]
    done = run_child([sys.executable, "-c", "\n".join(lines)], check=True)
    for (code, allowed), shown in zip(IMPORTS, done.stdout.splitlines(), strict=True):
        roots = {name for name in json.loads(shown) if not name.startswith("_")}
        assert roots - {"dynapix", "cython_runtime", "cloudpickle"} <= allowed, code


def test_every_public_name_exists_has_a_docstring_and_is_in_the_overview() -> None:
    assert dir(dynapix) == sorted(dynapix.__all__)
    for name in dynapix.__all__:
        assert getattr(dynapix, name).__doc__, name
    with pytest.raises(AttributeError, match="has no attribute 'evaluat'"):
        dynapix.evaluat  # noqa: B018
    text = overview()
    assert sorted(COMMANDS) == sorted(SCHEMAS)
    assert all(name in text for name in (*SCHEMAS, *dynapix.__all__, "tiny", "make run"))


def test_items_are_those_of_the_store(bench, micro_store) -> None:
    records = micro_store.selection("test")
    assert [item.record for item in bench.selection] == records
    frames = FrameReader(micro_store)
    for item, record in zip(bench.selection, records, strict=True):
        count = min(12, record.prefix_stop - record.prefix_start + 1)
        assert item.prefix.shape == (count, 128, 192, 3)
        assert item.prefix.dtype == np.uint8
        first = frames.array(record.scene_id, record.prefix_start)
        assert np.array_equal(item.prefix[0], first)
        assert item.times[0] == record.prefix_start / 25
        assert item.times[-1] == record.prefix_stop / 25
        target = frames.array(record.scene_id, record.target_frame)
        assert np.array_equal(item.candidates["ABCD".index(item.answer)], target)
        assert (item.question, item.family) == (record.question, record.family)
    few = bench.selection[2:5]
    assert [item.item_id for item in few] == [record.item_id for record in records[2:5]]


@pytest.mark.parametrize("split", SPLITS)
@pytest.mark.parametrize("pool", ["future", "counterfactual"])
def test_queries_and_frames_are_those_of_the_store(micro_store, split, pool) -> None:
    bench = dynapix.load(micro_store.folder, split=split, pool=pool)
    records = [query.record for query in bench.retrieval]
    standard = (split, pool) == ("test", "future")
    assert records == (
        micro_store.standard_test() if standard else micro_store.retrieval(split, pool)
    )
    names = {frame.name for frame in bench.database}
    assert not standard or names == {ref.name for ref in micro_store.database("test")}
    assert {query.target.name for query in bench.retrieval} <= names
    assert {q.factual_twin.name for q in records if q.factual_twin} <= names
    assert pickle.loads(pickle.dumps(bench.retrieval[0])).record == records[0]


def test_a_result_is_the_report_of_the_command(bench, micro_store) -> None:
    result = dynapix.evaluate(bench.selection, always_a, progress=False, seed=3)
    items = micro_store.selection("test")
    credits = [float(item.letter == "A") for item in items]
    choices = Choices("model", "text", None, credits, ["A"] * len(items))
    report = build_selection_report([choices], items, micro_store, 3)
    assert result.accuracy == report.rows[0]
    assert str(selection_table(report.rows)) in str(result)


def test_letters_texts_and_scores_give_equal_credits(bench) -> None:
    for predict in (
        lambda item: np.eye(4)[item.index],
        lambda item: f"The ball rolls on.\nAnswer: {item.answer}",
        lambda item: item.answer,
    ):
        result = dynapix.evaluate(bench.selection, predict, progress=False)
        assert result.accuracy.macro.value == 1
    tied = dynapix.evaluate(bench.selection, lambda item: [1, 1, 1, 1], progress=False)
    assert tied.accuracy.micro.value == 0.25
    batches: list[int] = []

    def in_batches(items: list[dynapix.Item]) -> list[str]:
        batches.append(len(items))
        return [item.answer for item in items]

    result = dynapix.evaluate(bench.selection, in_batches, batch_size=7, progress=False)
    assert result.accuracy.macro.value == 1
    assert sum(batches) == len(bench.selection)
    assert set(batches[:-1]) == {7}


class Unreadable:
    """An array of a library that raises an error of its own when it is read."""

    def __array__(self, *_: object, **__: object) -> np.ndarray:
        raise LookupError("the device is gone")


@pytest.mark.parametrize(
    ("bad", "reason"),
    [
        (lambda: 1 / 0, "ZeroDivisionError"),
        (lambda: None, "None (NoneType) instead of"),
        (lambda: [0.1, 0.2, 0.7], "[0.1, 0.2, 0.7] (list) instead of"),
        (lambda: [0.1, float("nan"), 0.2, 0.3], "not all finite"),
        (lambda: Unreadable(), "(Unreadable) instead of"),
    ],
)
def test_items_that_fail_are_kept_and_count_as_wrong(bench, bad, reason) -> None:
    failing = {item.item_id for item in bench.selection[1:4]}

    def predict(item: dynapix.Item) -> str:
        return bad() if item.item_id in failing else item.answer

    result = dynapix.evaluate(bench.selection, predict, progress=False)
    assert {failure.item_id for failure in result.failures} == failing
    assert all(reason in failure.reason for failure in result.failures)
    count = len(bench.selection)
    assert result.accuracy.micro.value == pytest.approx(1 - 3 / count)
    assert "3 items failed and count as wrong" in str(result)
    # An evaluation whose items all fail stops early.
    shown = (reason, bench.selection[0].item_id, str(MIN_FAILURES_TO_STOP))
    with raises_user_error("invalid-prediction", contains=shown):
        dynapix.evaluate(bench.selection, lambda item: bad(), progress=False)


def test_results_are_compared_on_the_same_items(bench) -> None:
    one = dynapix.evaluate(bench.selection, always_a, name="one", progress=False)
    two = dynapix.evaluate(bench.selection, nearest, name="two", progress=False)
    comparison = one.compare(two)
    assert [c.of for c in comparison] == ["event", "time", "window", "macro", "all"]
    difference = one.accuracy.micro.value - two.accuracy.micro.value
    assert comparison[-1].difference == pytest.approx(difference)
    assert "one (left) minus two (right)" in str(comparison)
    few = dynapix.evaluate(bench.selection[:-2], always_a, name="few", progress=False)
    with raises_user_error("different-items", contains=("2 only in one",)):
        one.compare(few)


def test_a_rationale_is_scored_by_the_oracle(bench, micro_store) -> None:
    found = []
    for item in bench.selection[:20]:
        scene = micro_store.scene(item.scene_id)
        predicates = extract_predicates(item.record, scene, micro_store.scene)
        if predicates is None:
            continue
        text = write_rationale(predicates, item.record, 0)
        score = dynapix.score_rationale(item, text)
        assert score.supported
        assert not score.contradicted
        assert not score.numbers
        found.append(dynapix.sufficiency(item, text))
        assert dynapix.sufficiency(item, text.replace("Prediction:", "Summary:")) == 0.25
    assert len(found) > 5
    assert np.mean(found) > 0.9
    score = dynapix.score_rationale(bench.selection[0], f"{text} It took two seconds.")
    assert "two" in score.numbers[0]
    assert "numbers: two" in str(score)


def test_name_of_a_preset_and_a_world_builds_the_benchmark_in_the_world(
    micro_store, tmp_path, monkeypatch
) -> None:
    built = []

    def remember(cfg, root, workers):
        built.append((cfg.store_name, cfg.world.physics.rolling_friction, root))
        return micro_store

    monkeypatch.setattr("dynapix.data.build.ensure_benchmark", remember)
    assert dynapix.load("tiny-settling", store=tmp_path).store is micro_store
    assert built == [("tiny-settling", 0.025, tmp_path)]


def test_unknown_and_damaged_benchmarks_are_refused(micro_store, tmp_path) -> None:
    with raises_user_error("unknown-benchmark", contains=("tinny", "tiny", "micro")):
        dynapix.load("tinny", store=micro_store.folder.parent)
    with raises_user_error("unknown-benchmark", contains=("tiny-mars", "settling")):
        dynapix.load("tiny-mars", store=micro_store.folder.parent)
    with raises_user_error("unknown-option", contains="train or test"):
        dynapix.load(micro_store.folder, split="validation")
    with raises_user_error("invalid-setting", contains="frames=0"):
        dynapix.load(micro_store.folder, frames=0)
    copy = tmp_path / "copy"
    shutil.copytree(micro_store.folder, copy)
    manifest = (copy / MANIFEST).read_text()
    (copy / MANIFEST).write_text(manifest.replace('"builders": "', '"builders": "0', 1))
    with raises_user_error("different-version", contains="builders"):
        dynapix.load(copy)
    (copy / MANIFEST).write_text("{")
    with raises_user_error("damaged-file", contains=MANIFEST):
        dynapix.load(copy)


def test_messages_show_the_item_in_the_order_of_the_prompt(bench) -> None:
    item = bench.selection[0]
    [message] = item.messages()
    parts = message["content"]
    urls = [part["image_url"]["url"] for part in parts if part["type"] == "image_url"]
    images = [Image.open(BytesIO(base64.b64decode(url.partition(",")[2]))) for url in urls]
    expected = [*item.prefix, *item.candidates]
    assert all(map(np.array_equal, map(np.asarray, images), expected))
    assert len(images) == len(expected)
    texts = [part["text"] for part in parts if part["type"] == "text"]
    times = [text for time in item.times for text in (f"At {time:.2f} s: ", "\n")]
    letters = [f"\nCandidate {letter}: " for letter in "ABCD"]
    assert texts[:-1] == [*times, item.question, *letters]
    assert "step by step" in texts[-1]
    assert "step by step" not in item.messages("answer")[0]["content"][-1]["text"]
    with raises_user_error("unknown-option", contains="reasoning or answer"):
        item.messages("record")


def test_rationales_are_those_of_the_last_narration(micro_store, tmp_path) -> None:
    folder = tmp_path / "copy"
    shutil.copytree(micro_store.folder, folder)
    (folder / RATIONALES).unlink(missing_ok=True)
    with raises_user_error("no-rationales", contains="teacher.narrate"):
        dynapix.load(folder).rationales  # noqa: B018
    written = [
        Rationale(f"item-{k}", 0, True, f"Text {k}.", "A", "template", "1", "1", "0", 0)
        for k in range(3)
    ]
    save_accepted(written, folder / RATIONALES)
    assert dynapix.load(folder).rationales == {r.item_id: r.text for r in written}


def test_items_that_cannot_be_evaluated_together_are_refused(bench, micro_store) -> None:
    rebuilt = replace(micro_store, manifest=micro_store.manifest | {"renderer": "other"})
    other = dynapix.Benchmark(rebuilt, "test", frames=12, image_size=None)
    with raises_user_error("invalid-items"):
        dynapix.evaluate([], always_a)
    items, queries = list(bench.selection), list(bench.retrieval)
    with raises_user_error("repeated-items", contains=items[1].item_id):
        dynapix.evaluate([*items, items[1], items[1]], always_a, progress=False)
    rows, frames = np.ones((len(queries) + 1, 4)), np.ones((len(bench.database), 4))
    with raises_user_error("repeated-items", contains=queries[0].query_id):
        dynapix.evaluate_retrieval([*queries, queries[0]], rows, frames)
    with raises_user_error("invalid-items"):
        dynapix.evaluate([bench.selection[0], other.selection[0]], always_a)
    with raises_user_error("invalid-prediction", contains=("3", "4")):
        dynapix.evaluate(bench.selection, lambda items: ["A"] * 3, batch_size=4, progress=False)
    with raises_user_error("invalid-prediction", contains="texts for some items"):
        dynapix.evaluate(
            bench.selection,
            lambda item: "A" if item.family == "time" else [0, 0, 0, 1],
            progress=False,
        )


TENSORS = {
    "gradients": lambda rows: torch.tensor(rows, requires_grad=True),
    "bf16": lambda rows: torch.tensor(rows, dtype=torch.bfloat16, requires_grad=True),
    "list": lambda rows: list(torch.tensor(rows, requires_grad=True)),
}


@pytest.mark.parametrize("kind", TENSORS)
def test_numbers_of_every_kind_are_read(bench, kind) -> None:
    scores = np.eye(4, dtype=np.float32)
    result = dynapix.evaluate(
        bench.selection, lambda item: TENSORS[kind](scores[item.index]), progress=False
    )
    assert (result.accuracy.micro.value, result.failures) == (1, [])
    gold = torch.arange(4)
    assert dynapix.rank_metrics(TENSORS[kind](scores), gold, ks=[1])["recall@1"] == 1
    queries, frames = np.ones((len(bench.retrieval), 4)), np.ones((len(bench.database), 4))
    constant = dynapix.evaluate_retrieval(bench.retrieval, *map(TENSORS[kind], (queries, frames)))
    assert constant.metrics["tie_rate"] == 1


def test_scores_that_are_no_numbers_are_refused() -> None:
    for scores in ([[1.0], [1.0, 2.0]], "scores", Unreadable):
        with raises_user_error("invalid-scores"):
            dynapix.rank_metrics(scores, [0])


def test_public_objects_can_be_sent_to_workers(bench, monkeypatch) -> None:
    items = bench.selection[:2]
    result = dynapix.evaluate(bench.selection, always_a, progress=False)
    vectors = np.ones((len(bench.retrieval), 4)), np.ones((len(bench.database), 4))
    scores = dynapix.evaluate_retrieval(bench.retrieval, *vectors)
    copies = pickle.loads(pickle.dumps((bench, items, result, scores, bench.database[0])))
    assert (copies[0].name, copies[0].frames) == (bench.name, bench.frames)
    assert [item.record for item in copies[1]] == [item.record for item in items]
    assert copies[1][0]._benchmark is copies[0]
    assert (str(copies[2]), str(copies[3])) == (str(result), str(scores))
    assert len(pickle.dumps(items[0])) < 10_000
    assert copies[2].compare(result)[-1].difference == 0
    with ProcessPoolExecutor(1, mp_context=get_context("spawn")) as pool:
        records = [items[0], bench.retrieval[0]]
        assert list(pool.map(describe, records)) == list(map(describe, records))
    # Objects of a benchmark that was built again since are refused.
    pickled = pickle.dumps(bench.selection[0])
    monkeypatch.setattr(Store, "identity", "another")
    _reopen.cache_clear()
    with raises_user_error("different-builds", contains=str(bench.store.folder)):
        pickle.loads(pickled)


def test_home_folder_is_expanded_and_a_broken_link_refused(bench, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("HOME", str(tmp_path))
    (tmp_path / "built").symlink_to(bench.store.folder)
    assert len(dynapix.load("~/built").selection) == len(bench.selection)
    assert len(dynapix.load("built", store="~").selection) == len(bench.selection)
    # A folder that is really called "~" is not the home folder.
    (tmp_path / "~").mkdir()
    shutil.copytree(bench.store.folder, tmp_path / "~" / "built")
    monkeypatch.chdir(tmp_path)
    assert dynapix.load("./~/built").selection[0].record == bench.selection[0].record
    saved = dynapix.evaluate(bench.selection, always_a, progress=False).save("~/runs/a")
    assert saved == tmp_path / "runs" / "a"
    assert len(dynapix.Result.load("~/runs/a", bench).items) == len(bench.selection)
    (tmp_path / "tiny-above").symlink_to("nowhere")
    with raises_user_error("broken-link", contains=str(tmp_path / "tiny-above")):
        dynapix.load("tiny", store="~")
