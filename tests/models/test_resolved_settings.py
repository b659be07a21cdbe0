"""A run keeps the precision, the base and the data that it started with."""

from __future__ import annotations

import shutil
from dataclasses import replace

import pytest
import torch
from safetensors.torch import load_file, save_file

from dynapix.conf.schema import RetrieverConfig, StudentConfig
from dynapix.models.fingerprints import model_id, pin_revisions
from dynapix.models.resolved_settings import (
    RESOLVED,
    check_base,
    data_digest,
    read_resolved,
    resolve_precision,
    resolve_run,
    with_resolved_commit,
)
from tests.user_errors import raises_user_error


@pytest.fixture
def base(saved_base, tmp_path) -> StudentConfig:
    """A student over a copy of the saved base."""
    shutil.copytree(saved_base, tmp_path / "base")
    return StudentConfig(name="own", model=str(tmp_path / "base"))


@pytest.fixture
def hub(tmp_path, monkeypatch):
    """Create an offline cache of lab/base with two commits; return the file that names the current
    commit."""
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_OFFLINE", True)
    monkeypatch.setattr("huggingface_hub.constants.HF_HUB_CACHE", str(tmp_path))
    cached = tmp_path / "models--lab--base"
    for commit in ("a" * 40, "b" * 40):
        (cached / "snapshots" / commit).mkdir(parents=True)
        (cached / "snapshots" / commit / "config.json").write_text("{}")
    (cached / "refs").mkdir()
    (cached / "refs" / "main").write_text("a" * 40)
    return cached / "refs" / "main"


@pytest.mark.parametrize(
    ("instructions", "expected"),
    [({"avx512_bf16": True, "avx2": True}, "bf16"), ({"amx_bf16": False, "avx2": True}, "fp32")],
)
def test_a_resumed_run_keeps_the_precision_that_the_cpu_had_instructions_for(
    base, tmp_path, monkeypatch, instructions, expected
) -> None:
    monkeypatch.setattr(torch.cuda, "is_available", lambda: False)
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: instructions)
    assert resolve_run(tmp_path, "auto", base, "x") == (expected, base)
    other = {"avx512_bf16": expected == "fp32"}
    monkeypatch.setattr(torch.cpu, "get_capabilities", lambda: other)
    assert resolve_precision("auto") != expected
    assert resolve_run(tmp_path, "auto", base, "x") == (expected, base)


def test_other_data_or_weights_are_refused(base, tmp_path) -> None:
    first = data_digest("store", ["a", "b"])
    assert first != data_digest("store", ["b", "a"]) != data_digest("other", ["a", "b"])
    resolve_run(tmp_path, "fp32", base, first)
    with raises_user_error("other-data", contains=str(tmp_path)):
        resolve_run(tmp_path, "fp32", base, data_digest("store", ["a"]))
    check_base(tmp_path, base)
    path = tmp_path / "base" / "model.safetensors"
    changed = {name: weight + 1e-3 for name, weight in load_file(path).items()}
    save_file(changed, path, metadata={"format": "pt"})
    for attempt in (check_base, lambda f, cfg: resolve_run(f, "fp32", cfg, first)):
        with raises_user_error("other-base", contains=base.model):
            attempt(tmp_path, base)


def test_a_run_keeps_the_commit_of_a_hub_base(tmp_path, hub) -> None:
    """The owner of a hub model may replace its weights under the same name."""
    cfg = RetrieverConfig(name="own", model="lab/base")
    _, first = resolve_run(tmp_path, "fp32", cfg, "x")
    assert model_id(first.model, first.revision) == f"lab/base@{'a' * 40}"
    hub.write_text("b" * 40)
    assert pin_revisions(cfg).revision == "b" * 40
    assert (
        resolve_run(tmp_path, "fp32", cfg, "x")[1] == first == with_resolved_commit(tmp_path, cfg)
    )
    # A revision in the preset takes precedence over the current commit.
    assert pin_revisions(replace(cfg, revision="a" * 40)) == first
    two = pin_revisions(replace(cfg, image_model="lab/base", image_revision="a" * 40))
    assert (two.revision, two.image_revision) == ("b" * 40, "a" * 40)
    other = replace(cfg, model="lab/other")
    assert with_resolved_commit(tmp_path, other) == other


def test_a_missing_base_does_not_change_the_resolved_values(base, tmp_path, hub) -> None:
    """The error for a missing base is raised when it is loaded."""
    folder, away = tmp_path / "run", tmp_path / "away"
    folder.mkdir()
    (tmp_path / "base").rename(away)
    resolve_run(folder, "fp32", base, "x")
    assert not (folder / RESOLVED).exists()
    away.rename(tmp_path / "base")
    resolve_run(folder, "fp32", base, "x")
    before = read_resolved(folder)
    (tmp_path / "base").rename(away)
    resolve_run(folder, "fp32", base, "x")
    assert read_resolved(folder) == before
    for content in ("[", "3", "precision: bf16"):
        (folder / RESOLVED).write_text(content)
        with raises_user_error("damaged-file", contains=RESOLVED):
            read_resolved(folder)
