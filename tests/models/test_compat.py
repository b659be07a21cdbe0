"""The hooks of models.compat. A test fails with an explanation if a library changed its hook."""

from __future__ import annotations

import inspect

import bitsandbytes as bnb
import peft
import pytest
import torch
from peft.tuners.lora import LoraLayer
from peft.tuners.lora.bnb import Linear4bit
from peft.tuners.lora.layer import Linear, LoraVariant
from sentence_transformers import MultiVectorEncoder, SentenceTransformerTrainer
from torch import nn
from transformers import Trainer, TrainingArguments
from transformers.cache_utils import DynamicLayer
from trl import GRPOTrainer
from trl.trainer.utils import RepeatSampler

from dynapix.models import compat
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
