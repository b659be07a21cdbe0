"""A model that computes in fewer operations gives what it gives without."""

from __future__ import annotations

from dataclasses import replace

import peft
import pytest
import torch
from torch import nn

from conf.schema import LoraConfig
from models import loading
from models.lora_kernels import AddedInPlace, PatchProduct, fuse, unfuse
from models.student.collator import Collator
from models.student.prompts import selection_sample
from train.student.trainer import token_mean

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
    for name, weight in model.named_parameters():
        if "lora_B" in name:
            nn.init.normal_(weight, std=0.1)
    items = micro_store.selection("train")[:2]
    shown = [selection_sample(i, "answer", "cot", frames, cfg.frames, "Answer: A") for i in items]
    batch = Collator(processor, 1500)(shown)
    return model.train(), batch, cfg.lora.rank > 0


def passed(model: nn.Module, batch: dict) -> tuple[torch.Tensor, dict[str, torch.Tensor]]:
    """The loss, and every gradient, of the same dropout."""
    model.zero_grad()
    torch.manual_seed(1)
    given = {name: value for name, value in batch.items() if name not in ("labels", "sample_ids")}
    loss = token_mean(model(**given), batch["labels"])
    loss.backward()
    found = {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}
    return loss.detach(), found


def test_loss_and_every_gradient_are_the_same(student) -> None:
    model, batch, adapted = student
    plain, gradients = passed(model, batch)
    fuse(model)
    fused, found = passed(model, batch)
    assert any(isinstance(module, PatchProduct) for module in model.modules())
    variants = [v for m in model.modules() for v in getattr(m, "lora_variant", {}).values()]
    assert bool(variants) is adapted
    assert all(isinstance(v, AddedInPlace) for v in variants)
    torch.testing.assert_close(fused, plain, rtol=1e-5, atol=0)
    assert found.keys() == gradients.keys()
    for name, gradient in gradients.items():
        assert (found[name] - gradient).norm() <= 1e-4 * gradient.norm(), name
    unfuse(model)
    again, _ = passed(model, batch)
    assert torch.equal(again, plain)


def test_bf16_is_no_further_from_fp32_than_without(student) -> None:
    model, batch, _ = student
    exact, _ = passed(model, batch)

    def apart() -> float:
        with torch.autocast("cpu", torch.bfloat16):
            return abs(passed(model, batch)[0] - exact).item()

    plain = apart()
    fuse(model)
    assert apart() <= max(2 * plain, 2e-2 * exact.item())


def test_what_is_saved_is_the_same_and_gives_the_same_elsewhere(student, tmp_path) -> None:
    model, batch, adapted = student
    before = {name: value.clone() for name, value in model.state_dict().items()}
    fuse(model)
    after = model.state_dict()
    assert after.keys() == before.keys()
    assert all(torch.equal(after[name], value) for name, value in before.items())
    if adapted:
        given = {k: v for k, v in batch.items() if k not in ("labels", "sample_ids")}
        with torch.no_grad():
            fused = model.eval()(**given).logits
            model.save_pretrained(tmp_path)
            unfuse(model)
            again = peft.PeftModel.from_pretrained(model.unload(), tmp_path).eval()
            torch.testing.assert_close(again(**given).logits, fused, atol=1e-4, rtol=1e-4)
