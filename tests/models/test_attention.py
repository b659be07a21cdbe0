"""The chosen attention gives the results of the library's own."""

from __future__ import annotations

import pytest
import torch
from torch import nn
from transformers import PreTrainedModel
from transformers.models.qwen3_vl.modeling_qwen3_vl import eager_attention_forward

from dynapix.models.layers import attention
from dynapix.models.layers.attention import (
    BY_FRAME,
    MATMUL,
    MATMUL_MAX_TOKENS,
    attend_by_frame,
    attend_by_matmul,
    choose_attention,
)
from dynapix.models.student.collator import Collator
from dynapix.models.student.kv_cache import BLOCK, create_cache
from dynapix.models.student.prompts import Sample, selection_sample
from dynapix.train.student.trainer import token_mean

LENGTH = 1500


@pytest.fixture(scope="module")
def samples(micro_store, frames, student_cfg) -> list[Sample]:
    items = micro_store.selection("train")[:2]
    texts = ("Answer: A", "Scene parse: stationary. " * 6 + "\nAnswer: B")
    return [
        selection_sample(i, "reasoning", "cot", frames, student_cfg.frames, t)
        for i, t in zip(items, texts, strict=True)
    ]


def heads(*shape: int, dtype: torch.dtype = torch.float32) -> list[torch.Tensor]:
    """Return a random query, key and value that require gradients."""
    generator = torch.Generator().manual_seed(0)
    made = (torch.randn(shape, generator=generator).to(dtype) for _ in range(3))
    return [one.requires_grad_() for one in made]


class Layer(nn.Module):
    num_key_value_groups = 1


def frame_bounds(lengths: list[int]) -> torch.Tensor:
    return torch.tensor([0, *lengths]).cumsum(0)


@pytest.mark.parametrize("lengths", [[7] * 5, [7, 7, 3, 7], [9]])
def test_all_frames_at_once_equal_frames_one_by_one(lengths) -> None:
    query, key, value = heads(1, 2, sum(lengths), 8)
    found, _ = attend_by_frame(
        Layer(), query, key, value, None,
        scaling=0.3, cu_seq_lens_q=frame_bounds(lengths), max_length_q=max(lengths),
    )  # fmt: skip
    expected = torch.cat(
        [
            eager_attention_forward(Layer(), q, k, v, None, 0.3)[0]
            for q, k, v in zip(*(t.split(lengths, dim=2) for t in (query, key, value)), strict=True)
        ],
        dim=1,
    )
    check_equal(found, expected, (query, key, value))


def check_equal(ours: torch.Tensor, theirs: torch.Tensor, inputs: tuple) -> None:
    """Compare two outputs and their gradients with respect to the inputs."""
    torch.testing.assert_close(ours, theirs, atol=1e-6, rtol=1e-5)
    weight = torch.linspace(-1, 1, ours.numel()).view_as(ours)
    gradients = (torch.autograd.grad((out * weight).sum(), inputs) for out in (ours, theirs))
    for one, two in zip(*gradients, strict=True):
        torch.testing.assert_close(one, two, atol=1e-5, rtol=1e-5)


def causal(length: int, dtype: torch.dtype) -> torch.Tensor:
    return torch.full((length, length), torch.finfo(dtype).min, dtype=dtype).triu(1)[None, None]


@pytest.mark.parametrize("queries", [33, 20, 1])
@pytest.mark.parametrize("block", [8, 11, 64])
@pytest.mark.parametrize("processor", ["AVX2", "AVX512"])
def test_products_equal_the_librarys_eager_attention(
    queries, block, processor, monkeypatch
) -> None:
    """The last queries attend to all keys before them, of which some are padding.

    With AVX2, fewer than 33 queries use the fused attention.
    """
    monkeypatch.setattr(attention, "MATMUL_BLOCK", block)
    monkeypatch.setattr(attention, "MATMUL_MIN_QUERIES", 33)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: processor)
    calls = []
    apply = attention.ProductAttention.apply
    monkeypatch.setattr(
        attention.ProductAttention, "apply", lambda *inputs: calls.append(1) or apply(*inputs)
    )
    query, key, value = heads(2, 4, 33, 16)
    query = query[:, :, -queries:].detach().requires_grad_()
    key, value = key[:, :2].detach().requires_grad_(), value[:, :2].detach().requires_grad_()
    layer = Layer()
    layer.num_key_value_groups = 2
    layer.eval()
    mask = causal(33, torch.float32).repeat(2, 1, 1, 1)
    mask[1, :, :, : 33 - 28] = torch.finfo(mask.dtype).min
    inputs, mask = (query, key, value), mask[:, :, -queries:]
    # The results of padding, whose keys are all masked, are never read.
    ours, theirs = (
        attend(layer, *inputs, mask, scaling=0.25)[0][:, -28:]
        for attend in (attend_by_matmul, eager_attention_forward)
    )
    assert bool(calls) is (processor == "AVX512" or queries == 33)
    check_equal(ours, theirs, inputs)


