"""evaluation.retrieve on a small retriever: its results, its cache, and the models it refuses."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace
from pathlib import Path
from unittest.mock import Mock

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
from dynapix.data.store import Store, open_store
from dynapix.evaluation import retrieve
from dynapix.evaluation.embedders import joint_encoder
from dynapix.evaluation.embedders.embedder import EMBEDDINGS, Embedder, open_embedders
from dynapix.evaluation.metrics.results import SCENE_ALONE
from dynapix.models.retriever import embedder
from dynapix.models.retriever import inputs as retriever_inputs
from tests.evaluation.metrics.reference import matrix_metrics
from tests.evaluation.models.conftest import RETRIEVER, new_run, save_retriever
from tests.user_errors import raises_user_error


def prepare(root: Path, trained: Path, store: Store) -> Path:
    """Copy a run and a store without embeddings below `root`."""
    shutil.copytree(trained, root / "run")
    shutil.copytree(store.folder, root / "store" / "micro")
    shutil.rmtree(root / "store" / "micro" / EMBEDDINGS, ignore_errors=True)
    return root


def measure(root: Path, micro, name: str = "one", pool: str = "future") -> dict:
    """Evaluate the run below `root`, and return the report without the times."""
    run = new_run(root / name)
    cfg = RetrieveCommand(
        benchmark=micro, retriever=RetrieverConfig(name="unused", model="unused"),
        store=str(root / "store"), batch=16, model=str(root / "run"), pool=pool,
    )  # fmt: skip
    metrics = retrieve.main.__wrapped__(cfg, run)
    report = json.loads((run.folder / "report.json").read_text())
    expected = {"recall@1", "recall@10", "recall@50", "mrr", "median_rank"}
    assert set(metrics) == expected | ({"twin_above"} if pool == "counterfactual" else set())
    assert metrics["recall@10"] == report["rows"][0]["recall_10"]["value"]
    assert all((row.pop("seconds") is None) == (row["width"] is None) for row in report["rows"])
    return report


@pytest.fixture(scope="module")
def measured(tmp_path_factory, trained_retriever, micro, micro_store) -> tuple[Path, dict]:
    """A folder with a run, its store and its evaluation `one`, and the report of the evaluation."""
    root = prepare(tmp_path_factory.mktemp("measured"), trained_retriever, micro_store)
    return root, measure(root, micro)


@pytest.fixture
def copied(measured, tmp_path) -> Path:
    """A copy of that folder, in which a test may change files."""
    return shutil.copytree(measured[0], tmp_path / "copied")


def embedders(root: Path, store: Store) -> list[Embedder]:
    train = ContrastiveTrainConfig(precision="bf16")
    settings = RetrieveCommand(retriever=RETRIEVER, train=train)
    return list(open_embedders(root / "run", settings, store, root, 16))


@pytest.mark.parametrize("pool", POOLS)
def test_ranks_are_those_of_the_librarys_embeddings(measured, copied, micro, pool) -> None:
    """As sentence-transformers embeds, and as `dynapix.evaluate_retrieval` ranks."""
    name = "one" if pool == "future" else pool
    report = measured[1] if pool == "future" else measure(copied, micro, name, pool)
    bench = dynapix.load(copied / "store" / "micro", pool=pool)
    queries, database = [q.record for q in bench.retrieval], [f.ref for f in bench.database]
    trained, _ = embedders(copied, bench.store)
    query_rows = trained.embed_queries(queries).rows([q.name for q in queries])
    frame_rows = trained.embed_frames(database).rows([f.name for f in database])
    frames = FrameReader(bench.store, 96)
    model = SentenceTransformer(str(copied / "run" / "retriever"), device="cpu")
    inputs = [retriever_inputs.query_input(q, frames, RETRIEVER) for q in queries]
    np.testing.assert_allclose(model.encode(inputs, prompt_name="query"), query_rows, atol=1e-5)
    inputs = [retriever_inputs.frame_input(f, frames) for f in database]
    np.testing.assert_allclose(model.encode(inputs, prompt_name="document"), frame_rows, atol=1e-5)

    scores = dynapix.evaluate_retrieval(
        bench.retrieval, query_rows, frame_rows, widths=RETRIEVER.widths, name="run"
    )
    library = json.loads(json.dumps([asdict(row) for row in scores.rows]))
    assert [row.pop("seconds") is None for row in library] == [False] * len(library)
    assert library == [row for row in report["rows"] if row["name"] == "run"]
    # All counterfactual queries have one builder.
    builders = {q.builder for q in queries} if pool == "future" else set()
    groups = 1 + len(builders)
    widths = [*RETRIEVER.widths * 2 * groups, *[None] * groups]
    assert [row["width"] for row in report["rows"]] == widths
    baseline = report["rows"][-1]
    assert baseline["name"] == SCENE_ALONE
    assert baseline.get("twin_above", {"value": 0.5})["value"] == 0.5
    pairs = [(pair["left"], pair["right"], pair["width"]) for pair in report["differences"]]
    assert pairs == [("run", "untrained small", width) for width in RETRIEVER.widths]
    ranks = list(read_json_lines(copied / name / "ranks.jsonl"))
    assert [row["query_id"] for row in ranks] == 2 * [q.query_id for q in queries]
    above = np.array([row["above"] for row in ranks[: len(queries)]]).T
    assert np.array_equal(above, scores.ranks.above)
    text = (copied / name / "report.txt").read_text()
    assert all(f"builder {builder} " in text for builder in builders)


def test_embeddings_are_computed_once(measured, copied, micro) -> None:
    """Without config.json, no model could be loaded."""
    for part in ("retriever", "untrained"):
        (copied / "run" / part / "config.json").unlink()
    assert measure(copied, micro, "two") == measured[1]
    # Another precision needs other embeddings.
    config = OmegaConf.load(copied / "run" / "config.yaml")
    config.train.precision = "fp32"
    OmegaConf.save(config, copied / "run" / "config.yaml")
    with raises_user_error("damaged-file", contains="retriever"):
        measure(copied, micro, "three")


def test_a_multi_vector_retriever_is_measured_by_late_interaction(
    tmp_path, micro, micro_store
) -> None:
    cfg = replace(RETRIEVER, late=LateConfig(width=24))
    prepare(tmp_path, save_retriever(cfg, tmp_path / "saved", micro, micro_store), micro_store)
    report = measure(tmp_path, micro)
    queries, database = micro_store.standard_test(), micro_store.database()
    frames = FrameReader(micro_store, 96)
    model = embedder.load_trained(cfg, "fp32", tmp_path / "run" / "retriever")
    query_rows = model.encode_query(
        [retriever_inputs.query_input(q, frames, RETRIEVER) for q in queries]
    )
    frame_rows = model.encode_document([retriever_inputs.frame_input(f, frames) for f in database])
    targets = np.array([database.index(q.target) for q in queries])
    row = report["rows"][0]
    expected = matrix_metrics(model.similarity(query_rows, frame_rows).numpy(), targets, [1])
    assert row["mrr"]["value"] == pytest.approx(expected["mrr"], rel=0.01)
    assert row["bytes"] == sum(v.numel() for v in frame_rows) * 4
    names = dict.fromkeys((row["name"], row["width"]) for row in report["rows"])
    assert list(names) == [("run", 24), ("untrained small, late", 24), (SCENE_ALONE, None)]
    baseline = next(r for r in report["rows"] if r["name"] == SCENE_ALONE)
    scene_alone = score_scene_alone(queries, database)
    assert baseline["mrr"]["value"] == pytest.approx(scene_alone["mrr"])


def test_the_key_of_embeddings_depends_on_all_of_their_inputs(copied, monkeypatch) -> None:
    store = open_store(copied / "store" / "micro")
    trained, untrained = embedders(copied, store)
    frame = store.database()[:1]
    other_prompt = replace(trained, preset=replace(RETRIEVER, frame_instruction="Describe."))
    paths = {e.embed_frames(frame).path for e in (trained, untrained, other_prompt)}
    assert len(paths) == 3
    # Neither the number of a query's frames nor its instruction changes a frame's embedding.
    other_query = replace(RETRIEVER, frames=6, query_instruction="Find.")
    assert replace(trained, preset=other_query).embed_frames(frame).path in paths
    before = trained.settings()
    small = replace(trained, preset=replace(RETRIEVER, image_size=64))
    assert before not in (small.settings(), replace(trained, precision="fp32").settings())
    for name, changes_key in (
        ("config.json", False), ("tokenizer.json", True), ("processor_config.json", True),
        ("chat_template.jinja", True), ("1_Pooling/config.json", True),
    ):  # fmt: skip
        path = copied / "run" / "retriever" / name
        path.write_text(path.read_text() + "\n")
        edited = embedders(copied, store)[0].settings()
        assert (edited != before) == changes_key, name
        before = edited

    run_out = Mock(side_effect=torch.OutOfMemoryError("CUDA out of memory"))
    monkeypatch.setattr(joint_encoder.JointEncoder, "embed_texts", run_out)
    with raises_user_error("out-of-memory", contains="batch"):
        trained.embed_texts(["A frame."])
