"""Losses and gradients do not change if the shared start of prompts is computed once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn

from conf.schema import LoraConfig
from models import loading
from models.attention import MATMUL
from models.shared_prompts import PADDING, SHARED, SharedPromptTower, pack_samples
from models.student.collator import Collator
from models.student.prompts import selection_sample
from tests.tiny_models import randomize_adapters
from train.student.trainer import token_mean

RATIONALE = "the red cube moves to the right, and " * 8 + "it stops.\nAnswer: B"
ONE_ITEM = [(0, "reasoning"), (0, "answer")]
MIXED = [(1, "answer"), (0, "answer"), (2, "answer"), (1, "reasoning"), (0, "reasoning")]


@pytest.fixture(scope="module")
def parts(nf4_cfg, micro_store, frames):
    """A student whose adapters have an effect, and a function that makes a batch."""
    torch.manual_seed(0)
    cfg = replace(nf4_cfg, quantization="none", lora=LoraConfig(rank=4))
    model, processor = loading.load_student(cfg, "fp32", list)
    randomize_adapters(model, 0.1)
    # The items must have different prefixes; otherwise, all would share more than half.
    items = list({i.scene_id: i for i in micro_store.selection("train")}.values())

    def make_batch(chosen: Sequence[tuple[int, str]]) -> dict[str, Any]:
        samples = [
            selection_sample(
                items[k], mode, "cot", frames, cfg.frames,
                RATIONALE if mode == "reasoning" else "Answer: C",
            )
            for k, mode in chosen
        ]  # fmt: skip
        return Collator(processor, 1500)(samples)

    return model.train(), make_batch


def language_tower(model: nn.Module) -> nn.Module:
    return model.get_base_model().model.language_model


def results(model: nn.Module, batch: dict[str, Any], shares: bool) -> tuple[torch.Tensor, Any, Any]:
    """Return the loss, all gradients, and the shape of the hidden states in the tower."""
    tower, shapes = language_tower(model), []
    plain = type(tower)
    tower.__class__ = SharedPromptTower if shares else plain
    hook = tower.layers[0].register_forward_hook(lambda _m, _i, out: shapes.append(out.shape[:2]))
    model.zero_grad()
    try:
        inputs = {name: value for name, value in batch.items() if name != "labels"}
        loss = token_mean(model(**inputs), batch["labels"])
        loss.backward()
    finally:
        hook.remove()
        tower.__class__ = plain
    found = {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}
    return loss.detach(), found, shapes[0]


def assert_equal_results(model: nn.Module, batch: dict[str, Any]) -> tuple[Any, Any]:
    """Return the shapes of the hidden states without and with a shared start."""
    loss, gradients, plain = results(model, batch, shares=False)
    shared_loss, found, packed = results(model, batch, shares=True)
    torch.testing.assert_close(shared_loss, loss, rtol=1e-5, atol=0)
    assert found.keys() == gradients.keys()
    for name, gradient in gradients.items():
        assert (found[name] - gradient).norm() <= 1e-4 * gradient.norm() + 1e-7, name
    return plain, packed


@pytest.mark.parametrize("attention", ["sdpa", "eager", MATMUL])
@pytest.mark.parametrize("chosen", [ONE_ITEM, MIXED], ids=["one item", "mixed"])
def test_loss_and_gradients_do_not_change(parts, attention, chosen) -> None:
    model, make_batch = parts
    batch = make_batch(chosen)
    text = model.get_base_model()
    text.set_attn_implementation({"text_config": attention, "vision_config": "sdpa"})
    plain, packed = assert_equal_results(model, batch)
    assert plain == batch["input_ids"].shape
    items = len({item for item, _ in chosen})
    longest = batch["attention_mask"].sum(dim=1).max()
    assert packed[0] == items < plain[0]
    # A row has the longest sample and no more than the last instruction and answer of another.
    assert longest < packed[1] < longest + 80


def test_recomputed_activations_and_a_trained_vision_tower(parts) -> None:
    model, make_batch = parts
    vision = model.get_base_model().model.visual
    model.get_base_model().gradient_checkpointing_enable({"use_reentrant": False})
    for weight in vision.parameters():
        weight.requires_grad_(True)
    try:
        plain, packed = assert_equal_results(model, make_batch(MIXED))
        assert all(weight.grad is not None for weight in vision.patch_embed.parameters())
    finally:
        vision.requires_grad_(False)
        model.get_base_model().gradient_checkpointing_disable()
    assert packed[0] == 3 < plain[0]


def test_other_batches_are_computed_as_before(parts) -> None:
    """Prompts of different items share their first words only, and one sample shares nothing."""
    model, make_batch = parts
    for chosen in ([(0, "answer"), (1, "answer")], [(0, "reasoning")]):
        batch = make_batch(chosen)
        assert results(model, batch, shares=True)[2] == batch["input_ids"].shape
    model.eval()
    try:
        batch = make_batch(ONE_ITEM)
        assert results(model, batch, shares=True)[2] == batch["input_ids"].shape
    finally:
        model.train()


def test_rows_have_each_token_of_each_sample_once() -> None:
    """Samples of 9, 7 and 8 tokens: the first and the last start with the same 6."""
    torch.manual_seed(0)
    embeds = torch.randn(3, 9, 4)
    mask = torch.tensor([[1] * 9, [0, 0] + [1] * 7, [0] + [1] * 8])
    embeds[2, 1:7] = embeds[0, :6]
    packing = pack_samples(embeds, mask)
    assert packing.rows.tolist() == [0, 1, 0]
    assert packing.parts.tolist() == [
        [SHARED] * 6 + [1] * 3 + [2] * 2,
        [PADDING] * 4 + [SHARED] * 7,
    ]
    back = packing.take(embeds)[packing.rows[:, None], packing.places]
    assert torch.equal(back[mask > 0], embeds[mask > 0])


def test_packing_must_make_attention_cheaper() -> None:
    """Many responses in one row would attend over a longer row than each of them."""
    embeds = torch.randn(12, 20, 4)
    embeds[:, :10] = embeds[:1, :10]
    assert pack_samples(embeds, torch.ones(12, 20)) is None
    embeds[:, :18] = embeds[:1, :18]
    assert pack_samples(embeds, torch.ones(12, 20)).parts.shape == (1, 42)
