"""One sample alone, padded on either side and packed with others gives the same loss and the same
gradients, and what packs without keeping samples apart is seen to leak."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import pytest
import torch
from transformers import AttentionInterface, PreTrainedModel, ProcessorMixin
from transformers.integrations.sdpa_attention import sdpa_attention_forward

from conf.entry import Run
from conf.schema import LoraConfig, SftCommand, SftTrainConfig, TeacherConfig
from models import loading
from models.attention import BY_FRAME
from models.student.collator import IGNORED, Collator, Encoded, encode, pad
from models.student.prompts import Sample, selection_sample
from tests.user_errors import raises_user_error
from train import sft
from train.common.journal import read_journal
from train.student.packing import PackingCollator, pack, packing_rope
from train.student.trainer import token_mean

LENGTH = 1500
TEXTS = (
    "Answer: A",
    "Scene parse: stationary. " * 6 + "\nAnswer: B",
    "near the top\nAnswer: C",
)
# Attention's own, of the language tower and of the vision tower.
ATTENTIONS = {
    "eager": "eager",
    "sdpa": "sdpa",
    "by frame": {"text_config": "sdpa", "vision_config": BY_FRAME},
}


@pytest.fixture(scope="module")
def samples(micro_store, frames, student_cfg) -> list[Sample]:
    """A clip and four images each; one sample has no clip."""
    items = micro_store.selection("train")[: len(TEXTS)]
    controls = (None, None, "candidate_only")
    return [
        selection_sample(i, "reasoning", "cot", frames, student_cfg.frames, t, c)
        for i, t, c in zip(items, TEXTS, controls, strict=True)
    ]


@pytest.fixture(params=ATTENTIONS)
def attending(request: pytest.FixtureRequest, model: PreTrainedModel) -> PreTrainedModel:
    """A model with adapters that are not zero, so that gradients reach all of them."""
    model.set_attn_implementation(ATTENTIONS[request.param])
    torch.manual_seed(0)
    adapted = loading.add_adapters(model, LoraConfig(rank=2))
    with torch.no_grad():
        for name, weight in adapted.named_parameters():
            if "lora_B" in name:
                weight.normal_(std=0.1)
    return adapted.eval()


def summed(model: PreTrainedModel, batch: dict) -> torch.Tensor:
    """The loss, summed over the batch's supervised tokens."""
    batch = dict(batch)
    return token_mean(model(**batch), batch.pop("labels"), 1)


def gradients(model: PreTrainedModel, loss: torch.Tensor) -> list[torch.Tensor]:
    return torch.autograd.grad(loss, [p for p in model.parameters() if p.requires_grad])


def right_padded(encoded: list[Encoded], processor: ProcessorMixin) -> dict:
    """The left-padded batch, each row turned until its padding stands on the right."""
    batch = pad(encoded, processor.tokenizer.pad_token_id)
    longest = batch["input_ids"].shape[1]
    for name in ("input_ids", "attention_mask", "mm_token_type_ids", "labels"):
        rows = zip(batch[name], encoded, strict=True)
        turned = [row.roll(len(one.input_ids) - longest) for row, one in rows]
        batch[name] = torch.stack(turned)
    return batch


def test_alone_padded_left_padded_right_and_packed_are_one(samples, processor, attending) -> None:
    collate = Collator(processor, LENGTH)
    encoded = [encode(s, processor, LENGTH) for s in samples]
    assert len({len(e.input_ids) for e in encoded}) == len(samples)
    together = {
        "left": collate(samples),
        "right": right_padded(encoded, processor),
        "packed": PackingCollator(processor, LENGTH, packing_rope(attending, "true"))(samples),
    }
    count = sum(sum(label != IGNORED for label in e.labels) for e in encoded)
    mean = sum(summed(attending, collate([s])) for s in samples) / count
    expected = gradients(attending, mean)
    for batch in together.values():
        assert int((batch["labels"] != IGNORED).sum()) == count
        loss = summed(attending, batch) / count
        torch.testing.assert_close(loss, mean, atol=1e-5, rtol=0)
        for one, two in zip(gradients(attending, loss), expected, strict=True):
            assert two.abs().max() > 1e-4
            assert (one - two).norm() < 1e-3 * two.norm()


def test_each_packed_samples_loss_is_its_own(samples, processor, attending) -> None:
    rope = packing_rope(attending, "true")
    encoded = [encode(s, processor, LENGTH) for s in samples]
    for k, sample in enumerate(samples):
        others = [
            replace(e, labels=[IGNORED] * (len(e.labels) - 1) + e.labels[-1:]) for e in encoded
        ]
        only = list(others)
        only[k] = encoded[k]
        # The other samples' ends are supervised too, so that each of them has its rows.
        ends = [
            summed(attending, pack([one], rope, [True])) for j, one in enumerate(others) if j != k
        ]
        alone = summed(attending, Collator(processor, LENGTH)([sample]))
        torch.testing.assert_close(
            summed(attending, pack(only, rope, [True] * len(only))),
            alone + sum(ends),
            atol=1e-4,
            rtol=1e-6,
        )


