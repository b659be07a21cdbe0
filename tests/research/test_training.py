"""The stages of the tiny base: they resume exactly, and end with a base that can be loaded."""

from __future__ import annotations

import json
import os
import sys
from dataclasses import replace
from pathlib import Path

import pytest
import torch

from dynapix.conf.compose import compose
from dynapix.conf.errors import SettingsError
from dynapix.conf.runs import Run
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.store import Store
from dynapix.models import loading
from dynapix.train.common.held_out import held_out_scenes
from research.base import main
from research.tiny_base.samples import split_items
from research.tiny_base.settings import StageConfig, TinyBaseCommand, TinyBaseTrainConfig
from research.tiny_base.training import CHECKPOINT, TinyBaseTrainer
from tests.children import run_child
from tests.tiny_models import SMALL
from tests.user_errors import raises_user_error

ROOT = Path(__file__).parents[2]
SIZES = replace(SMALL, layers=7, heads=6, kv_heads=6)
STAGE = StageConfig(steps=2, batch=2, lr=1e-3)


@pytest.fixture
def cfg(micro, micro_store: Store, student_cfg) -> TinyBaseCommand:
    train = TinyBaseTrainConfig(
        vision=STAGE, motion=STAGE, words=replace(STAGE, steps=4), precision="fp32",
        evaluations=1, checkpoint_steps=2, validation_items=2, log_steps=1,
    )  # fmt: skip
    student = replace(student_cfg, architecture=SIZES, frames=4, max_new_tokens=8)
    return TinyBaseCommand(
        benchmark=micro, student=student, train=train, store=str(micro_store.folder.parent)
    )


@pytest.mark.slow
def test_a_killed_run_resumes_and_saves_a_base_that_can_be_loaded(
    cfg: TinyBaseCommand, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    runs = [Run("test", tmp_path / name) for name in ("whole", "killed")]
    for run in runs:
        run.folder.mkdir()
    metrics, steps = main.__wrapped__(cfg, runs[0]), []
    train_step = TinyBaseTrainer._train_step

    def stop(*args: object) -> dict[str, float]:
        # The last checkpoint is that of the second step of the last stage.
        if len(steps) == 7:
            raise KeyboardInterrupt
        steps.append(args)
        return train_step(*args)

    with monkeypatch.context() as patch:
        patch.setattr(TinyBaseTrainer, "_train_step", stop)
        with pytest.raises(KeyboardInterrupt):
            main.__wrapped__(cfg, runs[1])
    other = replace(cfg.student, architecture=replace(SIZES, vocabulary=400))
    with raises_user_error("other-recipe", contains=str(runs[1].folder)):
        main.__wrapped__(replace(cfg, student=other), runs[1])
    assert main.__wrapped__(cfg, runs[1]) == metrics
    whole, resumed = (torch.load(run.folder / CHECKPOINT, weights_only=True) for run in runs)
    for part in ("model", "heads"):
        assert resumed[part].keys() == whole[part].keys()
        for name, weight in whole[part].items():
            torch.testing.assert_close(resumed[part][name], weight, rtol=0, atol=0)
    journals = [(run.folder / "metrics.jsonl").read_text() for run in runs]
    assert journals[0] == journals[1]
    records = [json.loads(line) for line in journals[0].splitlines()]
    assert [r["step"] for r in records] == [*range(1, 9)]
    assert {r["stage"] for r in records} == {"vision", "motion", "words"}
    assert 0 <= metrics["color"] <= 1
    assert metrics["ahead_25_still"] > 0
    assert metrics.keys() >= {"words_color/parse", "words_choice/compare"}

    folder = str(runs[0].folder / "student")
    student = replace(cfg.student, architecture=None, model=folder)
    model, processor = loading.load_base(student, "bf16", list)
    assert {p.dtype for p in model.parameters()} <= {torch.float32, torch.bfloat16}
    assert processor.image_processor.patch_size == cfg.student.architecture.patch


def test_no_held_out_scene_is_trained_on(micro_store: Store, frames: FrameReader) -> None:
    training, held_out = split_items(micro_store, frames)
    scenes = held_out_scenes(micro_store)
    assert {item.scene_id for item in held_out} <= scenes
    assert not scenes & {c.scene_id for item in training for c in item.candidates}


def test_unsuitable_models_are_refused() -> None:
    for override, message in (
        ("student.architecture.layers=6", "needs 7 layers with 6 heads or more"),
        ("student.architecture=null", "a base is trained from random weights"),
    ):
        with pytest.raises(SettingsError, match=message):
            compose("research.base", TinyBaseCommand, [override])


AVERAGE = """
import torch
from dynapix.conf.runs import rank
from dynapix.models.distributed import end_ranks
from research.tiny_base.training import average_gradients

gradients = [[[2.0, 4.0], None, None], [[4.0, 8.0], [1.0, 3.0], None]][rank()]
parameters = [torch.nn.Parameter(torch.zeros(2)) for _ in gradients]
for parameter, gradient in zip(parameters, gradients):
    parameter.grad = None if gradient is None else torch.tensor(gradient)
average_gradients(parameters)
print([None if p.grad is None else p.grad.tolist() for p in parameters], flush=True)
end_ranks()
"""


def test_ranks_average_their_gradients(tmp_path: Path) -> None:
    """A gradient that one of two ranks lacks counts as 0; one that both lack stays None."""
    script = tmp_path / "average.py"
    script.write_text(AVERAGE)
    launcher = Path(sys.executable).with_name("torchrun")
    environment = {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    ended = run_child(
        [launcher, "--standalone", "--nproc-per-node=2", script],
        cwd=ROOT,
        env={**os.environ, **environment},
    )
    assert ended.returncode == 0, ended.stderr
    # The ranks can write into the same line.
    assert ended.stdout.count("[[3.0, 6.0], [0.5, 1.5], None]") == 2, ended.stdout
