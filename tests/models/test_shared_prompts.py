"""Losses and gradients do not change if the shared start of prompts is computed once."""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn

from dynapix.conf.schema import LoraConfig
from dynapix.models import loading
from dynapix.models.layers.attention import MATMUL
from dynapix.models.layers.fast_layers import use_fast_layers
from dynapix.models.layers.shared_prompts import pack_samples, shares_prompts
from dynapix.models.student.collator import Collator
from dynapix.models.student.prompts import selection_sample
from tests.tiny_models import assert_equal_gradients, loss_and_gradients, randomize_adapters

RATIONALE = "the red cube moves to the right, and " * 8 + "it stops.\nAnswer: B"
ONE_ITEM = [(0, "reasoning"), (0, "answer")]
MIXED = [(1, "answer"), (0, "answer"), (2, "answer"), (1, "reasoning"), (0, "reasoning")]


@pytest.fixture(scope="module")
def parts(nf4_cfg, micro_store, frames):
    """A student whose adapters have an effect, a copy with fast layers, and a function that makes a
    batch."""
    torch.manual_seed(0)
    cfg = replace(nf4_cfg, quantization="none", lora=LoraConfig(rank=4))
    model, processor = loading.load_student(cfg, "fp32", list)
    randomize_adapters(model, 0.1)
    # The items have different prefixes: otherwise, their samples would share the clip.
    items = list({i.scene_id: i for i in micro_store.selection("train")}.values())

    def make_batch(chosen: Sequence[tuple[int, str]]) -> dict[str, Any]:
        responses = {"reasoning": RATIONALE, "answer": "Answer: C"}
        samples = [
            selection_sample(items[k], mode, "cot", frames, cfg.frames, responses[mode])
            for k, mode in chosen
        ]
        return Collator(processor, 1500)(samples)

    fast = copy.deepcopy(model)
    use_fast_layers(fast)
    assert shares_prompts(fast)
    assert not shares_prompts(model)
    return model.train(), fast.train(), make_batch


def results(model: nn.Module, batch: dict[str, Any]) -> tuple[torch.Tensor, Any, Any]:
    """Return the loss, all gradients, and the shape of the hidden states in the tower."""
    tower, shapes = model.get_base_model().model.language_model, []
    hook = tower.layers[0].register_forward_hook(lambda _m, _i, out: shapes.append(out.shape[:2]))
    try:
        return *loss_and_gradients(model, batch), shapes[0]
    finally:
        hook.remove()


def assert_equal_results(model: nn.Module, fast: nn.Module, batch: dict[str, Any]) -> Any:
    """Return the shape of the hidden states with a shared start."""
    loss, gradients, plain = results(model, batch)
    shared_loss, found, packed = results(fast, batch)
    assert plain == batch["input_ids"].shape
    torch.testing.assert_close(shared_loss, loss, rtol=1e-5, atol=0)
    assert_equal_gradients(found, gradients)
    return packed


@pytest.mark.parametrize(
    ("attention", "chosen"), [("sdpa", ONE_ITEM), ("sdpa", MIXED), (MATMUL, MIXED)]
)
def test_loss_and_gradients_do_not_change(parts, attention, chosen) -> None:
    model, fast, make_batch = parts
    batch = make_batch(chosen)
    for each in (model, fast):
        implementations = {"text_config": attention, "vision_config": "sdpa"}
        each.get_base_model().set_attn_implementation(implementations)
    packed = assert_equal_results(model, fast, batch)
    assert packed[0] == len({item for item, _ in chosen}) < len(chosen)
    # A row has the longest sample and no more than the last instruction and answer of another.
    longest = batch["attention_mask"].sum(dim=1).max()
    assert longest < packed[1] < longest + 80
    # TRL also pads responses on the right.
    count, shape = 7, batch["input_ids"].shape
    padded = {
        name: nn.functional.pad(value, (0, count)) if value.shape == shape else value
        for name, value in batch.items()
    }
    kept = batch["logits_to_keep"]
    padded["labels"] = nn.functional.pad(batch["labels"], (0, count), value=-100)
    padded["logits_to_keep"] = torch.arange(kept[0], kept[-1] + count + 1)
    loss, _, width = results(fast, padded)
    assert width == packed
    torch.testing.assert_close(loss, results(model, batch)[0], rtol=1e-5, atol=0)


def test_recomputed_activations_and_a_trained_vision_tower(parts) -> None:
    *models, make_batch = parts
    for each in models:
        each.get_base_model().gradient_checkpointing_enable({"use_reentrant": False})
        each.get_base_model().model.visual.requires_grad_(True)
    try:
        packed = assert_equal_results(*models, make_batch(MIXED))
        vision = models[1].get_base_model().model.visual
        assert all(weight.grad is not None for weight in vision.patch_embed.parameters())
    finally:
        for each in models:
            each.get_base_model().model.visual.requires_grad_(False)
            each.get_base_model().gradient_checkpointing_disable()
    assert packed[0] == 3


def test_prompts_without_frames_are_shared_and_other_batches_are_not(parts) -> None:
    """Prompts of different items share their first words only, and one sample shares nothing."""
    model, fast, make_batch = parts
    one_item = make_batch(ONE_ITEM)
    names = ("input_ids", "attention_mask", "labels", "logits_to_keep")
    assert assert_equal_results(model, fast, {name: one_item[name] for name in names})[0] == 1
    for chosen in ([(0, "answer"), (1, "answer")], [(0, "reasoning")]):
        batch = make_batch(chosen)
        assert results(fast, batch)[2] == batch["input_ids"].shape
    fast.eval()
    try:
        assert results(fast, one_item)[2] == one_item["input_ids"].shape
    finally:
        fast.train()
    flash = copy.deepcopy(fast)
    flash.get_base_model().model.language_model.config._attn_implementation = "flash_attention_2"
    assert not shares_prompts(flash)


def test_samples_share_a_row_where_it_makes_attention_cheapest() -> None:
    torch.manual_seed(0)
    # Two items show the same clip, which is half of their prompts.
    embeds = torch.randn(4, 40, 4)
    embeds[1:, :18] = embeds[:1, :18]
    embeds[2:, 18:36] = embeds[:2, 18:36]
    assert pack_samples(embeds, torch.ones(4, 40)).rows.tolist() == [0, 1, 0, 1]
    # Many responses in one row would attend over a longer row than each of them.
    embeds = torch.randn(12, 20, 4)
    embeds[:, :10] = embeds[:1, :10]
    assert pack_samples(embeds, torch.ones(12, 20)) is None
    embeds[:, :18] = embeds[:1, :18]
    assert pack_samples(embeds, torch.ones(12, 20)).parts.shape == (1, 42)