def test_a_packed_samples_logits_know_nothing_of_its_neighbours(
    samples, processor, attending
) -> None:
    rope = packing_rope(attending, "true")
    first, second, third = (encode(s, processor, LENGTH) for s in samples)
    told = replace(first, input_ids=[*first.input_ids[:-3], 9, 9, 9])
    shown = replace(
        first, media={n: t.flip(0) if "pixel" in n else t for n, t in first.media.items()}
    )
    logits = [packed_logits(attending, [one, second, third], rope) for one in (first, told, shown)]
    rows = supervised_rows(first)
    for other in logits[1:]:
        assert not torch.equal(other[:, :rows], logits[0][:, :rows])
        torch.testing.assert_close(other[:, rows:], logits[0][:, rows:], atol=1e-6, rtol=0)


def packed_logits(model: PreTrainedModel, encoded: list[Encoded], rope: Callable) -> torch.Tensor:
    batch = pack(encoded, rope, [True] * len(encoded))
    del batch["labels"]
    with torch.no_grad():
        return model(**batch).logits


def supervised_rows(encoded: Encoded) -> int:
    return 1 + sum(label != IGNORED for label in encoded.labels)


# Each leaves out one of the three things that keep packed samples apart.
NEAR_MISSES = {
    "three rows of positions": lambda b: {**b, "position_ids": b["position_ids"][1:]},
    "a cache": lambda b: {**b, "use_cache": True},
    "a mask": lambda b: {**b, "attention_mask": torch.ones_like(b["input_ids"])},
    "one count of all tokens": lambda b: {
        **b,
        "position_ids": torch.cat(
            [torch.arange(b["input_ids"].shape[1])[None, None], b["position_ids"][1:]]
        ),
    },
}


@pytest.mark.parametrize("miss", NEAR_MISSES)
def test_a_near_miss_of_packing_leaks(miss, samples, processor, model) -> None:
    model.eval()
    batch = PackingCollator(processor, LENGTH, packing_rope(model, "true"))(samples)
    exact, leaking = (
        summed(model, b) / int((b["labels"] != IGNORED).sum())
        for b in (batch, NEAR_MISSES[miss](batch))
    )
    # A hundred times what the law allows.
    assert abs(exact - leaking) > 1e-3


def test_packed_rows_stand_where_the_model_itself_would_put_them(samples, processor, model) -> None:
    encoded = [encode(s, processor, LENGTH) for s in samples]
    packed = pack(encoded, packing_rope(model, "true"), [True] * len(encoded))["position_ids"]
    assert packed.shape == (4, 1, sum(len(e.input_ids) for e in encoded))
    for one, place in zip(
        encoded, packed.split([len(e.input_ids) for e in encoded], -1), strict=True
    ):
        batch = pad([one], processor.tokenizer.pad_token_id)
        rotary = model.model.compute_3d_position_ids(
            batch["input_ids"], None, batch["image_grid_thw"], batch.get("video_grid_thw"),
            mm_token_type_ids=batch["mm_token_type_ids"],
        )  # fmt: skip
        assert torch.equal(place[1:], rotary)
        assert place[0, 0].tolist() == list(range(len(one.input_ids)))


def test_packing_that_would_leak_is_refused(model) -> None:
    # Its mask is not registered, so that none would come.
    AttentionInterface.register("maskless", sdpa_attention_forward)
    model.set_attn_implementation({"text_config": "maskless", "vision_config": "sdpa"})
    with raises_user_error("cannot-pack", contains="maskless"):
        packing_rope(model, "true")
    assert packing_rope(model, "auto") is None


def test_packing_is_chosen_where_flash_attention_is(model, monkeypatch) -> None:
    assert packing_rope(model, "auto") is None
    assert packing_rope(model, "false") is None
    assert packing_rope(model, "True") == model.model.get_rope_index
    monkeypatch.setattr(
        model.config.text_config, "_attn_implementation_internal", "flash_attention_2"
    )
    assert packing_rope(model, "auto") == model.model.get_rope_index


@pytest.mark.slow
def test_a_packed_run_is_a_padded_run(micro, micro_store, nf4_cfg, tmp_path) -> None:
    """Batches are packed in a process of their own, evaluations are padded in both."""
    train = SftTrainConfig(
        lr=1e-3, max_steps=3, batch=4, micro_batch=4, precision="fp32", workers=1,
        gradient_checkpointing=False, evaluations=1, validation_items=3,
    )  # fmt: skip
    journals = []
    for packing in ("false", "true"):
        settings = SftCommand(
            benchmark=micro, store=str(micro_store.folder.parent), workers=1, student=nf4_cfg,
            teacher=TeacherConfig(name="template"), train=replace(train, packing=packing),
        )  # fmt: skip
        folder = tmp_path / packing
        folder.mkdir()
        sft.main.__wrapped__(settings, Run(packing, folder))
        journals.append(read_journal(folder))
    for padded, packed in zip(*journals, strict=True):
        assert padded == pytest.approx(packed, rel=1e-4)
