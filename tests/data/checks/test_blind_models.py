"""Blind models: what they can find, what they cannot, and what they see."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from PIL import Image

from dynapix.data.checks import blind_models
from dynapix.data.checks.blind_models import (
    BlindModel,
    encode_items,
    is_right,
    score_blind_models,
    train_model,
)
from dynapix.data.checks.statistics import measure_shortcuts
from dynapix.data.frames.frame_cache import render_frames
from dynapix.data.items.scores import SCORES
from dynapix.data.store import Store
from tests.user_errors import raises_user_error


def random_features(count: int) -> tuple[torch.Tensor, torch.Tensor]:
    """Candidates with 4 tokens of 12 random features, and random answers."""
    generator = torch.Generator().manual_seed(0)
    features = torch.randn(count, 4, 4, 12, generator=generator)
    return features, torch.randint(4, (count,), generator=generator)


def test_scores_do_not_depend_on_the_order_of_the_candidates() -> None:
    model = BlindModel(tokens=4, features=12).eval()
    features, _ = random_features(5)
    order = [2, 0, 3, 1]
    torch.testing.assert_close(model(features[:, order]), model(features)[:, order])


def test_blind_model_finds_a_shortcut_and_nothing_without_one(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    monkeypatch.setattr(blind_models, "EPOCHS", 6)
    features, answers = random_features(900)
    nothing = train_model("nothing", features[:600], answers[:600], seed=0)
    assert is_right(nothing, features[600:], answers[600:]).mean() < 0.33
    # The target alone differs from the others in one feature, whose value varies from item to item.
    generator = torch.Generator().manual_seed(1)
    features[..., 0] = features[:, :1, :1, 0]
    signs = torch.randn(len(features), 1, generator=generator).sign()
    features[torch.arange(len(features)), answers, :, 0] += 4 * signs
    odd = train_model("odd", features[:600], answers[:600], seed=0)
    assert is_right(odd, features[600:], answers[600:]).mean() > 0.6


@pytest.mark.slow
def test_features_are_those_of_the_last_frame_and_of_the_candidates(micro_store: Store) -> None:
    items = micro_store.selection()[:2]
    last, candidates = encode_items(items, micro_store)
    encode = blind_models._load_encoder()
    for k, item in enumerate(items):
        frames = [(item.scene_id, item.prefix_stop)]
        frames += [(c.scene_id, c.frame) for c in item.candidates]
        images = []
        for scene_id, frame in frames:
            scene = micro_store.scene(scene_id)
            pixels = render_frames(scene, [frame], micro_store.manifest["config"])[frame]
            images.append(Image.fromarray(pixels).resize((128, 128), Image.Resampling.BICUBIC))
        expected = encode(images).float()
        found = torch.cat([last[k : k + 1], candidates[k]]).float()
        torch.testing.assert_close(found, expected, atol=0.02, rtol=0.02)


@pytest.mark.slow
def test_statistics_report_blind_models(
    micro_store: Store, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(blind_models, "EPOCHS", 2)
    items = micro_store.selection()
    items = [i for split in ("train", "test") for i in [i for i in items if i.split == split][:8]]
    scores = np.zeros((len(items), len(SCORES), 4))
    table = measure_shortcuts(items, scores, micro_store, blind=True)
    first = score_blind_models(items, micro_store, seed=0)
    families = [*{item.family for item in items if item.split == "test"}]
    for name, right in first.items():
        assert np.isnan(right).tolist() == [item.split == "train" for item in items]
        counted = (table[name] * table["items"])[families].sum()
        assert counted == pytest.approx(np.nansum(right))


def test_split_without_items_is_refused(micro_store: Store) -> None:
    items = [item for item in micro_store.selection() if item.split == "test"]
    with raises_user_error("empty-split", contains="both splits"):
        score_blind_models(items, micro_store, seed=0)
