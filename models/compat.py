"""Every private or version-dependent part of the libraries that the project relies on.

Each hook was checked with torch 2.14 to 2.15, transformers 5.17 to 5.23, peft 0.19 to 0.21.2,
accelerate 1.12 to 1.15, sentence-transformers 6.0 to 6.2 and bitsandbytes 0.49 to 0.50.2, unless
its docstring says otherwise. `pyproject.toml` excludes later versions; before it is raised,
tests/models/test_compat.py, which has one test per hook, must pass with them.

Hooks that are used through subclasses or inputs, outside of this file:

- `models.lora_kernels` swaps the class of peft's `Linear` and `Linear4bit` layers, registers a
  `LoraVariant` in their `lora_variant`, and overrides `_cast_input_dtype`.
- `models.attention` registers a function whose name contains "flash": Qwen3-VL's vision tower
  passes all frames at once, with `cu_seq_lens_q` and `max_length_q`, only to those.
- `train.common.training_loop` calls `Trainer._load_from_checkpoint`, which also reads the parts of
  an FSDP checkpoint.
- `models.retriever.multi_vector` loads with `MultiVectorEncoder._load_with_module_classes`.
- `train.retriever.trainer` overrides `_load_from_checkpoint`, `_load_best_model`,
  `get_batch_sampler` and `collect_features`.
- `train.retriever.inputs` adds a model's input in a forward pre-hook, which
  sentence-transformers' `Transformer` passes on to the backbone.
- `train.student.trainer` overrides `_get_train_sampler` of transformers' Trainer.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from transformers import PreTrainedModel, TrainingArguments

if TYPE_CHECKING:
    from transformers.models.qwen3_vl.modeling_qwen3_vl import BaseModelOutputWithDeepstackFeatures


def checkpointing_arguments(enabled: bool) -> dict[str, Any]:
    """Return the arguments of TrainingArguments that recompute activations in the backward pass.

    transformers renamed them: gradient_checkpointing to 5.22, activation_checkpointing since 5.23.
    """
    if not enabled:
        return {}
    renamed = "activation_checkpointing" in {field.name for field in fields(TrainingArguments)}
    name = "activation_checkpointing" if renamed else "gradient_checkpointing"
    return {name: True, f"{name}_kwargs": {"use_reentrant": False}}


def encode_images(
    model: PreTrainedModel, pixels: torch.Tensor, grid: torch.Tensor, bf16: bool
) -> list[torch.Tensor]:
    """Return (layers, tokens, hidden) for each image: the merged output of Qwen3-VL's vision tower,
    then those of the deepstack. The tower encodes a clip as the images of its pairs of frames.

    Args:
        bf16: Whether the tower computes in bf16.
    """
    with torch.no_grad(), torch.autocast(pixels.device.type, torch.bfloat16, enabled=bf16):
        outputs = model.get_image_features(pixels, grid)
    layers = zip(outputs.pooler_output, *outputs.deepstack_features, strict=True)
    return [torch.stack(image) for image in layers]


def encoder_outputs(layers: Iterable[torch.Tensor]) -> BaseModelOutputWithDeepstackFeatures:
    """Return the vision tower's outputs for a kind of media as Qwen3-VL's `forward` takes them in
    `mm_encoder_outputs`."""
    from transformers.models.qwen3_vl.modeling_qwen3_vl import BaseModelOutputWithDeepstackFeatures

    merged, *deepstack = layers
    return BaseModelOutputWithDeepstackFeatures(
        pooler_output=(merged,), deepstack_features=[(layer,) for layer in deepstack]
    )


def keep_differentiable(model: nn.Module) -> None:
    """Keep bitsandbytes from repacking 4-bit weights on a CPU with AVX-512 BF16.

    It repacks them at the first evaluation, unless a layer's `support_avx512bf16_for_cpu` is false,
    and repacked weights pass no gradient on: every later step would train only a part of the model,
    without an error.
    """
    for module in model.modules():
        if hasattr(module, "support_avx512bf16_for_cpu"):
            module.support_avx512bf16_for_cpu = False


def four_bit_entries(parameter: nn.Parameter) -> int | None:
    """Return how many entries a 4-bit parameter of bitsandbytes stands for, None for others.

    The weights are packed as they are loaded; on the meta device they keep their own shape.
    """
    if type(parameter).__name__ != "Params4bit":
        return None
    if parameter.quant_state is not None:
        return parameter.quant_state.shape.numel()
    return parameter.numel() if parameter.is_meta else None


def keep_freed_memory() -> None:
    """Let glibc keep the memory of large tensors between steps.

    By default it returns each block to the kernel at once, and page faults take half of the time of
    a training step on a CPU.
    """
    if not sys.platform.startswith("linux"):
        return
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(mmap_threshold, 1 << 30)
        libc.mallopt(trim_threshold, (1 << 31) - 1)
        libc.mallopt(top_pad, 64 << 20)
