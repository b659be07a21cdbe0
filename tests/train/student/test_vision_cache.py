"""Features that are kept give what pixels give."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from conf.entry import Run
from conf.errors import UserError
from models.loading import load_student
from models.student.collator import Collator
from models.student.prompts import Clip, Sample, conversation, selection_sample
from train import sft
from train.common.journal import read_journal
from train.student.trainer import token_mean
from train.student.vision_cache import KEYS, Features, Keyed, keys_of

PLENTY = 1 << 40


@pytest.fixture
def student(nf4_cfg):
    cfg = replace(nf4_cfg, quantization="none")
    torch.manual_seed(0)
    return load_student(cfg, "fp32", list)


@pytest.fixture
def lines(micro_store, frames, student_cfg) -> list[Sample]:
    """Two items with clips, one without its clip, and the first again."""
    items = micro_store.selection("train")[:3]
    made = [
        selection_sample(i, "answer", "cot", frames, student_cfg, f"Answer: {i.letter}")
        for i in items
    ]
    made[2] = selection_sample(
        items[2], "answer", "cot", frames, student_cfg, "Answer: B", "candidate_only"
    )
    return [*made, made[0]]


def passed(model: nn.Module, collator: Keyed, lines: list[Sample], features: Features | None):
    """The loss of a batch, and the gradient of every adapter."""
    batch = collator(lines)
    batch.pop("sample_ids")
    labels = batch.pop("labels")
    if features is None:
        batch.pop(KEYS)
    else:
        features.give(batch)
        assert not {"pixel_values", "pixel_values_videos", KEYS} & batch.keys()
    model.zero_grad()
    loss = token_mean(model(**batch), labels)
    loss.backward()
    return loss.detach(), {
        n: p.grad.clone() for n, p in model.named_parameters() if p.requires_grad
    }


def same(one, two) -> None:
    torch.testing.assert_close(one[0], two[0], atol=1e-6, rtol=0)
    assert one[1].keys() == two[1].keys()
    for name, gradient in one[1].items():
        torch.testing.assert_close(gradient, two[1][name], atol=1e-6, rtol=0)


@pytest.mark.parametrize("share", [1.0, 0.5, 0.0])
def test_loss_and_gradients_are_those_of_the_pixels(student, lines, share) -> None:
    """Made, taken back, and where only a share of them has room."""
    model, processor = student
    # Adapters start at zero, where many gradients vanish.
    for name, weight in model.named_parameters():
        if "lora_B" in name:
            nn.init.normal_(weight, std=0.1)
    collator = Keyed(Collator(processor, 1500))
    whole = Features(model.get_base_model(), "fp32", PLENTY)
    plain = passed(model, collator, lines, None)
    assert max(g.abs().max() for g in plain[1].values()) > 1e-3
    same(passed(model, collator, lines, whole), plain)
    part = Features(model.get_base_model(), "fp32", int(share * whole.bytes))
    for batch in (lines, lines, lines[1:3], lines[2:3], lines[:1]):
        same(passed(model, collator, batch, part), passed(model, collator, batch, None))
    assert part.bytes <= share * whole.bytes
    assert share < 1 or part.bytes == whole.bytes


def test_what_is_kept_passes_the_tower_no_more(student, lines) -> None:
    model, processor = student
    collator = Keyed(Collator(processor, 1500))
    features = Features(model.get_base_model(), "fp32", PLENTY)
    seen = []
    model.get_base_model().model.visual.register_forward_pre_hook(
        lambda _, inputs: seen.append(len(inputs[0]))
    )
    passed(model, collator, lines[:2], features)
    slices = keys_of(lines[:2])
    # 96 px are six patches of 16 px.
    assert seen == [36 * len(set(slices))]
    passed(model, collator, [lines[1], lines[0]], features)
    assert len(seen) == 1


def test_keys_are_of_what_is_shown(micro_store, frames, student_cfg, processor) -> None:
    one, two, three = (frames.array(micro_store.scene_ids("train")[0], k) for k in (0, 40, 80))

    def shown(images, clip=()):
        clip = Clip(np.asarray(clip), list(range(len(clip)))) if len(clip) else None
        return keys_of([conversation("", images, None, clip)])

    assert len(set(shown([one, two, one]))) == 2
    assert shown([one]) == shown([one.copy()]) != shown([two])
    pairs = shown([], np.stack([one, two, two, one, three]))
    assert len(set(pairs)) == 3
    # An odd last frame is shown twice, as an image is.
    assert pairs[-1:] == shown([three])


def test_a_trained_tower_is_refused(model) -> None:
    with pytest.raises(UserError, match=r"train\.reuse_features=true: the vision tower is trained"):
        Features(model, "fp32", PLENTY)


@pytest.mark.slow
@pytest.mark.parametrize("workers", [0, 1])
def test_a_run_learns_the_same(few_steps, tmp_path, workers) -> None:
    """Over two epochs, evaluations included."""
    journals = []
    for reuse in (False, True):
        folder = tmp_path / str(reuse)
        folder.mkdir()
        settings = few_steps(
            regime="answer_only", batch=4, validation_items=4, workers=workers, reuse_features=reuse
        )
        sft.main.__wrapped__(settings, Run(str(reuse), folder))
        journals.append(read_journal(folder))
    for one, two in zip(*journals, strict=True):
        assert one == pytest.approx(two, rel=1e-4)