def test_products_in_bf16_err_no_more_than_fused_attention() -> None:
    exact = heads(2, 4, 129, 32, dtype=torch.bfloat16)
    wide = [t.detach().double().requires_grad_() for t in exact]
    weight = torch.linspace(-1, 1, exact[0].numel()).view_as(exact[0])

    def passes(attend, inputs) -> list[torch.Tensor]:
        out = attend(*inputs).transpose(1, 2)
        found = torch.autograd.grad((out * weight.transpose(1, 2).to(out.dtype)).sum(), inputs)
        return [t.double() for t in (out, *found)]

    def fused(query, key, value) -> torch.Tensor:
        return nn.functional.scaled_dot_product_attention(query, key, value, is_causal=True)

    def products(query, key, value) -> torch.Tensor:
        mask = causal(129, torch.bfloat16)
        found, _ = attend_by_matmul(Layer(), query, key, value, mask, scaling=32**-0.5)
        return found.transpose(1, 2)

    true, library, ours = passes(fused, wide), passes(fused, exact), passes(products, exact)
    for t, a, b in zip(true, library, ours, strict=True):
        assert (b - t).norm() < 2 * (a - t).norm()


def loss_of(model: PreTrainedModel, batch: dict) -> torch.Tensor:
    batch = dict(batch)
    return token_mean(model(**batch, use_cache=False), batch.pop("labels"))


def test_every_pass_over_the_frames_is_one_call(samples, processor, model, monkeypatch) -> None:
    choose_attention(model, "bf16", LENGTH)
    shapes = []

    def counted(module, query, *args, **settings):
        shapes.append(query.shape)
        return attend_by_matmul(module, query, *args, **settings)

    monkeypatch.setattr(attention, "attend_by_matmul", counted)
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16):
        loss_of(model, Collator(processor, LENGTH)(samples))
    layers = len(model.model.visual.blocks)
    # The images of two samples, and then the frames of their clips.
    assert [shape[0] for shape in shapes] == [2 * 4] * layers + [2 * 6] * layers


def test_attention_depends_on_the_length(model) -> None:
    text, vision = model.config.text_config, model.config.vision_config
    for length, expected in ((MATMUL_MAX_TOKENS, MATMUL), (MATMUL_MAX_TOKENS + 1, "sdpa")):
        choose_attention(model, "fp32", length)
        assert (text._attn_implementation, vision._attn_implementation) == (expected, BY_FRAME)


@pytest.mark.parametrize("length", [MATMUL_MAX_TOKENS, MATMUL_MAX_TOKENS + 1])
@pytest.mark.parametrize("padded", [True, False])
def test_unused_memory_of_the_cache_changes_no_results(
    samples, processor, model, length, padded
) -> None:
    choose_attention(model, "fp32", length)
    batch = Collator(processor, LENGTH)(samples if padded else samples[:1])
    del batch["labels"], batch["logits_to_keep"]
    # The responses end beyond the first block that has room for the prompt.
    settings = {"min_new_tokens": BLOCK + 10, "max_new_tokens": BLOCK + 10, "do_sample": False,
                "return_dict_in_generate": True, "output_logits": True}  # fmt: skip
    with torch.no_grad():
        blocks = model.generate(**batch, **settings, past_key_values=create_cache(model))
        expected = model.generate(**batch, **settings, use_cache=False)
    assert torch.equal(blocks.sequences, expected.sequences)
    torch.testing.assert_close(blocks.logits, expected.logits, atol=1e-5, rtol=0)


@pytest.mark.parametrize("precision", ["bf16", "fp32"])
def test_padding_changes_no_results(samples, processor, model, precision) -> None:
    """Padding makes no value infinite."""
    choose_attention(model, precision, LENGTH)
    collate, reduced = Collator(processor, LENGTH), precision == "bf16"
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=reduced):
        batch = collate(samples)
        counts = [int((collate([s])["labels"] != -100).sum()) for s in samples]
        alone = sum(loss_of(model, collate([s])) * n for s, n in zip(samples, counts, strict=True))
        together = loss_of(model, batch)
    tolerance = 5e-3 if reduced else 1e-5
    torch.testing.assert_close(together, alone / sum(counts), atol=tolerance, rtol=0)


def test_a_saved_model_names_no_attention_of_this_project(model, tmp_path) -> None:
    choose_attention(model, "bf16", LENGTH)
    model.save_pretrained(tmp_path)
    assert "dynapix" not in (tmp_path / "config.json").read_text()
