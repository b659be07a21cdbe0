"""evaluation.retrieve on a small retriever: its results, its cache, and the models it refuses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from sentence_transformers import SentenceTransformer

import dynapix
from dynapix.conf.files import read_json_lines
from dynapix.conf.schema import ContrastiveTrainConfig, LateConfig, RetrieveCommand, RetrieverConfig
from dynapix.conf.schema.benchmark import POOLS
from dynapix.data.checks.baselines import score_scene_alone
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.store import open_store
from dynapix.evaluation import retrieve
from dynapix.evaluation.embedders import joint_encoder
from dynapix.evaluation.embedders.embedder import EMBEDDINGS, Embedder, open_embedders
from dynapix.evaluation.metrics.results import SCENE_ALONE
from dynapix.models.retriever import embedder
from dynapix.models.retriever import inputs as retriever_inputs
from tests.evaluation.metrics.reference import matrix_metrics, ranking_metrics
from tests.evaluation.models.conftest import RETRIEVER, new_run, save_retriever
from tests.user_errors import raises_user_error


@pytest.fixture
def measure(tmp_path, trained_retriever, micro, micro_store) -> Callable[..., dict]:
    """A function that evaluates a copy of the run on a copy of the store, and returns the report
    without the times."""
    shutil.copytree(trained_retriever, tmp_path / "run")
    shutil.copytree(micro_store.folder, tmp_path / "store" / "micro")
    shutil.rmtree(tmp_path / "store" / "micro" / EMBEDDINGS, ignore_errors=True)

    def run_command(name: str = "one", batch: int = 16, pool: str = "future") -> dict:
        run = new_run(tmp_path / name)
        cfg = RetrieveCommand(
            benchmark=micro, retriever=RetrieverConfig(name="unused", model="unused"),
            store=str(tmp_path / "store"), batch=batch, model=str(tmp_path / "run"), pool=pool,
        )  # fmt: skip
        metrics = retrieve.main.__wrapped__(cfg, run)
        report = json.loads((run.folder / "report.json").read_text())
        expected = {"recall@1", "recall@10", "recall@50", "mrr", "median_rank"}
        assert set(metrics) == expected | ({"twin_above"} if pool == "counterfactual" else set())
        assert metrics["recall@10"] == report["rows"][0]["recall_10"]["value"]
        assert all((row.pop("seconds") is None) == (row["width"] is None) for row in report["rows"])
        return report

    return run_command


def embedders(folder: Path, store, run: Path, precision: str = "bf16") -> list[Embedder]:
    settings = RetrieveCommand(
        retriever=RETRIEVER, train=ContrastiveTrainConfig(precision=precision)
    )
    return list(open_embedders(folder, settings, store, run, 16))


@pytest.mark.slow
def test_ranks_follow_the_definition_and_embeddings_are_computed_once(
    measure, tmp_path, micro_store
) -> None:
    first = measure()
    queries, database = micro_store.standard_test(), micro_store.database()
    frames = FrameReader(micro_store, 96)
    store = open_store(tmp_path / "store" / "micro")
    trained, _ = embedders(tmp_path / "run", store, tmp_path)
    query_rows = trained.embed_queries(queries).rows([q.query_id for q in queries])
    frame_rows = trained.embed_frames(database).rows([f.name for f in database])
    # The library computes equal embeddings, and the measures follow from them. Frames that score
    # within 1e-6 of the target may rank before or after it.
    model = SentenceTransformer(str(tmp_path / "run" / "retriever"), device="cpu")
    inputs = [retriever_inputs.query_input(q, frames, RETRIEVER) for q in queries]
    np.testing.assert_allclose(model.encode(inputs, prompt_name="query"), query_rows, atol=1e-5)
    inputs = [retriever_inputs.frame_input(f, frames) for f in database]
    np.testing.assert_allclose(model.encode(inputs, prompt_name="document"), frame_rows, atol=1e-5)
    targets = np.array([database.index(q.target) for q in queries])
    groups = 1 + len({q.builder for q in queries})
    widths = [*RETRIEVER.widths * 2 * groups, *[None] * groups]
    assert [row["width"] for row in first["rows"]] == widths
    for row in first["rows"][:2]:
        a, b = (rows[:, : row["width"]].astype(float) for rows in (query_rows, frame_rows))
        scores = a @ b.T / np.linalg.norm(a, axis=1)[:, None] / np.linalg.norm(b, axis=1)
        own = scores[np.arange(len(targets)), targets][:, None]
        worst = np.mean(1 / (scores > own - 1e-6).sum(1))
        best = np.mean(1 / (1 + (scores > own + 1e-6).sum(1)))
        assert best - worst < 0.2 * best, "the frames are too similar to show anything"
        assert worst - 1e-9 <= row["mrr"]["value"] <= best + 1e-9
    # The reported differences follow from the rows, and the rows from the ranks in ranks.jsonl.
    overall = {(r["name"], r["width"]): r for r in first["rows"] if r["builder"] is None}
    ranks = list(read_json_lines(tmp_path / "one" / "ranks.jsonl"))
    assert [r["query_id"] for r in ranks] == 2 * [q.query_id for q in queries]
    for k, pair in enumerate(first["differences"]):
        left, right = (overall[pair[side], pair["width"]] for side in ("left", "right"))
        assert "untrained" not in pair["left"]
        for name, reported in pair["measures"].items():
            key = name.replace("@", "_")
            difference = left[key]["value"] - right[key]["value"]
            assert reported["value"] == pytest.approx(difference, abs=1e-12)
        left_ranks = [row for row in ranks if row["by"] == pair["left"]]
        above, tied = (np.array([r[key][k] for r in left_ranks]) for key in ("above", "tied"))
        valid = np.ones(len(left_ranks), bool)
        measures = ranking_metrics(above, tied, valid, len(database), [1])
        assert measures["mrr"] == pytest.approx(left["mrr"]["value"])
    assert [pair["width"] for pair in first["differences"]] == RETRIEVER.widths
    assert (tmp_path / "one" / "retrieval.png").stat().st_size > 10_000
    text = (tmp_path / "one" / "report.txt").read_text()
    assert all(f"builder {q.builder} " in text for q in queries)

    # A second evaluation loads no model: without config.json, none could be loaded.
    (tmp_path / "run" / "retriever" / "config.json").unlink()
    (tmp_path / "run" / "untrained" / "config.json").unlink()
    assert measure("two") == first
    # Another precision needs other embeddings, for which the model cannot be loaded.
    config = OmegaConf.load(tmp_path / "run" / "config.yaml")
    config.train.precision = "fp32"
    OmegaConf.save(config, tmp_path / "run" / "config.yaml")
    with raises_user_error("damaged-file", contains="retriever"):
        measure("three")


def test_a_multi_vector_retriever_is_measured_by_late_interaction(
    measure, tmp_path, micro, micro_store
) -> None:
    shutil.rmtree(tmp_path / "run")
    cfg = replace(RETRIEVER, late=LateConfig(width=24))
    save_retriever(cfg, tmp_path / "run", micro, micro_store)
    first = measure()
    queries, database = micro_store.standard_test(), micro_store.database()
    frames = FrameReader(micro_store, 96)
    model = embedder.load_trained(cfg, "fp32", tmp_path / "run" / "retriever")
    query_rows = model.encode_query(
        [retriever_inputs.query_input(q, frames, RETRIEVER) for q in queries]
    )
    frame_rows = model.encode_document([retriever_inputs.frame_input(f, frames) for f in database])
    targets = np.array([database.index(q.target) for q in queries])
    row = first["rows"][0]
    expected = matrix_metrics(model.similarity(query_rows, frame_rows).numpy(), targets, [1])
    assert row["mrr"]["value"] == pytest.approx(expected["mrr"], rel=0.01)
    assert row["bytes"] == sum(v.numel() for v in frame_rows) * 4
    names = dict.fromkeys((row["name"], row["width"]) for row in first["rows"])
    assert list(names) == [("run", 24), ("untrained small, late", 24), (SCENE_ALONE, None)]
    baseline = next(r for r in first["rows"] if r["name"] == SCENE_ALONE)
    scene_alone = score_scene_alone(queries, database)
    assert baseline["recall_1"]["value"] == pytest.approx(scene_alone["recall@1"])
    assert baseline["mrr"]["value"] == pytest.approx(scene_alone["mrr"])
    assert baseline["median_rank"]["value"] == pytest.approx(scene_alone["median rank"])
    assert "MiB" in (tmp_path / "one" / "report.txt").read_text()
    (tmp_path / "run" / "retriever" / "config.json").unlink()
    (tmp_path / "run" / "untrained" / "config.json").unlink()
    assert measure("two") == first


@pytest.mark.parametrize("pool", POOLS)
def test_the_library_measures_what_the_command_measures(measure, tmp_path, pool) -> None:
    report = measure(pool=pool)
    bench = dynapix.load(tmp_path / "store" / "micro", pool=pool)
    trained, _ = embedders(tmp_path / "run", bench.store, tmp_path)
    queries, database = [q.record for q in bench.retrieval], [f.ref for f in bench.database]
    query_rows = trained.embed_queries(queries).rows([q.name for q in queries])
    frame_rows = trained.embed_frames(database).rows([f.name for f in database])
    scores = dynapix.evaluate_retrieval(
        bench.retrieval, query_rows, frame_rows, widths=RETRIEVER.widths, name="run"
    )
    library = json.loads(json.dumps([asdict(row) for row in scores.rows]))
    assert [row.pop("seconds") is None for row in library] == [False] * len(library)
    assert library == [row for row in report["rows"] if row["name"] == "run"]
    assert (pool == "counterfactual") == ("twin_above" in scores.metrics)
    baseline = report["rows"][-1]
    assert baseline["name"] == SCENE_ALONE
    assert baseline.get("twin_above", {"value": 0.5})["value"] == 0.5


def test_running_out_of_memory_names_the_batch(measure, monkeypatch) -> None:
    def run_out(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr(joint_encoder.JointEncoder, "embed_queries", run_out)
    with raises_user_error("out-of-memory", contains="batch"):
        measure()


def test_another_pooling_gives_other_embeddings(measure, tmp_path) -> None:
    first = measure()
    config = tmp_path / "run" / "retriever" / "1_Pooling" / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "pooling_mode": "mean"}))
    assert measure("two")["rows"] != first["rows"]
    (tmp_path / "run" / "retriever" / "modules.json").write_text("[")
    with raises_user_error("damaged-file"):
        measure("three")


def test_the_key_of_embeddings_depends_on_all_of_their_inputs(
    micro_store, trained_retriever, tmp_path
) -> None:
    store = open_store(shutil.copytree(micro_store.folder, tmp_path / "store" / "micro"))
    trained, untrained = embedders(trained_retriever, store, tmp_path, "fp32")
    database = store.database()[:2]

    def path_of(variant: Embedder) -> Path:
        embeddings = variant.embed_frames(database)
        assert embeddings.rows([f.name for f in database]).shape == (2, 64)
        return embeddings.path

    small = replace(RETRIEVER, image_size=64)
    paths = [
        path_of(trained),
        path_of(replace(trained, preset=small, frames=FrameReader(store, 64))),
        path_of(replace(trained, preset=replace(RETRIEVER, frame_instruction="Describe."))),
        path_of(replace(trained, precision="bf16")),
        path_of(untrained),
    ]
    assert len(set(paths)) == len(paths)
    # Neither the number of a query's frames nor its instruction changes a frame's embedding.
    other_query = replace(RETRIEVER, frames=6, query_instruction="Find.")
    assert path_of(replace(trained, preset=other_query)) == paths[0]


@pytest.mark.parametrize(
    ("name", "changes_key"),
    [("config.json", False), ("tokenizer.json", True), ("processor_config.json", True),
     ("chat_template.jinja", True)],
)  # fmt: skip
def test_an_edited_processor_changes_the_key(
    micro_store, trained_retriever, tmp_path, name, changes_key
) -> None:
    def keys() -> list[dict]:
        return [e.settings() for e in embedders(tmp_path / "run", micro_store, tmp_path)]

    shutil.copytree(trained_retriever, tmp_path / "run")
    before = keys()
    for part in ("retriever", "untrained"):
        path = tmp_path / "run" / part / name
        path.write_text(path.read_text() + "\n")
    changed = [new != old for new, old in zip(keys(), before, strict=True)]
    assert changed == [changes_key, changes_key]


@pytest.mark.slow
def test_long_texts_in_small_batches_have_the_same_embeddings(
    trained_retriever, micro_store, monkeypatch
) -> None:
    texts = ["The red cube rests.", *("It moves on. " * k for k in (40, 3, 1, 20, 2))]
    encoder = embedders(trained_retriever, micro_store, trained_retriever)[0].encoder
    expected, batches = encoder.embed_texts(texts), []
    encode = encoder._encode
    monkeypatch.setattr(encoder, "_encode", lambda *a: batches.append(a[0]) or encode(*a))
    longest = max(map(len, encoder._model.tokenizer(texts)["input_ids"]))
    for pairs, sizes in ((3 * longest**2, [3, 3]), (1, [1] * 6), (6 * longest**2, [6])):
        monkeypatch.setattr(joint_encoder, "MAX_TOKEN_PAIRS", pairs)
        batches.clear()
        np.testing.assert_allclose(encoder.embed_texts(texts), expected, atol=1e-5)
        assert [len(batch) for batch in batches] == sizes
