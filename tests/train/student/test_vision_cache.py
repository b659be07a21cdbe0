"""With cached features of the vision tower, the loss and gradients equal those with pixels."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import nn

from dynapix.conf.entry import Run
from dynapix.models.loading import load_student
from dynapix.models.student.collator import Collator
from dynapix.models.student.prompts import Clip, Sample, build_sample, selection_sample
from dynapix.train import sft
from dynapix.train.common.journal import read_journal
from dynapix.train.student.trainer import TrainerCollator, token_mean
from dynapix.train.student.vision_cache import PAIRS, VisionCache, pair_digests
from tests.tiny_models import randomize_adapters
from tests.user_errors import raises_user_error

PLENTY = 1 << 40
"""A limit in bytes that no test reaches."""


@pytest.fixture
def student(nf4_cfg):
    cfg = replace(nf4_cfg, quantization="none")
    torch.manual_seed(0)
    return load_student(cfg, "fp32", list)


@pytest.fixture
def samples(micro_store, frames, student_cfg) -> list[Sample]:
    """Two samples with clips, one without a clip, and the first sample again."""
    items = micro_store.selection("train")[:3]
    samples = [
        selection_sample(i, "answer", "cot", frames, student_cfg.frames, f"Answer: {i.letter}")
        for i in items
    ]
    samples[2] = selection_sample(
        items[2], "answer", "cot", frames, student_cfg.frames, "Answer: B", "candidate_only"
    )
    return [*samples, samples[0]]


def loss_and_gradients(
    model: nn.Module, collator: TrainerCollator, samples: list[Sample], cache: VisionCache | None
):
    """The loss of a batch, and the gradient of every adapter."""
    batch = collator(samples)
    batch.pop("sample_ids")
    labels = batch.pop("labels")
    if cache is None:
        batch.pop(PAIRS)
    else:
        cache.encode_media(batch)
        assert not {"pixel_values", "pixel_values_videos", PAIRS} & batch.keys()
    model.zero_grad()
    loss = token_mean(model(**batch), labels)
    loss.backward()
    return loss.detach(), {
        n: p.grad.clone() for n, p in model.named_parameters() if p.requires_grad
    }


@pytest.mark.parametrize("share", [1.0, 0.5, 0.0])
def test_loss_and_gradients_are_those_of_the_pixels(student, samples, share) -> None:
    """This also holds if the cache has room for only a share of the features."""
    model, processor = student
    # If B is zero, as it is at first, many gradients vanish.
    randomize_adapters(model, 0.1)
    collator = TrainerCollator(Collator(processor, 1500), digests=True)
    whole = VisionCache(model, "fp32", PLENTY)
    plain = loss_and_gradients(model, collator, samples, None)
    assert max(g.abs().max() for g in plain[1].values()) > 1e-3
    close = {"atol": 1e-6, "rtol": 0}
    torch.testing.assert_close(loss_and_gradients(model, collator, samples, whole), plain, **close)
    part = VisionCache(model, "fp32", int(share * whole.bytes))
    for batch in (samples, samples, samples[1:3], samples[2:3], samples[:1]):
        torch.testing.assert_close(
            loss_and_gradients(model, collator, batch, part),
            loss_and_gradients(model, collator, batch, None),
            **close,
        )
    assert part.bytes <= share * whole.bytes
    assert share < 1 or part.bytes == whole.bytes


def test_cached_pairs_do_not_pass_the_tower(student, samples) -> None:
    model, processor = student
    collator = TrainerCollator(Collator(processor, 1500), digests=True)
    cache = VisionCache(model, "fp32", PLENTY)
    seen = []
    model.get_base_model().model.visual.register_forward_pre_hook(
        lambda _, inputs: seen.append(len(inputs[0]))
    )
    loss_and_gradients(model, collator, samples[:2], cache)
    pairs = pair_digests(samples[:2])
    # 96 px are six patches of 16 px.
    assert seen == [36 * len(set(pairs))]
    loss_and_gradients(model, collator, [samples[1], samples[0]], cache)
    assert len(seen) == 1


def test_digests_depend_on_the_pixels_only(micro_store, frames, student_cfg, processor) -> None:
    one, two, three = (frames.array(micro_store.scene_ids("train")[0], k) for k in (0, 40, 80))

    def digests(images, clip=()):
        clip = Clip(np.asarray(clip), list(range(len(clip)))) if len(clip) else None
        return pair_digests([build_sample("", images, None, clip)])

    assert len(set(digests([one, two, one]))) == 2
    assert digests([one]) == digests([one.copy()]) != digests([two])
    pairs = digests([], np.stack([one, two, two, one, three]))
    assert len(set(pairs)) == 3
    # The last of an odd number of frames is paired with itself, as an image is.
    assert pairs[-1:] == digests([three])


def test_a_trained_tower_is_refused(model) -> None:
    with raises_user_error("vision-tower-trained"):
        VisionCache(model, "fp32", PLENTY)


@pytest.mark.slow
def test_a_run_with_the_cache_is_the_same(few_steps, tmp_path) -> None:
    """The runs take two epochs, with evaluations."""
    journals = []
    for reuse in (False, True):
        folder = tmp_path / str(reuse)
        folder.mkdir()
        settings = few_steps(
            regime="answer_only", batch=4, validation_items=4, workers=1, reuse_features=reuse
        )
        sft.main.__wrapped__(settings, Run(str(reuse), folder))
        journals.append(read_journal(folder))
    for one, two in zip(*journals, strict=True):
        assert one == pytest.approx(two, rel=1e-4)
