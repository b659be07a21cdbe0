"""The hooks of models.compat. A test fails with an explanation if a library changed its hook."""

from __future__ import annotations

import inspect

import bitsandbytes as bnb
import pytest
import torch
from peft.tuners.lora.bnb import Linear4bit
from peft.tuners.lora.layer import Linear
from sentence_transformers import MultiVectorEncoder, SentenceTransformerTrainer
from torch import nn
from transformers import Trainer, TrainingArguments
from transformers.cache_utils import DynamicLayer
from trl import GRPOTrainer
from trl.trainer.utils import RepeatSampler

from dynapix.models import compat

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
    assert hasattr(layer, "support_avx512bf16_for_cpu"), f"{CHANGED} bitsandbytes repacks otherwise"
    layer.support_avx512bf16_for_cpu = True
    compat.keep_differentiable(nn.Sequential(layer))
    assert not layer.support_avx512bf16_for_cpu


@pytest.mark.parametrize(
    ("kind", "is_own", "names"),
    [
        (MultiVectorEncoder, False, "_load_with_module_classes"),
        (Trainer, False, "_get_train_sampler _load_from_checkpoint get_batch_samples "
                         "_get_num_items_in_batch"),
        (SentenceTransformerTrainer, False, "_load_from_checkpoint get_batch_sampler "
                                            "collect_features add_model_card_callback"),
        (Linear4bit, False, "_cast_input_dtype"),
        (GRPOTrainer, False, "_send_telemetry create_model_card"),
        (GRPOTrainer, True, "_generate_and_score_completions _calculate_rewards _compute_loss "
                            "_get_per_token_logps_and_entropies _get_train_sampler"),
        (DynamicLayer, True, "lazy_initialization get_mask_sizes get_seq_length update"),
    ],
)  # fmt: skip
def test_overridden_methods_exist(kind, is_own, names) -> None:
    """The class itself must define some of them (`is_own`), which its bases have too."""
    for name in names.split():
        defined = name in vars(kind) if is_own else hasattr(kind, name)
        assert defined, f"{CHANGED} {kind.__name__}.{name} is gone or inherited"


def test_libraries_use_what_the_project_sets() -> None:
    assert "lora_variant" in inspect.getsource(Linear.forward), CHANGED
    for name in ("self._metrics =", "self.rollout_func ="):
        assert name in inspect.getsource(GRPOTrainer.__init__), f"{CHANGED} no {name}"
    sampler = RepeatSampler(range(4), mini_repeat_count=1, seed=0)
    assert isinstance(sampler.generator, torch.Generator), CHANGED
