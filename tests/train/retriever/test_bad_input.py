"""The retriever's trainer refuses unusable input before it trains, with errors that name it."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file, save_file
from sentence_transformers import SentenceTransformer
from sentence_transformers.sentence_transformer.modules import Dense, Pooling, Transformer

from dynapix.conf.entry import Run
from dynapix.conf.errors import UserError
from dynapix.conf.schema import ContrastiveCommand, LateConfig, LoraConfig
from dynapix.data import store
from dynapix.data.store import load_rows, save_rows, with_checksum
from dynapix.models.retriever.embedder import load_retriever
from dynapix.models.towers import check_parameter_counts, count_parameters
from dynapix.train import contrastive
from tests.families import save_family
from tests.saved_retrievers import sentence_encoder
from tests.user_errors import raises_user_error

Rows = list[dict]


def edited(folder: Path, root: Path, edit: Callable[[Rows], Rows]) -> str:
    """Copy a benchmark into `root`, edit its queries, and update its checksums; return `root`."""
    copy = root / folder.name
    shutil.copytree(folder, copy, ignore=shutil.ignore_patterns("embeddings"))
    path = copy / "retrieval.parquet"
    save_rows(edit(load_rows(path)), path)
    manifest = json.loads((copy / store.MANIFEST).read_text())
    manifest["files"] = store.hash_files(copy, manifest["files"])
    (copy / store.MANIFEST).write_text(json.dumps(with_checksum(manifest)))
    return str(root)


def assert_refused(
    settings: ContrastiveCommand, folder: Path, *parts: str, code: str | None = None
) -> None:
    """Require the trainer to raise a UserError with this code and these parts in its message, and
    to save no retriever."""
    folder.mkdir()
    with pytest.raises(UserError) as caught:
        contrastive.main.__wrapped__(settings, Run("run", folder))
    assert code in (None, caught.value.code)
    assert all(part in str(caught.value) for part in parts), caught.value
    assert {p.name for p in folder.iterdir()} <= {"untrained", "resolved.yaml"}


def duplicated(rows: Rows) -> Rows:
    return [*rows, first_future(rows, "train")]


def first_future(rows: Rows, split: str) -> dict:
    return next(r for r in rows if r["split"] == split and r["pool"] == "future")


def about_test_scene(rows: Rows) -> Rows:
    first_future(rows, "train")["scene_id"] = first_future(rows, "test")["scene_id"]
    return rows


def with_test_frame_as_negative(rows: Rows) -> Rows:
    negative, *_ = first_future(rows, "train")["hard_negatives"]
    negative["scene_id"] = first_future(rows, "test")["scene_id"]
    return rows


def with_one_negative(rows: Rows) -> Rows:
    return [{**r, "hard_negatives": r["hard_negatives"][:1]} for r in rows]


@pytest.mark.parametrize(
    ("edit", "code", "name"),
    [
        (duplicated, "duplicate-record", "retrieval.parquet"),
        (about_test_scene, "split-leak", "train split"),
        (with_test_frame_as_negative, "split-leak", "train split"),
        (with_one_negative, "too-few-negatives", "train.hard_negatives=2"),
    ],
)
def test_unusable_queries_are_refused(
    contrastive_settings, micro_store, tmp_path, edit, code, name
) -> None:
    store_folder = edited(micro_store.folder, tmp_path / "store", edit)
    train = replace(contrastive_settings.train, hard_negatives=2)
    settings = replace(contrastive_settings, store=store_folder, train=train)
    assert_refused(settings, tmp_path / "run", name, code=code)


@pytest.mark.parametrize(
    ("group", "changes", "parts"),
    [
        ("train", {"batch": 4096}, ["train.batch=4096"]),
        ("retriever", {"widths": [4096, 64, 32]}, ["4096", "retriever.widths=[64,32]"]),
    ],
)
def test_settings_that_exceed_the_data_or_the_model_are_refused(
    contrastive_settings, tmp_path, group, changes, parts
) -> None:
    changed = replace(getattr(contrastive_settings, group), **changes)
    settings = replace(contrastive_settings, **{group: changed})
    assert_refused(settings, tmp_path / "run", *parts)


def test_contradictory_batch_settings_are_refused(contrastive_settings) -> None:
    train = contrastive_settings.train
    for change, name in (
        ({"batch": 1, "mini_batch": 1, "hard_negatives": 0}, "train.hard_negatives=0"),
        ({"mini_batch": 5}, "train.mini_batch=5"),
    ):
        (problem,) = replace(train, **change).check("train.")
        assert name in problem
    (problem,) = replace(contrastive_settings, train=replace(train, hard_negatives=3)).check()
    assert "train.hard_negatives=3" in problem


def train_adapters_over(settings: ContrastiveCommand, folder: Path | str) -> ContrastiveCommand:
    """Return settings that train adapters over a base, which is a folder or a hub model."""
    cfg = replace(settings.retriever, architecture=None, model=str(folder), lora=LoraConfig(rank=4))
    return replace(settings, retriever=cfg)


def test_a_multi_vector_base_with_modules_after_its_backbone_is_refused(
    contrastive_settings, saved_base, tmp_path
) -> None:
    saved = tmp_path / "saved"
    parts = [Transformer(saved_base), Pooling(64, pooling_mode="lasttoken"), Dense(64, 8)]
    SentenceTransformer(modules=parts).save_pretrained(str(saved), create_model_card=False)
    late = train_adapters_over(contrastive_settings, saved)
    late.retriever.late = LateConfig(width=8)
    assert_refused(late, tmp_path / "late", "Dense")


def test_a_multi_vector_base_of_another_family_is_refused(contrastive_settings, tmp_path) -> None:
    save_family("qwen2_5_vl", [], tmp_path / "base")
    late = train_adapters_over(contrastive_settings, tmp_path / "base")
    late.retriever.late = LateConfig(width=8)
    assert_refused(late, tmp_path / "run", "qwen2_5_vl", "retriever.late=null")


def test_a_model_that_reads_no_images_is_refused(contrastive_settings, tmp_path) -> None:
    encoder = sentence_encoder(tmp_path / "encoder")
    settings = train_adapters_over(contrastive_settings, encoder)
    assert_refused(settings, tmp_path / "run", "reads images", code="no-images")


def test_a_cached_hub_model_keeps_its_modules_and_names_its_commit(
    contrastive_settings, saved_base, tmp_path, monkeypatch
) -> None:
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    commit = "a1" * 20
    cached = tmp_path / "models--lab--embedder"
    parts = [Transformer(saved_base), Pooling(64, pooling_mode="mean"), Dense(64, 8)]
    model = SentenceTransformer(modules=parts, prompts={"query": "Find.", "document": ""})
    model.save_pretrained(str(cached / "snapshots" / commit), create_model_card=False)
    (cached / "refs").mkdir()
    (cached / "refs" / "main").write_text(commit)
    cfg = train_adapters_over(contrastive_settings, "lab/embedder").retriever
    cfg = replace(cfg, revision=commit, query_instruction=None, frame_instruction=None)
    loaded = load_retriever(cfg, "fp32", [], tmp_path)
    assert loaded[1].pooling_mode == "mean"
    assert torch.equal(loaded[2].linear.weight, model[2].linear.weight)
    assert loaded.prompts == {"query": "Find.", "document": ""}
    assert all("lora_" in name for name, p in loaded.named_parameters() if p.requires_grad)
    config = loaded[0].model.peft_config["default"]
    assert (config.base_model_name_or_path, config.revision) == ("lab/embedder", commit)
    check_parameter_counts(count_parameters(loaded), "small", "none", 4)


@pytest.mark.parametrize(
    "files",
    [
        ["processor_config.json", "tokenizer.json", "tokenizer_config.json"],
        ["model.safetensors"],
    ],
    ids=["processor", "weights"],
)
def test_files_of_another_model_are_refused(
    contrastive_settings, saved_base, tmp_path, files
) -> None:
    other = tmp_path / "other"
    save_family("qwen2_5_vl", [], other)
    for file in files:
        shutil.copy(Path(saved_base) / file, other)
    settings = train_adapters_over(contrastive_settings, other)
    assert_refused(settings, tmp_path / "run", str(other))


def test_non_finite_weights_end_the_run_before_its_first_step(
    contrastive_settings, saved_base, tmp_path
) -> None:
    """The evaluation before the first step raises an error that names a query."""
    base = tmp_path / "base"
    shutil.copytree(saved_base, base)
    weights = load_file(base / "model.safetensors")
    (name,) = (k for k in weights if k.endswith("language_model.norm.weight"))
    weights[name][3] = float("nan")
    save_file(weights, base / "model.safetensors", metadata={"format": "pt"})
    settings = train_adapters_over(contrastive_settings, base)
    folder = tmp_path / "run"
    folder.mkdir()
    with raises_user_error("non-finite-embedding", "query "):
        contrastive.main.__wrapped__(settings, Run("run", folder))
    assert not (folder / "retriever").exists()


def test_fsdp_is_refused(contrastive_settings, tmp_path, monkeypatch) -> None:
    monkeypatch.setenv("ACCELERATE_USE_FSDP", "true")
    assert_refused(contrastive_settings, tmp_path / "run", "FSDP")
