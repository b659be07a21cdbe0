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
from dynapix.models.layers.shared_prompts import PADDING, SHARED, pack_samples, shares_prompts
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
        samples = [
            selection_sample(
                items[k], mode, "cot", frames, cfg.frames,
                RATIONALE if mode == "reasoning" else "Answer: C",
            )
            for k, mode in chosen
        ]  # fmt: skip
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


@pytest.mark.parametrize("attention", ["sdpa", "eager", MATMUL])
@pytest.mark.parametrize("chosen", [ONE_ITEM, MIXED], ids=["one item", "mixed"])
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


def test_padding_on_the_right_changes_nothing(parts) -> None:
    """TRL pads prompts on the left and responses on the right."""
    model, fast, make_batch = parts
    batch, count = make_batch(MIXED), 7
    names = [name for name, value in batch.items() if value.shape == batch["input_ids"].shape]
    padded = {
        **batch,
        **{name: torch.nn.functional.pad(batch[name], (0, count)) for name in names},
        "labels": torch.nn.functional.pad(batch["labels"], (0, count), value=-100),
        "logits_to_keep": torch.arange(
            batch["logits_to_keep"][0], batch["logits_to_keep"][-1] + count + 1
        ),
    }
    without, with_padding = results(fast, batch), results(fast, padded)
    assert without[2] == with_padding[2]
    torch.testing.assert_close(with_padding[0], results(model, batch)[0], rtol=1e-5, atol=0)


def test_recomputed_activations_and_a_trained_vision_tower(parts) -> None:
    model, fast, make_batch = parts
    for each in (model, fast):
        each.get_base_model().gradient_checkpointing_enable({"use_reentrant": False})
        each.get_base_model().model.visual.requires_grad_(True)
    try:
        packed = assert_equal_results(model, fast, make_batch(MIXED))
        vision = fast.get_base_model().model.visual
        assert all(weight.grad is not None for weight in vision.patch_embed.parameters())
    finally:
        for each in (model, fast):
            each.get_base_model().model.visual.requires_grad_(False)
            each.get_base_model().gradient_checkpointing_disable()
    assert packed[0] == 3


def test_prompts_without_frames_are_shared(parts) -> None:
    model, fast, make_batch = parts
    batch = make_batch(ONE_ITEM)
    texts = {
        name: batch[name] for name in ("input_ids", "attention_mask", "labels", "logits_to_keep")
    }
    assert assert_equal_results(model, fast, texts)[0] == 1


def test_other_batches_are_computed_as_before(parts) -> None:
    """Prompts of different items share their first words only, and one sample shares nothing."""
    _, fast, make_batch = parts
    for chosen in ([(0, "answer"), (1, "answer")], [(0, "reasoning")]):
        batch = make_batch(chosen)
        assert results(fast, batch)[2] == batch["input_ids"].shape
    batch = make_batch(ONE_ITEM)
    fast.eval()
    try:
        assert results(fast, batch)[2] == batch["input_ids"].shape
    finally:
        fast.train()
    flash = copy.deepcopy(fast)
    flash.get_base_model().model.language_model.config._attn_implementation = "flash_attention_2"
    assert not shares_prompts(flash)


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


def test_a_sample_joins_the_row_with_the_longest_common_start() -> None:
    """Two items show the same clip, which is half of their prompts."""
    torch.manual_seed(0)
    embeds = torch.randn(4, 40, 4)
    embeds[1:, :18] = embeds[:1, :18]
    embeds[2, 18:36] = embeds[0, 18:36]
    embeds[3, 18:36] = embeds[1, 18:36]
    packing = pack_samples(embeds, torch.ones(4, 40))
    assert packing.rows.tolist() == [0, 1, 0, 1]
