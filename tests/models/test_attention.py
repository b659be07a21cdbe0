"""The chosen attention gives the results of the library's own."""

from __future__ import annotations

import pytest
import torch
from torch import nn
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


def heads(*shape: int) -> list[torch.Tensor]:
    """Return a random query, key and value."""
    generator = torch.Generator().manual_seed(0)
    return [torch.randn(shape, generator=generator) for _ in range(3)]


class Layer(nn.Module):
    num_key_value_groups = 1


@pytest.mark.parametrize("lengths", [[7] * 5, [7, 7, 3, 7], [9]])
def test_all_frames_at_once_equal_frames_one_by_one(lengths) -> None:
    parts = heads(1, 2, sum(lengths), 8)
    found, _ = attend_by_frame(
        Layer(), *parts, None, scaling=0.3, max_length_q=max(lengths),
        cu_seq_lens_q=torch.tensor([0, *lengths]).cumsum(0),
    )  # fmt: skip
    frames = zip(*(part.split(lengths, dim=2) for part in parts), strict=True)
    expected = [eager_attention_forward(Layer(), *frame, None, 0.3)[0] for frame in frames]
    torch.testing.assert_close(found, torch.cat(expected, dim=1), atol=1e-6, rtol=1e-5)


@pytest.mark.parametrize("queries", [33, 20, 1])
@pytest.mark.parametrize("dtype", [torch.float32, torch.bfloat16])
@pytest.mark.parametrize(("block", "processor"), [(8, "AVX512"), (11, "AVX512"), (64, "AVX2")])
def test_products_equal_the_librarys_eager_attention(
    queries, dtype, block, processor, monkeypatch
) -> None:
    """The last queries attend to all keys before them, of which some are padding. With AVX2, fewer
    than 33 queries use the fused attention. In bf16, the errors are no larger than the library's.
    """
    monkeypatch.setattr(attention, "MATMUL_BLOCK", block)
    monkeypatch.setattr(attention, "MATMUL_MIN_QUERIES", 33)
    monkeypatch.setattr(torch.backends.cpu, "get_cpu_capability", lambda: processor)
    query, key, value = heads(2, 4, 33, 16)
    layer = Layer().eval()
    layer.num_key_value_groups = 2
    mask = torch.full((33, 33), torch.finfo(dtype).min, dtype=dtype).triu(1).repeat(2, 1, 1, 1)
    mask[1, :, :, : 33 - 28] = torch.finfo(dtype).min

    def passes(attend, dtype: torch.dtype) -> list[torch.Tensor]:
        """Return the output and the gradients of the inputs."""
        inputs = [query[:, :, -queries:], key[:, :2], value[:, :2]]
        inputs = [part.to(torch.bfloat16).to(dtype).requires_grad_() for part in inputs]
        # The results of padding, whose keys are all masked, are never read.
        out = attend(layer, *inputs, mask[:, :, -queries:].to(dtype), scaling=0.25)[0][:, -28:]
        weight = torch.linspace(-1, 1, out.numel()).view_as(out)
        gradients = torch.autograd.grad((out * weight.to(dtype)).sum(), inputs)
        return [part.float() for part in (out, *gradients)]

    exact = passes(eager_attention_forward, torch.float32)
    library, ours = (passes(each, dtype) for each in (eager_attention_forward, attend_by_matmul))
    for true, one, two in zip(exact, library, ours, strict=True):
        if dtype == torch.float32:
            torch.testing.assert_close(two, true, atol=1e-5, rtol=1e-5)
        assert (two - true).norm() <= 2 * (one - true).norm() + 1e-4 * true.norm()


def test_attention_is_chosen_by_length_and_is_not_saved(model, tmp_path) -> None:
    text, vision = model.config.text_config, model.config.vision_config
    for length, expected in ((MATMUL_MAX_TOKENS, MATMUL), (MATMUL_MAX_TOKENS + 1, "sdpa")):
        choose_attention(model, "fp32", length)
        assert (text._attn_implementation, vision._attn_implementation) == (expected, BY_FRAME)
    model.save_pretrained(tmp_path)
    assert "dynapix" not in (tmp_path / "config.json").read_text()


@pytest.mark.parametrize(
    ("length", "padded"), [(MATMUL_MAX_TOKENS, True), (MATMUL_MAX_TOKENS + 1, False)]
)
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
        expected = model.generate(**batch, **settings)
    assert torch.equal(blocks.sequences, expected.sequences)
    torch.testing.assert_close(blocks.logits, expected.logits, atol=1e-5, rtol=0)


@pytest.mark.parametrize("precision", ["bf16", "fp32"])
def test_padding_changes_no_results(samples, processor, model, precision, monkeypatch) -> None:
    """Padding makes no value infinite. In bf16, each pass over a batch of frames is one call."""
    choose_attention(model, precision, LENGTH)
    frames = []
    attend = attention.attend_by_matmul
    monkeypatch.setattr(
        attention,
        "attend_by_matmul",
        lambda module, query, *rest, **settings: (
            frames.append(len(query)) or attend(module, query, *rest, **settings)
        ),
    )

    def loss_of(some: list[Sample]) -> tuple[torch.Tensor, int]:
        batch = Collator(processor, LENGTH)(some)
        labels = batch.pop("labels")
        loss = token_mean(model(**batch, use_cache=False), labels)
        return loss, int((labels != -100).sum())

    reduced = precision == "bf16"
    with torch.no_grad(), torch.autocast("cpu", torch.bfloat16, enabled=reduced):
        together, count = loss_of(samples)
        # The images of two samples, and then the frames of their clips.
        layers = len(model.model.visual.blocks)
        assert frames == ([2 * 4] * layers + [2 * 6] * layers) * reduced
        alone = sum(loss * n for loss, n in (loss_of([sample]) for sample in samples))
    tolerance = 5e-3 if reduced else 1e-5
    torch.testing.assert_close(together, alone / count, atol=tolerance, rtol=0)
