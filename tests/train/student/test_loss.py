"""Laws of what is supervised and how it is averaged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from transformers import EvalPrediction

from data.records import FPS, SelectionItem, sample_prefix_frames
from models.student.collator import IGNORED, Collator, encode, letter_ids, pad
from models.student.prompts import Sample, selection_sample
from tests.user_errors import raises_user_error
from train.student.lazy_samples import LazySample, StudentDataset
from train.student.length_sampler import LengthSampler
from train.student.metrics import LetterAccuracy, TokenAccuracy
from train.student.trainer import token_mean


@pytest.fixture
def lines(micro_store, frames, student_cfg) -> list[Sample]:
    """Samples of unequal length."""
    items = micro_store.selection("train")[:3]
    texts = [
        "Answer: A",
        "Scene parse: stationary. " * 6 + "\nAnswer: B",
        "near the top\nAnswer: C",
    ]
    return [
        selection_sample(i, "reasoning", "cot", frames, student_cfg.frames, t)
        for i, t in zip(items, texts, strict=True)
    ]


def loss_of(model, batch: dict, count: int | None = None) -> torch.Tensor:
    batch = dict(batch)
    labels = batch.pop("labels")
    return token_mean(model(**batch, use_cache=False), labels, count)


def test_supervised_is_the_response_and_nothing_else(lines, processor) -> None:
    for line in lines:
        encoded = encode(line, processor, 1500)
        kept = [i for i, x in zip(encoded.input_ids, encoded.labels, strict=True) if x != IGNORED]
        assert processor.tokenizer.decode(kept) == line.response + "<|im_end|>"
        prompt = encode(replace(line, response=None), processor, 1500)
        assert encoded.input_ids[: len(prompt.input_ids)] == prompt.input_ids


def test_one_sample_alone_weighs_as_in_a_padded_batch(lines, processor, model) -> None:
    collate = Collator(processor, 1500)
    counts = [int((collate([s])["labels"] != IGNORED).sum()) for s in lines]
    alone = sum(loss_of(model, collate([s])) * n for s, n in zip(lines, counts, strict=True)) / sum(
        counts
    )
    torch.testing.assert_close(loss_of(model, collate(lines)), alone, atol=1e-5, rtol=0)


def test_accumulated_gradients_are_those_of_the_big_batch(lines, processor, model) -> None:
    collate = Collator(processor, 1500)
    loss_of(model, collate(lines)).backward()
    whole = [p.grad.clone() for p in model.parameters() if p.grad is not None]
    model.zero_grad()
    count = sum(int((collate([s])["labels"] != IGNORED).sum()) for s in lines)
    for group in (lines[:1], lines[1:]):
        loss_of(model, collate(group), count).backward()
    parts = [p.grad for p in model.parameters() if p.grad is not None]
    for one, two in zip(whole, parts, strict=True):
        torch.testing.assert_close(one, two, atol=1e-6, rtol=1e-3)


def test_kept_rows_give_the_loss_of_all_rows(lines, processor, model) -> None:
    batch = pad([encode(s, processor, 1500) for s in lines], processor.tokenizer.pad_token_id)
    labels = batch.pop("labels")
    logits = model(**batch, use_cache=False).logits
    full = torch.nn.functional.cross_entropy(
        logits[:, :-1].flatten(0, 1), labels[:, 1:].flatten(), ignore_index=IGNORED
    )
    torch.testing.assert_close(loss_of(model, Collator(processor, 1500)(lines)), full)


def test_the_prompt_holds_every_shown_frame_at_its_true_time(
    micro_store, frames, student_cfg, processor
) -> None:
    item = micro_store.selection("train")[0]
    encoded = encode(
        selection_sample(item, "answer", "cot", frames, student_cfg.frames), processor, 1500
    )
    assert encoded.media["video_grid_thw"].tolist() == [[6, 6, 6]]
    assert encoded.media["image_grid_thw"].tolist() == [[1, 6, 6]] * 4
    shown = sample_prefix_frames(item.prefix_start, item.prefix_stop, 12)
    times = [(a + b) / 2 / FPS for a, b in zip(shown[::2], shown[1::2], strict=True)]
    text = processor.tokenizer.decode(encoded.input_ids)
    at = 0
    for time in times:
        at = text.index(f"<{time:.1f} seconds>", at) + 1


def test_a_sample_over_the_limit_is_refused_with_its_length(lines, processor) -> None:
    length = len(encode(lines[1], processor, 1500).input_ids)
    encode(lines[1], processor, length)
    with raises_user_error("sample-too-long", contains=(str(length), "student.max_length")):
        encode(lines[1], processor, length - 1)


def test_lengths_rank_samples_without_making_them(
    micro_store, frames, student_cfg, processor
) -> None:
    def refuse(epoch: int) -> Sample:
        raise AssertionError("a sample was made")

    items = micro_store.selection("train")[:4]
    texts = ["near the top " * words + "\nAnswer: A" for words in (3, 9, 27, 1)]
    made = StudentDataset([LazySample(text, 10, refuse) for text in texts])
    guessed = made.lengths(processor.tokenizer, 96)
    real = [
        len(encode(lines, processor, 1500).input_ids)
        for lines in (
            selection_sample(i, "answer", "cot", frames, student_cfg.frames, t)
            for i, t in zip(items, texts, strict=True)
        )
    ]
    assert np.argsort(guessed).tolist() == np.argsort(real).tolist()


def test_the_letters_logits_choose_the_answer(
    micro_store, frames, student_cfg, processor, model
) -> None:
    items: list[SelectionItem] = micro_store.selection("train")[:6]
    batch = Collator(processor, 1500)(
        [
            selection_sample(i, "answer", "cot", frames, student_cfg.frames, f"Answer: {i.letter}")
            for i in items
        ]
    )
    labels = batch.pop("labels")
    letters = letter_ids(processor)
    logits = torch.zeros(len(items), labels.shape[1], len(processor.tokenizer))
    at = labels.shape[1] - 3
    for k in range(len(items)):
        logits[k, at, letters[(items[k].answer + (k == 0)) % 4]] = 1.0
    chosen, right = LetterAccuracy(letters).reduce(logits, labels).T
    assert right.tolist() == [i.answer for i in items]
    assert (chosen == right).tolist() == [False] + [True] * 5
    measured = StudentDataset(
        [LazySample("", 0, lambda epoch: None, f) for f in ("event",) * 4 + ("time",) * 2]
    )
    told = LetterAccuracy.measure(
        EvalPrediction(torch.stack([chosen, right], dim=1).numpy(), None), measured
    )
    assert told == {
        "letter_accuracy": 5 / 6, "letter_accuracy_event": 3 / 4, "letter_accuracy_time": 1.0
    }  # fmt: skip


def test_controls_reach_the_prompt(micro_store, frames, student_cfg, processor) -> None:
    item = micro_store.selection("test")[0]
    plain, alone, shuffled = (
        encode(
            selection_sample(item, "answer", "cot", frames, student_cfg.frames, control=control),
            processor,
            1500,
        )
        for control in (None, "candidate_only", "shuffled_prefix")
    )
    assert "pixel_values_videos" not in alone.media
    assert len(alone.input_ids) < len(plain.input_ids)
    # The same times are told of the same frames in another order.
    assert shuffled.input_ids == plain.input_ids
    pixels = [e.media["pixel_values_videos"] for e in (plain, shuffled)]
    assert pixels[0].shape == pixels[1].shape
    assert not torch.equal(*pixels)


@pytest.mark.parametrize("count", [1, 7, 64, 1000])
def test_an_order_is_of_its_epoch_and_sorts_each_step(count) -> None:
    lengths = np.random.default_rng(0).integers(1, 1000, count)
    order = LengthSampler(lengths.tolist(), 16, seed=0)
    first = list(order)
    assert sorted(first) == list(range(count))
    assert first == list(order)
    for start in range(0, count, 16):
        assert (np.diff(lengths[first[start : start + 16]]) <= 0).all()
    order.set_epoch(1)
    second = list(order)
    assert sorted(second) == list(range(count))
    # One step alone is sorted into one order.
    assert first != second or count <= 16
    assert second != list(LengthSampler(lengths.tolist(), 16, seed=1)) or count <= 16


def test_the_right_tokens_are_counted() -> None:
    labels = torch.tensor([[5, 6, 7, 8], [IGNORED, IGNORED, 7, 8]])
    logits = torch.nn.functional.one_hot(torch.tensor([[6, 7, 0, 0], [3, 7, 8, 0]]), 10).float()
    choice = TokenAccuracy({"color": [6, 9], "shape": [8], "place": [9]})
    counts = choice.reduce(logits, labels)
    # A position's logits tell the next one's token; what is not supervised is not counted.
    assert counts[:, :2].tolist() == [[2, 3], [2, 2]]
    told = choice.measure(EvalPrediction(counts.numpy(), None), StudentDataset([]))
    # No word of the last kind stands there.
    assert told == {"token_accuracy": 4 / 5, "color_accuracy": 1, "shape_accuracy": 1 / 2}
