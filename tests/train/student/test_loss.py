"""Which tokens are supervised, how their losses are averaged, and how answers are measured."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from transformers import EvalPrediction, PreTrainedModel, ProcessorMixin

from dynapix.conf.schema import LoraConfig
from dynapix.data.records import SelectionItem
from dynapix.models import loading
from dynapix.models.layers.attention import BY_FRAME
from dynapix.models.student.collator import IGNORED, Collator, Encoded, encode, letter_ids, pad
from dynapix.models.student.prompts import Sample, selection_sample
from dynapix.train.student.samples import LazySample, LengthSampler, StudentDataset
from dynapix.train.student.trainer import LetterAccuracy, sample_mean, token_mean
from tests.tiny_models import randomize_adapters
from tests.user_errors import raises_user_error

# The attention of the language tower and of the vision tower.
ATTENTIONS = {
    "eager": "eager",
    "sdpa": "sdpa",
    "by frame": {"text_config": "sdpa", "vision_config": BY_FRAME},
}


@pytest.fixture
def samples(micro_store, frames, student_cfg) -> list[Sample]:
    """Samples of unequal length; the last one has no clip."""
    items = micro_store.selection("train")[:3]
    texts = [
        "Answer: A",
        "Scene parse: stationary. " * 6 + "\nAnswer: B",
        "near the top\nAnswer: C",
    ]
    controls = (None, None, "candidate_only")
    return [
        selection_sample(i, "reasoning", "cot", frames, student_cfg.frames, t, c)
        for i, t, c in zip(items, texts, controls, strict=True)
    ]


def loss_of(model, batch: dict, count: int | None = None, loss=token_mean) -> torch.Tensor:
    batch = dict(batch)
    labels = batch.pop("labels")
    return loss(model(**batch, use_cache=False), labels, count)


def gradients(model: PreTrainedModel, loss: torch.Tensor) -> list[torch.Tensor]:
    return torch.autograd.grad(loss, [p for p in model.parameters() if p.requires_grad])


def right_padded(encoded: list[Encoded], processor: ProcessorMixin) -> dict:
    """Return a batch that is padded on the right."""
    batch = pad(encoded, processor.tokenizer.pad_token_id)
    longest = batch["input_ids"].shape[1]
    for name in ("input_ids", "attention_mask", "mm_token_type_ids", "labels"):
        rows = zip(batch[name], encoded, strict=True)
        batch[name] = torch.stack([row.roll(len(one.input_ids) - longest) for row, one in rows])
    return batch


@pytest.mark.parametrize("attention", ATTENTIONS)
def test_padding_changes_neither_loss_nor_gradients(samples, processor, model, attention) -> None:
    model.set_attn_implementation(ATTENTIONS[attention])
    torch.manual_seed(0)
    model = loading.add_adapters(model, LoraConfig(rank=2))
    # If B is zero, as it is at first, A gets no gradient.
    randomize_adapters(model, 0.1)
    model.eval()
    collate = Collator(processor, 1500)
    encoded = [encode(s, processor, 1500) for s in samples]
    assert len({len(e.input_ids) for e in encoded}) == len(samples)
    count = sum(sum(label != IGNORED for label in e.labels) for e in encoded)
    mean = sum(loss_of(model, collate([s]), 1) for s in samples) / count
    expected = gradients(model, mean)
    for batch in (collate(samples), right_padded(encoded, processor)):
        assert int((batch["labels"] != IGNORED).sum()) == count
        loss = loss_of(model, batch, count)
        torch.testing.assert_close(loss, mean, atol=1e-5, rtol=0)
        for one, two in zip(gradients(model, loss), expected, strict=True):
            assert two.abs().max() > 1e-4
            assert (one - two).norm() < 1e-3 * two.norm()


def test_each_sample_weighs_the_same_in_any_micro_batches(samples, processor, model) -> None:
    collate = Collator(processor, 1500)

    def mean(samples: list[Sample], count: int | None = None) -> torch.Tensor:
        return loss_of(model, collate(samples), count, sample_mean)

    expected = torch.stack([loss_of(model, collate([s])) for s in samples]).mean()
    torch.testing.assert_close(mean(samples), expected)
    torch.testing.assert_close(mean(samples[:2], 3) + mean(samples[2:], 3), expected)
    # A sample that is not supervised weighs nothing.
    torch.testing.assert_close(mean([*samples, replace(samples[0], supervised=False)]), expected)


def test_only_the_response_is_supervised(samples, processor) -> None:
    for sample in samples:
        encoded = encode(sample, processor, 1500)
        kept = [i for i, x in zip(encoded.input_ids, encoded.labels, strict=True) if x != IGNORED]
        assert processor.tokenizer.decode(kept) == sample.response + "<|im_end|>"
        prompt = encode(replace(sample, response=None), processor, 1500)
        assert encoded.input_ids[: len(prompt.input_ids)] == prompt.input_ids


def test_a_sample_over_the_limit_is_refused(samples, processor) -> None:
    length = len(encode(samples[1], processor, 1500).input_ids)
    encode(samples[1], processor, length)
    with raises_user_error("sample-too-long", contains=(str(length), "student.max_length")):
        encode(samples[1], processor, length - 1)


def test_the_letter_with_the_highest_logit_is_chosen(
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
    samples = StudentDataset(
        [LazySample("", 0, f, lambda epoch: None, f) for f in ("event",) * 4 + ("time",) * 2]
    )
    metrics = LetterAccuracy.measure(
        EvalPrediction(torch.stack([chosen, right], dim=1).numpy(), None), samples
    )
    assert metrics == {
        "letter_accuracy": 5 / 6, "letter_accuracy_event": 3 / 4, "letter_accuracy_time": 1.0
    }  # fmt: skip


@pytest.mark.parametrize("count", [1, 7, 64, 1000])
@pytest.mark.parametrize("each", [1, 2, 8])
def test_steps_are_sorted_by_length_and_have_whole_items(count, each) -> None:
    lengths = np.random.default_rng(0).integers(1, 1000, count)
    items = np.random.default_rng(1).permutation(count) // each
    order = LengthSampler(lengths.tolist(), items.astype(str).tolist(), 16, seed=0)
    pairs = replace(order, pairs=True)
    first = list(order)
    assert sorted(first) == list(range(count))
    assert first == list(order)
    # Only the end of a step can separate the samples of an item.
    changes, steps = (np.diff(items[list(pairs)]) != 0).sum(), -(-count // 16)
    assert changes <= len(set(items)) - 1 + steps - 1
    for start in range(0, count, 16):
        step = first[start : start + 16]
        assert (np.diff(lengths[step]) <= 0).all()
        assert sorted(list(pairs)[start : start + 16]) == sorted(step)
    order.set_epoch(1)
    second = list(order)
    assert sorted(second) == list(range(count))
    # The samples of a single step have one order.
    assert first != second or count <= 16
    other = LengthSampler(lengths.tolist(), order.item_ids, 16, seed=1)
    assert second != list(other) or count <= 16


def test_pairs_are_sorted_by_their_longest_sample_and_single_samples_are_last() -> None:
    lengths = [10, 70, 20, 60, 50, 40, 90]
    items = ["a", "a", "b", "c", "b", "c", "single"]
    assert list(LengthSampler(lengths, items, 7, 0, pairs=True)) == [1, 0, 3, 5, 4, 2, 6]
