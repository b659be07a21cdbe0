"""Adapters are loaded whole, or not at all."""

from __future__ import annotations

import pytest
import torch
from safetensors.torch import load_file, save_file

from dynapix.models import loading
from dynapix.models.checks import ADAPTER_WEIGHTS
from tests.tiny_models import randomize_adapters
from tests.user_errors import raises_user_error

CHANGES = {
    "another layer": lambda weights: {k.replace("layers.0", "layers.9"): w for k, w in weights},
    "a missing layer": lambda weights: {k: w for k, w in weights if "layers.0" not in k},
    "another rank": lambda weights: {k: w[:2] if "lora_A" in k else w[:, :2] for k, w in weights},
}


@pytest.mark.parametrize("change", CHANGES)
def test_adapters_that_do_not_fit_the_model_are_refused(nf4_cfg, tmp_path, change) -> None:
    torch.manual_seed(0)
    model, processor = loading.load_student(nf4_cfg, "fp32", list)
    randomize_adapters(model, 0.05)
    loading.save_student(model, processor, tmp_path, "fp32")
    loading.load_trained(nf4_cfg, "fp32", tmp_path)

    changed = CHANGES[change](load_file(tmp_path / ADAPTER_WEIGHTS).items())
    save_file({name: w.contiguous() for name, w in changed.items()}, tmp_path / ADAPTER_WEIGHTS)
    with raises_user_error("damaged-file", contains=str(tmp_path)):
        loading.load_trained(nf4_cfg, "fp32", tmp_path)
