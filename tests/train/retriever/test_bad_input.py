"""Mistakes in the retriever trainer's input are refused by name before anything is trained."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from contextlib import nullcontext
from dataclasses import replace
from pathlib import Path

import pytest
from safetensors.torch import load_file, save_file
from sentence_transformers import SentenceTransformer
from sentence_transformers.sentence_transformer.modules import Dense, Pooling, Transformer
from transformers import Qwen2VLConfig

from conf.entry import Run
from conf.errors import UserError
from conf.schema import ContrastiveCommand, LateConfig, LoraConfig
from data import store
from data.store import add_checksum, load_rows, save_rows
from models.retriever.checks import check_pooling
from tests.user_errors import raises_user_error
from train import contrastive

Rows = list[dict]


def edited(folder: Path, root: Path, edit: Callable[[Rows], Rows]) -> str:
    """A store of stores with a copy of a benchmark, sealed, whose queries are edited."""
    copy = root / folder.name
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("embeddings"))
    path = copy / "retrieval.parquet"
    save_rows(edit(load_rows(path)), path)
    manifest = json.loads((copy / store.MANIFEST).read_text())
    manifest["files"] = store.hash_files(copy)
    (copy / store.MANIFEST).write_text(json.dumps(add_checksum(manifest)))
    return str(root)


def refused(settings: ContrastiveCommand, folder: Path, said: str) -> None:
    """The trainer refuses with a message that matches, and saves no retriever."""
    folder.mkdir()
    with pytest.raises(UserError, match=said):
        contrastive.main.__wrapped__(settings, Run("run", folder))
    assert {p.name for p in folder.iterdir()} <= {"untrained", "resolved.yaml"}


def twice(rows: Rows) -> Rows:
    return [*rows, next(r for r in rows if r["split"] == "train" and r["pool"] == "future")]


def in_both(rows: Rows) -> Rows:
    tested = next(r["scene_id"] for r in rows if r["split"] == "test" and r["pool"] == "future")
    (row, *_) = (r for r in rows if r["split"] == "train" and r["pool"] == "future")
    return [{**r, "scene_id": tested} if r is row else r for r in rows]


def shown_wrong(rows: Rows) -> Rows:
    """A scene of the test split is one of the wrong frames."""
    tested = next(r["scene_id"] for r in rows if r["split"] == "test" and r["pool"] == "future")
    (row, *_) = (r for r in rows if r["split"] == "train" and r["pool"] == "future")
    wrong = [{**row["hard_negatives"][0], "scene_id": tested}, *row["hard_negatives"][1:]]
    return [{**r, "hard_negatives": wrong} if r is row else r for r in rows]


def poor(rows: Rows) -> Rows:
    return [{**r, "hard_negatives": r["hard_negatives"][:1]} for r in rows]


@pytest.mark.parametrize(
    ("edit", "said"),
    [
        (twice, r"retrieval\.parquet has query \S+ more than once"),
        (in_both, r"training query \S+ refers to scene \S+ of the test split"),
        (shown_wrong, r"training query \S+ refers to scene \S+ of the test split"),
        (poor, r"train\.hard_negatives=2, but query"),
    ],
)
def test_queries_that_cannot_be_trained_on(
    contrastive_settings, micro_store, tmp_path, edit, said
) -> None:
    there = edited(micro_store.folder, tmp_path / "store", edit)
    train = replace(contrastive_settings.train, hard_negatives=2)
    settings = replace(contrastive_settings, store=there, train=train)
    refused(settings, tmp_path / "run", said)


def test_a_width_that_the_model_lacks(contrastive_settings, tmp_path) -> None:
    wide = replace(contrastive_settings.retriever, widths=[4096, 64, 32])
    said = r"asks for 4096, .* small have 64 entries: give retriever\.widths=\[64,32\]"
    refused(replace(contrastive_settings, retriever=wide), tmp_path / "run", said)


def test_a_batch_that_is_too_small_for_what_it_needs(contrastive_settings) -> None:
    train = contrastive_settings.train
    for change, said in (
        ({"batch": 1, "mini_batch": 1, "hard_negatives": 0}, "train.hard_negatives=0"),
        ({"mini_batch": 5}, "train.mini_batch=5"),
        ({"mine_every": 2, "hard_negatives": 0}, "train.mine_every=2"),
    ):
        (problem,) = replace(train, **change).check()
        assert said in problem
    (problem,) = replace(contrastive_settings, train=replace(train, hard_negatives=3)).check()
    assert "train.hard_negatives=3 is more than benchmark.retrieval.hard_negatives=2" in problem


def over(settings: ContrastiveCommand, folder: Path | str) -> ContrastiveCommand:
    """Settings of adapters over the base in a folder, or of the hub."""
    cfg = replace(settings.retriever, architecture=None, model=str(folder), lora=LoraConfig(rank=4))
    return replace(settings, retriever=cfg)


@pytest.mark.parametrize(("mode", "said"), [("mean", "with mean pooling"), (None, "without")])
def test_a_base_that_was_saved_by_another_pooling(
    contrastive_settings, saved_base, tmp_path, mode, said
) -> None:
    saved = tmp_path / "saved"
    whole = SentenceTransformer(modules=[Transformer(saved_base), Pooling(64, pooling_mode="mean")])
    whole.save_pretrained(str(saved), create_model_card=False)
    if mode is None:
        kinds = json.loads((saved / "modules.json").read_text())[:1]
        (saved / "modules.json").write_text(json.dumps(kinds))
    refused(over(contrastive_settings, saved), tmp_path / "run", rf"saved {said}.* last token")


def test_a_base_whose_last_modules_would_be_lost(
    contrastive_settings, saved_base, tmp_path
) -> None:
    saved = tmp_path / "saved"
    parts = [Transformer(saved_base), Pooling(64, pooling_mode="lasttoken"), Dense(64, 8)]
    SentenceTransformer(modules=parts).save_pretrained(str(saved), create_model_card=False)
    said = r"after its backbone .* would lose \(Dense\): give a base"
    refused(over(contrastive_settings, saved), tmp_path / "run", said)
    late = over(contrastive_settings, saved)
    late.retriever.late = LateConfig(width=8)
    refused(late, tmp_path / "late", said)


@pytest.mark.parametrize(
    ("on", "told"),
    [
        (["lasttoken"], nullcontext()),
        (["mean_tokens"], pytest.raises(UserError, match="saved with mean_tokens pooling")),
        (
            ["cls_token", "lasttoken"],
            pytest.raises(UserError, match="saved with cls_token and lasttoken pooling"),
        ),
    ],
)
def test_pooling_as_earlier_versions_saved_it(saved_base, tmp_path, on, told) -> None:
    saved = tmp_path / "saved"
    whole = SentenceTransformer(modules=[Transformer(saved_base), Pooling(64, pooling_mode="mean")])
    whole.save_pretrained(str(saved), create_model_card=False)
    names = ("cls_token", "lasttoken", "max_tokens", "mean_tokens")
    flags = {f"pooling_mode_{name}": name in on for name in names}
    config = {"word_embedding_dimension": 64, **flags, "include_prompt": True}
    (saved / "1_Pooling" / "config.json").write_text(json.dumps(config))
    with told:
        check_pooling(saved)


def test_a_base_of_the_hubs_cache_with_another_pooling(
    contrastive_settings, saved_base, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    commit = "a1" * 20
    cached = tmp_path / "models--lab--embedder"
    whole = SentenceTransformer(modules=[Transformer(saved_base), Pooling(64, pooling_mode="mean")])
    whole.save_pretrained(str(cached / "snapshots" / commit), create_model_card=False)
    (cached / "refs").mkdir()
    (cached / "refs" / "main").write_text(commit)
    cfg = over(contrastive_settings, "lab/embedder")
    refused(cfg, tmp_path / "run", r"lab/embedder was saved with mean pooling.* last token")


def test_a_base_of_another_family(contrastive_settings, saved_base, tmp_path) -> None:
    other = tmp_path / "other"
    shutil.copytree(saved_base, other)
    Qwen2VLConfig().save_pretrained(other)
    said = r"other is a qwen2_vl; retriever\.encoder=qwen3_vl reads and trains Qwen3-VL"
    refused(over(contrastive_settings, other), tmp_path / "run", said)


def test_non_finite_weights(contrastive_settings, saved_base, tmp_path) -> None:
    """Refused by the evaluation before the first step, which names a query."""
    base = tmp_path / "base"
    shutil.copytree(saved_base, base)
    weights = load_file(base / "model.safetensors")
    (name,) = (k for k in weights if k.endswith("language_model.norm.weight"))
    weights[name][3] = float("nan")
    save_file(weights, base / "model.safetensors", metadata={"format": "pt"})
    settings = over(contrastive_settings, base)
    folder = tmp_path / "run"
    folder.mkdir()
    with raises_user_error("non-finite-embedding", "query "):
        contrastive.main.__wrapped__(settings, Run("run", folder))
    assert not (folder / "retriever").exists()


def test_sharding_is_refused(contrastive_settings, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("ACCELERATE_USE_FSDP", "true")
    refused(contrastive_settings, tmp_path / "run", "FSDP does not shard a retriever: .* leave")
