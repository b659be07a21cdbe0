"""The stages of the tiny base: they resume exactly, and end with a base that can be loaded."""

from __future__ import annotations

import json
from dataclasses import replace
from functools import partial
from pathlib import Path

import pytest
import torch
from transformers import set_seed

from dynapix.conf.compose import compose
from dynapix.conf.errors import SettingsError
from dynapix.conf.runs import Run
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.store import Store
from dynapix.models import loading
from dynapix.train.common.held_out import held_out_scenes
from research.base import main
from research.tiny_base.samples import ItemSampler, split_items, tokenizer_corpus
from research.tiny_base.settings import StageConfig, TinyBaseCommand, TinyBaseTrainConfig
from research.tiny_base.training import (
    CHECKPOINT,
    TinyBaseTrainer,
    build_trainer,
    learning_rate_factor,
)
from tests.tiny_models import SMALL
from tests.user_errors import raises_user_error

pytestmark = pytest.mark.slow

SIZES = replace(SMALL, layers=7, heads=6, kv_heads=6)
STAGE = StageConfig(steps=4, batch=2, lr=1e-3)


@pytest.fixture
def cfg(micro, micro_store: Store, student_cfg) -> TinyBaseCommand:
    train = TinyBaseTrainConfig(
        vision=STAGE, motion=STAGE, words=replace(STAGE, steps=8), precision="fp32",
        evaluations=2, checkpoint_steps=3, validation_items=4, log_steps=1,
    )  # fmt: skip
    student = replace(student_cfg, architecture=SIZES, frames=4)
    return TinyBaseCommand(
        benchmark=micro, student=student, train=train, store=str(micro_store.folder.parent)
    )


def start(cfg: TinyBaseCommand, store: Store, folder: Path) -> TinyBaseTrainer:
    """Return the trainer of a run, with the same initial weights for the same settings."""
    folder.mkdir(exist_ok=True)
    frames = FrameReader(store, cfg.student.image_size)
    training, held_out = split_items(store, frames)
    set_seed(cfg.seed)
    sampler = ItemSampler(training, frames, cfg.student.frames, cfg.seed)
    corpus = partial(tokenizer_corpus, sampler)
    model, processor = loading.load_base(cfg.student, "fp32", corpus)
    measured = held_out[: cfg.train.validation_items]
    return build_trainer(cfg, Run("test", folder), model, processor, sampler, measured)


@pytest.mark.parametrize("stopped_after", [6, 13])
def test_killed_run_resumes_as_if_it_had_never_stopped(
    cfg: TinyBaseCommand,
    micro_store: Store,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    stopped_after: int,
) -> None:
    whole = start(cfg, micro_store, tmp_path / "whole")
    whole.run()
    killed, steps = start(cfg, micro_store, tmp_path / "killed"), []
    train_step = killed._train_step

    def stop(*args: object) -> dict[str, float]:
        if len(steps) == stopped_after:
            raise KeyboardInterrupt
        steps.append(args)
        return train_step(*args)

    monkeypatch.setattr(killed, "_train_step", stop)
    with pytest.raises(KeyboardInterrupt):
        killed.run()
    resumed = start(cfg, micro_store, tmp_path / "killed")
    resumed.run()
    for name, weight in whole.model.state_dict().items():
        torch.testing.assert_close(resumed.model.state_dict()[name], weight, rtol=0, atol=0)
    journals = [(tmp_path / name / "metrics.jsonl").read_text() for name in ("whole", "killed")]
    assert journals[0] == journals[1]
    records = [json.loads(line) for line in journals[0].splitlines()]
    assert [r["step"] for r in records] == [*range(1, 17)]
    assert {r["stage"] for r in records} == {"vision", "motion", "words"}


def test_checkpoints_of_another_tokenizer_are_refused(cfg, micro_store: Store, tmp_path) -> None:
    """The checkpoint precedes the first line of the log."""
    trainer = start(cfg, micro_store, tmp_path)
    trainer.optimizers = trainer._new_optimizers()
    trainer._load()
    trainer._save()
    other = replace(cfg.student, architecture=replace(SIZES, vocabulary=400))
    with raises_user_error("other-recipe", contains=str(tmp_path)):
        start(replace(cfg, student=other), micro_store, tmp_path).run()


def test_eyes_train_the_vision_tower_alone(cfg, micro_store: Store, tmp_path: Path) -> None:
    trainer = start(cfg, micro_store, tmp_path / "run")
    trainer.optimizers = trainer._new_optimizers()
    before = {name: w.clone() for name, w in trainer.model.state_dict().items()}
    trainer._train_step("vision", STAGE)
    changed = {n for n, w in trainer.model.state_dict().items() if not torch.equal(w, before[n])}
    assert changed
    # The words of objects are trained too: their embeddings are the targets.
    tied = {"model.language_model.embed_tokens.weight", "lm_head.weight"}
    assert all(".visual." in name or name in tied for name in changed)


def test_command_saves_a_base_that_can_be_loaded(cfg, tmp_path: Path) -> None:
    run = Run("test", tmp_path / "run")
    run.folder.mkdir()
    metrics = main.__wrapped__(cfg, run)
    assert 0 <= metrics["color"] <= 1
    assert metrics["ahead_25_still"] > 0
    assert metrics["name_future_still/predict"] > 0
    student = replace(cfg.student, architecture=None, model=str(run.folder / "student"))
    model, processor = loading.load_base(student, "bf16", list)
    assert {p.dtype for p in model.parameters()} <= {torch.float32, torch.bfloat16}
    assert processor.image_processor.patch_size == cfg.student.architecture.patch
    assert (run.folder / CHECKPOINT).exists()


def test_no_held_out_scene_is_trained_on(micro_store: Store, frames: FrameReader) -> None:
    training, held_out = split_items(micro_store, frames)
    scenes = held_out_scenes(micro_store)
    assert {item.scene_id for item in held_out} <= scenes
    assert not scenes & {c.scene_id for item in training for c in item.candidates}


@pytest.mark.parametrize(
    ("override", "message"),
    [
        ("student.architecture.layers=6", "needs 7 layers with 6 heads or more"),
        ("student.architecture.heads=5", "needs 7 layers with 6 heads or more"),
        ("student.architecture=null", "a base is trained from random weights"),
    ],
)
def test_unsuitable_models_are_refused(override: str, message: str) -> None:
    with pytest.raises(SettingsError, match=message):
        compose("research.base", TinyBaseCommand, [override])


def test_schedule_warms_up_and_decays() -> None:
    rates = [learning_rate_factor(step, 1000) for step in range(1000)]
    assert rates[0] < 0.05
    assert max(rates) == pytest.approx(1, abs=0.01)
    assert rates[-1] == pytest.approx(0.05, abs=0.001)
    assert rates[100:] == sorted(rates[100:], reverse=True)
