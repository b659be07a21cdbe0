"""Object tokens: the labels of visual tokens that show objects, and the loss on them."""

from __future__ import annotations

import math

import numpy as np
import pytest
import torch

from models.student.collator import Collator
from train.tiny_base import questions
from train.tiny_base.object_tokens import (
    MAX_WORDS,
    NO_WORD,
    ObjectTokenCollator,
    first_token,
    object_token_loss,
)


def test_words_are_labels_of_the_tokens_at_their_objects(
    micro_store, frames, student_cfg, processor
) -> None:
    items = micro_store.selection("train")
    kinds = questions.build_questions(micro_store, items, student_cfg.frames, frames, 0)
    samples = [questions_of_kind[0].render(0) for questions_of_kind in kinds.values()]
    batch = ObjectTokenCollator(processor, 1500)(samples)
    plain = Collator(processor, 1500)(samples)
    assert torch.equal(batch["input_ids"], plain["input_ids"])
    kept = plain["labels"].shape[1]
    assert torch.equal(batch["labels"][:, -kept:], plain["labels"])
    side = student_cfg.image_size // 32
    visual = (processor.image_token_id, processor.video_token_id)
    expected = []
    for row, sample in enumerate(samples):
        at = [k for k, t in enumerate(batch["input_ids"][row].tolist()) if t in visual]
        cells = np.reshape(at, (sample.pictures, side, side))
        for label in sample.object_labels:
            x, y = (min(math.floor(share * side), side - 1) for share in label.place)
            words = [first_token(processor, word) for word in label.words]
            filled = [*words, *[NO_WORD] * (MAX_WORDS - len(words))]
            expected.append([row, int(cells[label.picture, y, x]), *filled])
            if len(words) == MAX_WORDS and sample.clip is None:
                before = sample.content[2 * label.picture]["text"]
                assert before == f"\nCandidate {label.words[-1]}: "
    assert batch["object_labels"].tolist() == expected
    assert {row for row, *_ in expected} == set(range(len(samples)))


def test_visible_objects_are_described(micro_store) -> None:
    scene = micro_store.scene(micro_store.scene_ids("train")[0])
    for frame in (0, scene.frames - 1):
        words = {words for _, _, words in questions.visible_objects(scene, frame)}
        description = questions.describe_frame(scene, frame)
        assert words
        assert all(f"The {' '.join(w)} is near" in description for w in words)


def test_loss_is_minimal_for_equal_probabilities() -> None:
    """The minimum is the entropy of three equally likely words. Padding does not count."""
    object_labels = torch.tensor([[0, 1, 4, 5, 6, NO_WORD]])
    even = torch.full((1, 3, 10), -torch.inf)
    even[0, 1, [4, 5, 6]] = 0.0
    assert object_token_loss(even, object_labels).item() == pytest.approx(math.log(3))
    tilted = even.clone()
    tilted[0, 1, 4] = 1.0
    assert object_token_loss(tilted, object_labels).item() > math.log(3)
    elsewhere = torch.zeros(1, 3, 10)
    assert object_token_loss(elsewhere, object_labels.repeat(2, 1)).item() == pytest.approx(
        2 * math.log(10)
    )
