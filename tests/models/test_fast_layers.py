"""The faster operations give the same results."""

from __future__ import annotations

import copy
from dataclasses import replace

import peft
import pytest
import torch
from torch import nn
from transformers.models.qwen3_vl.modeling_qwen3_vl import (
    Qwen3VLTextRMSNorm,
    apply_rotary_pos_emb,
)

from dynapix.conf.schema import LoraConfig
from dynapix.models import loading
from dynapix.models.layers.fast_layers import (
    AddedInPlace,
    FastAttention,
    FrozenNorm,
    Normed,
    NormedRotation,
    PatchProduct,
    RowsLinear,
    use_fast_layers,
)
from dynapix.models.student.collator import Collator
from dynapix.models.student.prompts import selection_sample
from tests.tiny_models import assert_equal_gradients, loss_and_gradients, randomize_adapters

KINDS = {
    "nf4": {"lora": LoraConfig(rank=4, alpha=12, dropout=0.2)},
    "unquantised": {"quantization": "none", "lora": LoraConfig(rank=4)},
    "whole": {"quantization": "none", "lora": LoraConfig(rank=0)},
}


@pytest.fixture(params=KINDS)
def student(request, nf4_cfg, micro_store, frames):
    """A model, a batch, and whether adapters are trained."""
    cfg = replace(nf4_cfg, **KINDS[request.param])
    torch.manual_seed(0)
    model, processor = loading.load_student(cfg, "fp32", list)
    randomize_adapters(model, 0.1)
    items = micro_store.selection("train")[:2]
    samples = [selection_sample(i, "answer", "cot", frames, cfg.frames, "Answer: A") for i in items]
    batch = Collator(processor, 1500)(samples)
    return model.train(), batch, cfg.lora.rank > 0


def test_loss_and_every_gradient_are_the_same(student) -> None:
    model, batch, adapted = student
    plain, gradients = loss_and_gradients(model, batch)
    use_fast_layers(model)
    fused, computed = loss_and_gradients(model, batch)
    for kind in (PatchProduct, FastAttention, FrozenNorm):
        assert any(isinstance(module, kind) for module in model.modules())
    variants = [v for m in model.modules() for v in getattr(m, "lora_variant", {}).values()]
    assert bool(variants) is adapted
    assert all(isinstance(v, AddedInPlace) for v in variants)
    torch.testing.assert_close(fused, plain, rtol=1e-5, atol=0)
    assert_equal_gradients(computed, gradients)


def test_norms_and_rotations_equal_those_of_transformers() -> None:
    """In bf16, they round no more."""
    torch.manual_seed(0)
    norm = Qwen3VLTextRMSNorm(6).requires_grad_(False)
    nn.init.uniform_(norm.weight, 0.5, 2)
    # A rotation uses the same angles in both halves of a head.
    cos, sin = (torch.randn(2, 5, 3).repeat(1, 1, 2) for _ in range(2))
    heads, gradient = torch.randn(2, 5, 4, 6), torch.randn(2, 5, 4, 6)

    def passes(is_ours: bool, rotates: bool, dtype: torch.dtype) -> list[torch.Tensor]:
        x, own = heads.detach().to(dtype).requires_grad_(), copy.deepcopy(norm).to(dtype)
        settings = own.weight, own.variance_epsilon
        positions = cos.to(dtype), sin.to(dtype)
        if is_ours:
            y = (NormedRotation if rotates else Normed).apply(
                x, *settings, *positions[: 2 * rotates]
            )
        else:
            y = own(x)
            if rotates:
                y = apply_rotary_pos_emb(y, y, *positions, unsqueeze_dim=2)[0]
        y.backward(gradient.to(dtype))
        assert y.dtype == x.grad.dtype == dtype
        return [y.detach().float(), x.grad.float()]

    for rotates in (False, True):
        exact, ours = (passes(own, rotates, torch.float32) for own in (False, True))
        torch.testing.assert_close(ours, exact)
        library, reduced = (passes(own, rotates, torch.bfloat16) for own in (False, True))
        for true, one, two in zip(exact, library, reduced, strict=True):
            assert 0 < (two - true).norm() < 1.2 * (one - true).norm()


def test_fused_operations_round_no_more_in_bf16(student) -> None:
    model, batch, _ = student
    exact, _ = loss_and_gradients(model, batch)

    def difference() -> float:
        with torch.autocast("cpu", torch.bfloat16):
            return abs(loss_and_gradients(model, batch)[0] - exact).item()

    plain = difference()
    use_fast_layers(model)
    assert difference() <= max(2 * plain, 2e-2 * exact.item())


def test_layers_of_a_bf16_base_keep_their_input_once_and_cast_no_activation() -> None:
    """Linear layers with the same input, as those of queries and keys, save it once together."""
    projections = nn.ModuleDict({name: nn.Linear(32, 48) for name in ("q_proj", "k_proj")})
    config = peft.LoraConfig(r=4, target_modules=["q_proj", "k_proj"])
    adapted = peft.get_peft_model(nn.Sequential(projections).bfloat16(), config)
    use_fast_layers(adapted)
    layers = [m for m in adapted.modules() if isinstance(m, RowsLinear)]
    assert len(layers) == 2
    assert all(layer.lora_A["default"].weight.dtype == torch.float32 for layer in layers)
    x = torch.randn(2, 5, 32, dtype=torch.bfloat16, requires_grad=True)
    saved: list[torch.Tensor] = []

    def keep(tensor: torch.Tensor) -> torch.Tensor:
        saved.append(tensor)
        return tensor

    with (
        torch.autograd.graph.saved_tensors_hooks(keep, lambda tensor: tensor),
        torch.autocast("cpu", torch.bfloat16),
    ):
        outputs = [layer(x) for layer in layers]
    assert {output.dtype for output in outputs} == {torch.bfloat16}
    rows = [tensor for tensor in saved if tensor.numel() == x.numel()]
    assert {tensor.data_ptr() for tensor in rows} == {x.data_ptr()}
    assert len({tensor.dtype for tensor in saved if len(tensor) == 10}) == 1


def test_saved_weights_are_unchanged_and_give_the_same_logits(student, tmp_path) -> None:
    model, batch, adapted = student
    before = {name: value.clone() for name, value in model.state_dict().items()}
    plain = copy.deepcopy(model)
    use_fast_layers(model)
    after = model.state_dict()
    assert after.keys() == before.keys()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    if adapted:
        inputs = {k: v for k, v in batch.items() if k != "labels"}
        with torch.no_grad():
            fused = model.eval()(**inputs).logits
            model.save_pretrained(tmp_path)
            again = peft.PeftModel.from_pretrained(plain.unload(), tmp_path).eval()
            torch.testing.assert_close(again(**inputs).logits, fused, atol=1e-4, rtol=1e-4)
