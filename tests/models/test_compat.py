"""The hooks of models.compat. A test fails with an explanation if a library changed its hook."""

from __future__ import annotations

import ctypes
import inspect
import sys

import bitsandbytes as bnb
import peft
import pytest
import torch
from peft.tuners.lora import LoraLayer
from peft.tuners.lora.bnb import Linear4bit
from peft.tuners.lora.layer import Linear, LoraVariant
from sentence_transformers import MultiVectorEncoder, SentenceTransformerTrainer
from sentence_transformers.base.modules import Dense
from torch import nn
from transformers import AttentionInterface, AttentionMaskInterface, Trainer, TrainingArguments
from transformers.cache_utils import DynamicLayer
from trl import GRPOTrainer
from trl.trainer.utils import RepeatSampler

from dynapix.models import compat
from dynapix.models.layers import attention
from dynapix.models.layers.fast_layers import use_fast_layers

CHANGED = "a library changed this hook; correct models/compat.py or the version bounds:"


def test_checkpointing_arguments_recompute_activations(tmp_path) -> None:
    for enabled in (True, False):
        arguments = TrainingArguments(
            output_dir=str(tmp_path), use_cpu=True, **compat.checkpointing_arguments(enabled)
        )
        names = ("activation_checkpointing", "gradient_checkpointing")
        found = any(getattr(arguments, name, None) for name in names)
        assert found == enabled, f"{CHANGED} TrainingArguments recomputes activations otherwise"


def test_4_bit_weights_are_not_repacked() -> None:
    layer = bnb.nn.Linear4bit(8, 8)
    assert hasattr(layer, "support_avx512bf16_for_cpu"), (
        f"{CHANGED} bitsandbytes repacks 4-bit weights on a CPU under another name"
    )
    layer.support_avx512bf16_for_cpu = True
    compat.keep_differentiable(nn.Sequential(layer))
    assert not layer.support_avx512bf16_for_cpu


def test_4_bit_weights_count_as_the_entries_that_they_stand_for() -> None:
    layer = bnb.nn.Linear4bit(64, 64, bias=False).to("cpu")
    assert layer.weight.numel() < 64 * 64
    assert compat.four_bit_entries(layer.weight) == 64 * 64, (
        f"{CHANGED} Params4bit.quant_state does not hold the shape"
    )
    assert compat.four_bit_entries(nn.Linear(4, 4).weight) is None


def test_a_vision_tower_passes_all_frames_to_a_function_named_flash(model) -> None:
    assert attention.BY_FRAME in AttentionInterface().valid_keys()
    assert attention.MATMUL in AttentionMaskInterface().valid_keys()
    model.set_attn_implementation({"vision_config": attention.BY_FRAME})
    calls = []

    def record(module, query, key, value, attention_mask, **settings):
        calls.append(settings)
        return attention.attend_by_frame(module, query, key, value, attention_mask, **settings)

    AttentionInterface.register(attention.BY_FRAME, record)
    try:
        grid = torch.tensor([[3, 4, 4]])
        model.model.visual(torch.zeros(48, 3 * 2 * 16 * 16), grid_thw=grid)
    finally:
        AttentionInterface.register(attention.BY_FRAME, attention.attend_by_frame)
    bounds = {tuple(settings["cu_seq_lens_q"].tolist()) for settings in calls}
    assert bounds == {(0, 16, 32, 48)}, (
        f"{CHANGED} Qwen3-VL's vision tower does not pass all frames at once"
    )


def test_peft_layers_use_a_lora_variant(model) -> None:
    assert issubclass(Linear, LoraLayer)
    assert issubclass(Linear4bit, LoraLayer)
    assert hasattr(LoraVariant, "forward"), f"{CHANGED} peft's LoraVariant has no forward"
    adapted = peft.get_peft_model(model, peft.LoraConfig(target_modules=["q_proj"], r=2))
    use_fast_layers(adapted)
    layers = [m for m in adapted.modules() if isinstance(m, LoraLayer)]
    assert layers
    assert all(m.lora_variant for m in layers), f"{CHANGED} peft's layers have no lora_variant"
    assert "lora_variant" in inspect.getsource(Linear.forward), (
        f"{CHANGED} the forward of peft's Linear does not use lora_variant"
    )


def test_qwen3_vl_takes_the_vision_towers_outputs_instead_of_pixels(model) -> None:
    token, grid = model.config.image_token_id, torch.tensor([[1, 4, 4]])
    ids = torch.tensor([[10, *[token] * 4, 11]])
    inputs = {"input_ids": ids, "image_grid_thw": grid, "mm_token_type_ids": (ids == token).long()}
    pixels = torch.randn(16, 3 * 2 * 16 * 16)
    with torch.no_grad():
        (image,) = compat.encode_images(model, pixels, grid, bf16=False)
        outputs = {"image": compat.encoder_outputs(image)}
        cached = model(**inputs, mm_encoder_outputs=outputs).logits
        direct = model(**inputs, pixel_values=pixels).logits
    assert torch.equal(cached, direct), f"{CHANGED} mm_encoder_outputs does not replace the pixels"


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (MultiVectorEncoder, ["_load_with_module_classes"]),
        (Trainer, ["_get_train_sampler", "_load_from_checkpoint", "get_batch_samples",
                   "_get_num_items_in_batch"]),
        (GRPOTrainer, ["_send_telemetry", "create_model_card"]),
        (SentenceTransformerTrainer,
         ["_load_from_checkpoint", "get_batch_sampler", "collect_features",
          "add_model_card_callback"]),
        (Linear4bit, ["_cast_input_dtype"]),
    ],
)  # fmt: skip
def test_overridden_methods_exist(kind, names) -> None:
    for name in names:
        assert hasattr(kind, name), f"{CHANGED} {kind.__name__}.{name} is gone"


@pytest.mark.parametrize(
    ("kind", "names"),
    [
        (GRPOTrainer,
         ["_generate_and_score_completions", "_calculate_rewards", "_compute_loss",
          "_get_per_token_logps_and_entropies", "_get_train_sampler"]),
        (DynamicLayer, ["lazy_initialization", "get_mask_sizes", "get_seq_length", "update"]),
    ],
)  # fmt: skip
def test_classes_define_methods_that_their_bases_have_too(kind, names) -> None:
    for name in names:
        assert name in vars(kind), f"{CHANGED} {kind.__name__} inherits {name}"


def test_grpo_trainer_keeps_measures_and_an_order_that_can_be_seeded() -> None:
    initialised = inspect.getsource(GRPOTrainer.__init__)
    for name in ("self._metrics =", "self.rollout_func ="):
        assert name in initialised, f"{CHANGED} GRPOTrainer has no {name}"
    sampler = RepeatSampler(range(4), mini_repeat_count=1, seed=0)
    assert isinstance(sampler.generator, torch.Generator), (
        f"{CHANGED} RepeatSampler has no generator"
    )


def test_the_projection_of_a_multi_vector_model_takes_a_dict_with_token_embeddings() -> None:
    received = []
    projection = Dense(4, 2, activation_function=None, module_input_name="token_embeddings")
    projection.register_forward_pre_hook(lambda module, args: received.append(args))
    projection({"token_embeddings": torch.ones(1, 3, 4)})
    assert "token_embeddings" in received[0][0], (
        f"{CHANGED} the projection of sentence-transformers takes another input"
    )


def test_freed_memory_is_kept_by_mallopt() -> None:
    compat.keep_freed_memory()
    if sys.platform == "linux":
        assert hasattr(ctypes.CDLL(None), "mallopt"), f"{CHANGED} libc has no mallopt"
