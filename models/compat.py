"""Functions that rely on private or version-dependent parts of libraries ("hooks").

All hooks were checked with torch 2.14 to 2.15, transformers 5.18 to 5.23, peft 0.19 to 0.21.2,
accelerate 1.15, sentence-transformers 6.2, trl 1.16 and bitsandbytes 0.49 to 0.50.2, unless
a docstring says otherwise. `pyproject.toml` excludes later versions. Before it admits them, all
tests must pass with them; tests/models/test_compat.py names most hooks that a library changed, and
the tests of the modules below fail for the others.

Hooks in other modules, which subclass a library's classes or depend on how it passes its inputs:

- `models.layers.fast_layers` swaps the class of peft's `Linear` and `Linear4bit` layers, registers
  a `LoraVariant` in their `lora_variant`, and overrides `_cast_input_dtype`. It and
  `models.retriever.last_token` swap the classes of norms, attention, the last layer and the text
  tower of transformers' Qwen3-VL. `models.layers.shared_prompts` gives the text tower a mask of
  four dimensions, from `create_causal_mask` with an `and_mask_function`.
- `models.layers.attention` registers a function whose name contains "flash", because Qwen3-VL's
  vision tower then passes all frames in one call, with `cu_seq_lens_q` and `max_length_q`.
- `train.common.training_loop` calls `Trainer._load_from_checkpoint`, which also reads the parts of
  an FSDP checkpoint.
- `models.loading` leaves the weights of an FSDP rank without values if transformers and accelerate
  distribute those of the main rank (FSDP_CPU_RAM_EFFICIENT_LOADING).
- `models.retriever.multi_vector` loads with `MultiVectorEncoder._load_with_module_classes`, and a
  forward pre-hook casts `token_embeddings` in the inputs of the projection.
- `train.retriever.trainer` overrides `_load_from_checkpoint`, `get_batch_sampler`,
  `collect_features` and `add_model_card_callback`.
- `train.retriever.inputs` adds an input in a forward pre-hook of sentence-transformers'
  `Transformer`, which passes it on to its model.
- `train.student.trainer` overrides `_get_train_sampler` of transformers' Trainer, and
  `train.on_policy.distillation` overrides `get_batch_samples` and calls `_get_num_items_in_batch`.
- `train.on_policy.reinforcement` overrides `_generate_and_score_completions`, `_calculate_rewards`,
  `_compute_loss`, `_get_per_token_logps_and_entropies`, `_get_train_sampler`, `_send_telemetry`
  and `create_model_card` of TRL's GRPOTrainer, uses its `rollout_func`, `_metrics` and
  `_tokenizer`, and the `generator` of its RepeatSampler. It sets `beta` and `ref_model`, adds
  `tool_mask` to the inputs of the loss, and changes their `advantages` while the loss computes the
  log-probabilities. Its datasets override `Dataset.__getitems__`.
- `models.student.kv_cache` subclasses transformers' `DynamicLayer`.
- `research.tiny_base.trace` records the outputs of `q_norm` and `k_norm` in Qwen3-VL's attention,
  and the keyword `position_embeddings` that it takes.
- `train.retriever.loss` uses `RandContext` of sentence-transformers.
- `evaluation.embedders.languagebind` subclasses transformers' `CLIPEncoderLayer`.
"""

from __future__ import annotations

import ctypes
import sys
from collections.abc import Iterable
from dataclasses import fields
from typing import TYPE_CHECKING, Any

import torch
from torch import nn
from transformers import PreTrainedModel, ProcessorMixin, Qwen3VLProcessor, TrainingArguments

if TYPE_CHECKING:
    from transformers.modeling_outputs import BaseModelOutputWithPooling


def checkpointing_arguments(enabled: bool) -> dict[str, Any]:
    """Return the arguments of TrainingArguments for recomputing activations in the backward pass.

    The name is gradient_checkpointing up to transformers 5.22, activation_checkpointing from 5.23.
    """
    renamed = "activation_checkpointing" in {field.name for field in fields(TrainingArguments)}
    name = "activation_checkpointing" if renamed else "gradient_checkpointing"
    return {name: enabled, f"{name}_kwargs": {"use_reentrant": False} if enabled else None}


