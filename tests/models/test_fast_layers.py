"""The faster operations give the same results."""

from __future__ import annotations

import copy
from dataclasses import replace

import peft
import pytest
import torch
from torch import nn

from dynapix.conf.schema import LoraConfig
from dynapix.models import loading
from dynapix.models.layers.fast_layers import (
    AddedInPlace,
    FastAttention,
    FrozenNorm,
    PatchProduct,
    RowsLinear,
    use_fast_layers,
)
from dynapix.models.student.collator import Collator
from dynapix.models.student.prompts import selection_sample
from tests.tiny_models import assert_equal_gradients, loss_and_gradients, randomize_adapters


@pytest.mark.parametrize(
    "kind",
    [
        {"lora": LoraConfig(rank=4, alpha=12, dropout=0.2)},
        {"quantization": "none", "lora": LoraConfig(rank=4)},
        {"quantization": "none", "lora": LoraConfig(rank=0)},
    ],
    ids=["nf4", "unquantised", "whole"],
)
def test_loss_gradients_and_saved_weights_are_the_same(
    kind, nf4_cfg, micro_store, frames, tmp_path
) -> None:
    """In bf16, the loss is rounded no more."""
    cfg = replace(nf4_cfg, **kind)
    torch.manual_seed(0)
    model, processor = loading.load_student(cfg, "fp32", list)
    randomize_adapters(model.train(), 0.1)
    items = micro_store.selection("train")[:2]
    samples = [selection_sample(i, "answer", "cot", frames, cfg.frames, "Answer: A") for i in items]
    batch = Collator(processor, 1500)(samples)

    def error_in_bf16(exact: torch.Tensor) -> float:
        with torch.autocast("cpu", torch.bfloat16):
            return abs(loss_and_gradients(model, batch)[0] - exact).item()

    plain, gradients = loss_and_gradients(model, batch)
    plain_error = error_in_bf16(plain)
    before = {name: value.clone() for name, value in model.state_dict().items()}
    without = copy.deepcopy(model)
    use_fast_layers(model)
    fused, computed = loss_and_gradients(model, batch)
    for layer in (PatchProduct, FastAttention, FrozenNorm):
        assert any(isinstance(module, layer) for module in model.modules())
    variants = [v for m in model.modules() for v in getattr(m, "lora_variant", {}).values()]
    assert bool(variants) is (cfg.lora.rank > 0)
    assert all(isinstance(v, AddedInPlace) for v in variants)
    torch.testing.assert_close(fused, plain, rtol=1e-5, atol=0)
    assert_equal_gradients(computed, gradients)
    assert error_in_bf16(plain) <= max(2 * plain_error, 2e-2 * plain.item())

    after = model.state_dict()
    assert after.keys() == before.keys()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    if variants:
        inputs = {k: v for k, v in batch.items() if k != "labels"}
        with torch.no_grad():
            fused = model.eval()(**inputs).logits
            model.save_pretrained(tmp_path)
            again = peft.PeftModel.from_pretrained(without.unload(), tmp_path).eval()
            torch.testing.assert_close(again(**inputs).logits, fused, atol=1e-4, rtol=1e-4)


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
