"""`evaluation.retrieve` on a small retriever: its numbers, what it keeps, and what it refuses."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from omegaconf import OmegaConf
from safetensors.torch import load_file, save_file
from sentence_transformers import SentenceTransformer

from conf.entry import Run
from conf.errors import UserError
from conf.schema import (
    ArchitectureConfig,
    ContrastiveCommand,
    ContrastiveTrainConfig,
    LateConfig,
    LoraConfig,
    RetrieveCommand,
    RetrieverConfig,
)
from data.render.frame_cache import FrameReader
from data.store import open_store
from evaluation import retrieve
from evaluation.embedders import joint_encoder
from evaluation.embedders.base import EMBEDDINGS, embed_frames, embed_queries, open_embedders
from models.retriever import embedder
from tests.evaluation.metrics.reference import matrix_metrics, ranking_metrics
from tests.user_errors import raises_user_error

CFG = RetrieverConfig(
    name="small", widths=[64, 32], quantization="none", lora=LoraConfig(rank=0), image_size=96,
    architecture=ArchitectureConfig(
        hidden=64, layers=1, heads=2, kv_heads=2, feed_forward=64,
        vision_hidden=64, vision_layers=1, vision_heads=2, vision_feed_forward=64,
    ),
)  # fmt: skip


@pytest.fixture(scope="module")
def saved(tmp_path_factory, micro, micro_store) -> Path:
    return save_run(CFG, tmp_path_factory.mktemp("contrastive") / "run", micro, micro_store)


def save_run(cfg: RetrieverConfig, folder: Path, micro, micro_store) -> Path:
    """A finished run of the trainer, as it leaves it."""
    texts = embedder.tokenizer_texts(micro_store.retrieval("train"), cfg)
    built = embedder.load_retriever(cfg, "fp32", texts, folder / "untrained")
    # Far enough from its start that frames are apart: a new model's cosines differ by fp32's noise.
    noise = torch.Generator().manual_seed(0)
    for weight in built.parameters():
        weight.data += 0.1 * torch.randn(weight.shape, generator=noise)
    built.save_pretrained(str(folder / "retriever"), create_model_card=False)
    train = ContrastiveTrainConfig(precision="bf16")
    settings = ContrastiveCommand(benchmark=micro, retriever=cfg, train=train)
    OmegaConf.save(OmegaConf.structured(settings), folder / "config.yaml")
    (folder / "metrics.json").write_text("{}")
    return folder


@pytest.fixture
def world(tmp_path, saved, micro, micro_store) -> Callable[..., dict]:
    """Measures a copy of the run on a copy of the store; the report, without the times."""
    shutil.copytree(saved, tmp_path / "run")
    shutil.copytree(micro_store.folder, tmp_path / "store" / "micro")
    shutil.rmtree(tmp_path / "store" / "micro" / EMBEDDINGS, ignore_errors=True)
    unused = RetrieverConfig(name="unused", model="unused")

    def measure(name: str = "one", **settings) -> dict:
        run = Run(name, tmp_path / name)
        run.folder.mkdir(exist_ok=True)
        cfg = RetrieveCommand(
            benchmark=micro, retriever=unused, store=str(tmp_path / "store"), batch=16,
            model=str(tmp_path / "run"),
        )  # fmt: skip
        retrieve.main.__wrapped__(replace(cfg, **settings), run)
        report = json.loads((run.folder / "report.json").read_text())
        assert all(row.pop("seconds") is not None for row in report["rows"])
        return report

    return measure


def edit_config(folder: Path, **changes: object) -> None:
    cfg = OmegaConf.load(folder / "config.yaml")
    for key, value in changes.items():
        OmegaConf.update(cfg, key.replace("__", "."), value)
    OmegaConf.save(cfg, folder / "config.yaml")


@pytest.mark.slow
def test_it_is_measured_once_and_read_back(world, tmp_path, micro_store) -> None:
    first = world()
    queries, database = micro_store.standard_test(), micro_store.database()
    frames, names = FrameReader(micro_store, 96), [f.name for f in database]
    (trained, _) = open_embedders(tmp_path / "run", CFG, "bf16", micro_store, tmp_path)
    store = open_store(tmp_path / "store" / "micro")
    asked = embed_queries(trained, queries, store, frames, 16).rows([q.query_id for q in queries])
    shown = embed_frames(trained, database, store, frames, 16).rows(names)
    # What was kept is what the saved model gives anyone, and the report is the plain definition's,
    # whichever way the frames fall that fp32 hardly tells from the right one.
    model = SentenceTransformer(str(tmp_path / "run" / "retriever"), device="cpu")
    plain = [embedder.query_input(q, frames, CFG) for q in queries]
    np.testing.assert_allclose(model.encode(plain, prompt_name="query"), asked, atol=1e-5)
    plain = [embedder.frame_input(f, frames) for f in database]
    np.testing.assert_allclose(model.encode(plain, prompt_name="document"), shown, atol=1e-5)
    gold = np.array([database.index(q.target) for q in queries])
    for row in first["rows"][:2]:
        a, b = (e[:, : row["width"]].astype(float) for e in (asked, shown))
        scores = a @ b.T / np.linalg.norm(a, axis=1)[:, None] / np.linalg.norm(b, axis=1)
        right = scores[np.arange(len(gold)), gold][:, None]
        worst = np.mean(1 / (scores > right - 1e-6).sum(1))
        best = np.mean(1 / (1 + (scores > right + 1e-6).sum(1)))
        assert best - worst < 0.2 * best, "frames that are not apart show nothing"
        assert worst - 1e-9 <= row["mrr"]["value"] <= best + 1e-9
    # What is apart is what the rows are apart; and the ranks that are kept make up the rows.
    every = {(r["name"], r["width"]): r for r in first["rows"] if r["builder"] is None}
    lines = (tmp_path / "one" / "ranks.jsonl").read_text().splitlines()
    kept = [json.loads(line) for line in lines]
    assert [k["query_id"] for k in kept] == 2 * [q.query_id for q in queries]
    for k, of in enumerate(first["differences"]):
        sides = [every[of[side], of["width"]] for side in ("left", "right")]
        assert "untrained" not in of["left"]
        for name, found in of["measures"].items():
            key = name.replace("@", "_")
            apart = sides[0][key]["value"] - sides[1][key]["value"]
            assert found["value"] == pytest.approx(apart, abs=1e-12)
        own = [line for line in kept if line["by"] == of["left"]]
        before, tied = (np.array([line[w][k] for line in own]) for w in ("before", "tied"))
        every_found = np.ones(len(own), bool)
        counted = ranking_metrics(before, tied, every_found, len(database), [1])
        assert counted["mrr"] == pytest.approx(sides[0]["mrr"]["value"])
    assert [of["width"] for of in first["differences"]] == CFG.widths
    assert (tmp_path / "one" / "retrieval.png").stat().st_size > 10_000
    text = (tmp_path / "one" / "report.txt").read_text()
    for builder in {q.builder for q in queries}:
        assert f"builder {builder} " in text

    # A second evaluation loads no model: there is none any more that could be loaded.
    (tmp_path / "run" / "retriever" / "config.json").unlink()
    (tmp_path / "run" / "untrained" / "config.json").unlink()
    assert world("two") == first

    # Other weights, precision or size of frames is another model's.
    edit_config(tmp_path / "run", train__precision="fp32")
    with pytest.raises(UserError, match="is damaged and cannot be read"):
        world("three")


def test_one_of_many_vectors_is_measured_by_late_interaction(
    world, tmp_path, micro, micro_store
) -> None:
    shutil.rmtree(tmp_path / "run")
    cfg = replace(CFG, late=LateConfig(width=24))
    save_run(cfg, tmp_path / "run", micro, micro_store)
    first = world()
    queries, database = micro_store.standard_test(), micro_store.database()
    frames = FrameReader(micro_store, 96)
    model = embedder.load_trained(cfg, "fp32", tmp_path / "run" / "retriever")
    asked = model.encode_query([embedder.query_input(q, frames, CFG) for q in queries])
    shown = model.encode_document([embedder.frame_input(f, frames) for f in database])
    gold = np.array([database.index(q.target) for q in queries])
    row = first["rows"][0]
    plain = matrix_metrics(model.similarity(asked, shown).numpy(), gold, [1])
    assert row["mrr"]["value"] == pytest.approx(plain["mrr"], rel=0.01)
    assert row["bytes"] == sum(v.numel() for v in shown) * 4
    names = dict.fromkeys((row["name"], row["width"]) for row in first["rows"])
    assert list(names) == [("run", 24), ("untrained small, late", 24)]
    assert "MiB" in (tmp_path / "one" / "report.txt").read_text()
    (tmp_path / "run" / "retriever" / "config.json").unlink()
    (tmp_path / "run" / "untrained" / "config.json").unlink()
    assert world("two") == first
    with raises_user_error("unsupported-index", contains="index=faiss"):
        world("three", index="faiss")


@pytest.mark.slow
def test_a_torn_cache_is_made_again_with_the_same_numbers(world, tmp_path, caplog) -> None:
    first = world()
    kept = tmp_path / "store" / "micro" / EMBEDDINGS
    part = min(kept.glob("query-*/00000.npy"))
    part.write_bytes(part.read_bytes()[:-9])
    assert world("two") == first
    assert "00000.npy is damaged" in caplog.text


def test_an_index_gives_its_recall_against_exact(world, tmp_path) -> None:
    found = world(index="faiss", probes=1000)
    assert [i["width"] for i in found["indexes"]] == [64, 32, 64, 32]
    assert all(i["recall@50"] > 0.9 for i in found["indexes"])
    assert found["rows"][0]["name"] == "run (faiss)"
    assert (
        "Approximate indexes compared with exact search"
        in (tmp_path / "one" / "report.txt").read_text()
    )


def test_a_width_that_the_model_lacks_is_refused(world, tmp_path) -> None:
    edit_config(tmp_path / "run", retriever__widths=[4096, 64, 32])
    with raises_user_error("too-wide", contains="retriever.widths=[64,32]"):
        world()


def test_a_batch_that_does_not_fit_is_told(world, monkeypatch) -> None:
    def full(*_: object) -> None:
        raise torch.OutOfMemoryError("CUDA out of memory")

    monkeypatch.setattr("evaluation.embedders.joint_encoder.JointEncoder.frames", full)
    with raises_user_error("out-of-memory", contains="batch"):
        world()


def test_another_pooling_is_refused(world, tmp_path) -> None:
    config = tmp_path / "run" / "retriever" / "1_Pooling" / "config.json"
    config.write_text(json.dumps({**json.loads(config.read_text()), "pooling_mode": "mean"}))
    with raises_user_error("unsupported-model", contains="mean pooling"):
        world()
    modules = tmp_path / "run" / "retriever" / "modules.json"
    modules.write_text(json.dumps(json.loads(modules.read_text())[:1]))
    with raises_user_error("unsupported-model", contains="without pooling"):
        world()
    modules.write_text("[")
    with pytest.raises(UserError, match="retriever is damaged"):
        world()


def test_broken_weights_are_told_by_a_query_that_shows_them(world, tmp_path, micro_store) -> None:
    path = tmp_path / "run" / "retriever" / "model.safetensors"
    weights = load_file(path)
    name = next(k for k in weights if k.endswith("language_model.norm.weight"))
    weights[name][3] = float("nan")
    save_file(weights, path, metadata={"format": "pt"})
    others = len(micro_store.standard_test()) - 1
    with raises_user_error("non-finite-embedding", contains=f"and {others} more"):
        world()


def test_a_kept_embedding_depends_on_what_is_shown(micro_store, saved, tmp_path) -> None:
    store = open_store(micro_store.folder)
    (embedder, untrained) = open_embedders(saved, CFG, "fp32", store, tmp_path)
    changes = [
        {},
        {"image_size": 64},
        {"frame_instruction": "Describe."},
    ]
    database = store.database()[:2]
    folders = set()
    for preset in [replace(CFG, **change) for change in changes]:
        again = replace(embedder, preset=preset)
        kept = embed_frames(again, database, store, FrameReader(store, preset.image_size), 2)
        assert kept.rows([f.name for f in database]).shape == (2, 64)
        folders.add(kept.folder)
    folders.add(embed_frames(untrained, database, store, FrameReader(store, 96), 2).folder)
    bf16 = replace(embedder, precision="bf16")
    folders.add(embed_frames(bf16, database, store, FrameReader(store, 96), 2).folder)
    assert len(folders) == 5
    # Neither the number of a query's frames nor its instruction changes a frame's embedding.
    asked = replace(embedder, preset=replace(CFG, frames=6, query_instruction="Find."))
    assert embed_frames(asked, database, store, FrameReader(store, 96), 2).folder in folders


@pytest.mark.parametrize(
    ("name", "another"),
    [
        ("config.json", False),
        ("tokenizer.json", True),
        ("tokenizer_config.json", True),
        ("processor_config.json", True),
        ("chat_template.jinja", True),
    ],
)
def test_one_with_an_edited_processor_is_another(
    micro_store, saved, tmp_path, name, another
) -> None:
    def keys() -> list[str]:
        pair = open_embedders(tmp_path / "run", CFG, "fp32", micro_store, tmp_path)
        return [json.dumps(embedder.settings(micro_store)) for embedder in pair]

    shutil.copytree(saved, tmp_path / "run")
    before = keys()
    for part in ("retriever", "untrained"):
        path = tmp_path / "run" / part / name
        path.write_text(path.read_text() + "\n")
    changed = [now != then for now, then in zip(keys(), before, strict=True)]
    assert changed == [another, another]


@pytest.mark.slow
def test_long_texts_pass_a_few_at_a_time_and_come_to_the_same(saved, micro_store, monkeypatch):
    texts = ["The red cube rests.", *("It moves on. " * k for k in (40, 3, 1, 20, 2))]
    (trained, _) = open_embedders(saved, CFG, "fp32", micro_store, saved)
    encoder = trained.load()
    whole, passed = encoder.texts(texts), []
    plain = encoder._encode
    monkeypatch.setattr(encoder, "_encode", lambda *a: passed.append(a[0]) or plain(*a))
    longest = max(map(len, encoder._model.tokenizer(texts)["input_ids"]))
    for pairs, parts in ((3 * longest**2, [3, 3]), (1, [1] * 6), (6 * longest**2, [6])):
        monkeypatch.setattr(joint_encoder, "MAX_TOKEN_PAIRS", pairs)
        passed.clear()
        np.testing.assert_allclose(encoder.texts(texts), whole, atol=1e-5)
        assert [len(some) for some in passed] == parts