def encode_images(
    model: PreTrainedModel, pixels: torch.Tensor, grid: torch.Tensor, bf16: bool
) -> list[torch.Tensor]:
    """Return the outputs of a vision tower of Qwen for each row of `grid`: an image, a clip, or a
    pair of a clip's frames.

    Args:
        bf16: Whether the tower computes in bf16.

    Returns:
        (1 + deepstack layers, tokens, hidden) tensors: the merged output, then the deepstack's, of
        which only Qwen3-VL has any.
    """
    with torch.no_grad(), torch.autocast(pixels.device.type, torch.bfloat16, enabled=bf16):
        outputs = model.get_image_features(pixels, grid)
    layers = [outputs.pooler_output, *getattr(outputs, "deepstack_features", [])]
    return [torch.stack(image) for image in zip(*layers, strict=True)]


def encoder_outputs(layers: Iterable[torch.Tensor]) -> BaseModelOutputWithPooling:
    """Return the vision tower's outputs for images or clips as an entry of `mm_encoder_outputs`,
    which the `forward` of a Qwen model takes instead of pixels. `layers` are as in
    `encode_images`."""
    from transformers.models.qwen3_vl.modeling_qwen3_vl import BaseModelOutputWithDeepstackFeatures

    merged, *deepstack = layers
    return BaseModelOutputWithDeepstackFeatures(
        pooler_output=(merged,), deepstack_features=[(layer,) for layer in deepstack]
    )


def write_clips_as_released(processor: ProcessorMixin) -> None:
    """Let the prompts of a Qwen3-VL have one pair of vision tokens around each group of frames.

    Released chat templates write a clip as `<|vision_start|><|video_pad|><|vision_end|>`. The
    processors of that time replaced these three tokens; since transformers 5.10 they replace the
    placeholder alone, and a second pair would remain around the whole clip.
    """
    if isinstance(processor, Qwen3VLProcessor) and processor.chat_template:
        clip = processor.video_token
        marked = f"{processor.vision_start_token}{clip}{processor.vision_end_token}"
        processor.chat_template = processor.chat_template.replace(marked, clip)


def keep_differentiable(model: nn.Module) -> None:
    """Keep bitsandbytes from repacking 4-bit weights on a CPU with AVX-512 BF16.

    It repacks a layer's weights in the first evaluation, unless the layer's
    `support_avx512bf16_for_cpu` is false. Repacked weights pass no gradient on, so all later steps
    would train only a part of the model, without an error.
    """
    for module in model.modules():
        if hasattr(module, "support_avx512bf16_for_cpu"):
            module.support_avx512bf16_for_cpu = False


def four_bit_entries(parameter: nn.Parameter) -> int | None:
    """Return the number of weights in a 4-bit parameter of bitsandbytes; None for other
    parameters and for those that are not packed yet.

    Loading packs the weights, two in a byte. On the meta device, the parameter keeps the shape that
    the weights have before packing.
    """
    if type(parameter).__name__ != "Params4bit":
        return None
    if parameter.quant_state is not None:
        return parameter.quant_state.shape.numel()
    return parameter.numel() if parameter.is_meta else None


def keep_freed_memory() -> None:
    """Let glibc keep the memory of large tensors between steps.

    By default, glibc returns each freed block to the kernel at once, and page faults take half of
    the time of a training step on a CPU.
    """
    if not sys.platform.startswith("linux"):
        return
    trim_threshold, top_pad, mmap_threshold = -1, -2, -3
    libc = ctypes.CDLL(None)
    if hasattr(libc, "mallopt"):
        libc.mallopt(mmap_threshold, 1 << 30)
        libc.mallopt(trim_threshold, (1 << 31) - 1)
        libc.mallopt(top_pad, 64 << 20)
