"""The paper's presets, checked on models that are built from the released config.json on the meta
device, so that neither weights nor a GPU are needed."""

from __future__ import annotations

import json
import re
from dataclasses import replace
from functools import cache
from pathlib import Path
from typing import Any

import bitsandbytes as bnb
import pytest
import torch
from peft.tuners.lora import LoraLayer
from torch import nn
from transformers import (
    AutoModel,
    AutoModelForImageTextToText,
    BitsAndBytesConfig,
    PreTrainedModel,
    ProcessorMixin,
    Qwen2VLImageProcessor,
    Qwen3VLConfig,
    Qwen3VLProcessor,
    Qwen3VLVideoProcessor,
)
from transformers.quantizers.auto import AutoHfQuantizer

from dynapix.conf.compose import compose
from dynapix.conf.schema import LoraConfig, SftCommand, StudentConfig, TeacherConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import FPS, sample_prefix_frames
from dynapix.models import loading
from dynapix.models.student.collator import Collator, encode
from dynapix.models.student.prompts import (
    build_response,
    selection_sample,
)
from dynapix.models.towers import check_parameter_counts, count_parameters
from dynapix.teacher.narrate import ensure_rationales
from dynapix.train.common.audit import audit_student
from dynapix.train.student.dataset import supervised_items
from tests.user_errors import raises_user_error

RELEASED = {"qwen3_vl_8b": 8_767_123_696, "qwen3_vl_2b": 2_127_532_032}
"""Parameters in the safetensors of Qwen/Qwen3-VL-8B-Instruct and Qwen/Qwen3-VL-2B-Instruct."""
RANK = 16
RELEASED_PIXELS = {
    "image": {"shortest_edge": 65536, "longest_edge": 16777216},
    "video": {"shortest_edge": 4096, "longest_edge": 25165824},
}
"""Numbers of pixels in the files of the released processors; the defaults of the classes differ."""

presets = pytest.mark.parametrize("preset", RELEASED)


def student(preset: str) -> StudentConfig:
    return compose("train.sft", SftCommand, [f"student={preset}"]).student


def config_of(preset: str) -> dict[str, Any]:
    return json.loads((Path(__file__).parent / "configs" / f"{preset}.json").read_text())


def base_of(
    preset: str, quantization: BitsAndBytesConfig | None, kind: Any = AutoModelForImageTextToText
) -> PreTrainedModel:
    """Return a preset's base as `from_pretrained` builds it before it loads weights: in bf16, with
    quantised layers in place of linear layers."""
    # from_dict modifies the dictionary, so each base gets its own copy.
    config = Qwen3VLConfig.from_dict(config_of(preset))
    with torch.device("meta"):
        model = kind.from_config(config, dtype=torch.bfloat16)
    if quantization is not None:
        quantizer = AutoHfQuantizer.from_config(quantization, pre_quantized=False)
        quantizer.preprocess_model(model, device_map={"": "cpu"})
        quantizer.postprocess_model(model)
    return model


def nf4() -> BitsAndBytesConfig:
    return loading.nf4_config(torch.bfloat16, ["model.visual", "visual", "lm_head"])


@cache
def adapted(preset: str) -> nn.Module:
    """Return a preset's student with its adapters; tests must not change it."""
    return loading.add_adapters(base_of(preset, nf4()), student(preset).lora)


def projections(text: dict[str, Any]) -> dict[str, tuple[int, int]]:
    """Return the input and output sizes of each projection of a language layer."""
    hidden, forward = text["hidden_size"], text["intermediate_size"]
    queries = text["num_attention_heads"] * text["head_dim"]
    keys = text["num_key_value_heads"] * text["head_dim"]
    return {
        "self_attn.q_proj": (hidden, queries),
        "self_attn.k_proj": (hidden, keys),
        "self_attn.v_proj": (hidden, keys),
        "self_attn.o_proj": (queries, hidden),
        "mlp.gate_proj": (hidden, forward),
        "mlp.up_proj": (hidden, forward),
        "mlp.down_proj": (forward, hidden),
    }


def expected_towers(preset: str, rank: int) -> dict[str, list[int]]:
    """Return the counts, computed from the released modules and the sizes of the projections."""
    base = base_of(preset, None)
    text = config_of(preset)["text_config"]
    layers, sides = text["num_hidden_layers"], projections(text).values()
    four_bit = layers * sum(inputs * outputs for inputs, outputs in sides)
    lora = layers * sum(rank * (inputs + outputs) for inputs, outputs in sides)

    def count(module: nn.Module) -> int:
        return sum(p.numel() for p in module.parameters())

    vision, language = count(base.model.visual), count(base.model.language_model.layers)
    return {
        "vision": [vision, 0, 0, 0],
        "language": [language + lora, four_bit, lora, lora],
        "embeddings and head": [count(base) - vision - language, 0, 0, 0],
    }


def projection_names(preset: str, prefix: str) -> set[str]:
    text = config_of(preset)["text_config"]
    return {
        f"{prefix}layers.{layer}.{name}"
        for layer in range(text["num_hidden_layers"])
        for name in projections(text)
    }


def names_of(model: nn.Module, kind: type) -> set[str]:
    return {name for name, module in model.named_modules() if isinstance(module, kind)}


@presets
def test_settings_are_those_of_the_paper(preset) -> None:
    cfg = compose("train.sft", SftCommand, [f"student={preset}"])
    student, train = cfg.student, cfg.train
    assert (student.quantization, student.lora.rank, student.lora.alpha) == ("nf4", RANK, 32)
    assert (student.frames, student.image_size, student.max_length) == (12, 336, 3072)
    # The paper has micro-batches of 1, which change speed and memory but not the gradients.
    assert (train.lr, train.epochs, train.batch) == (2e-5, 3, 16)
    assert train.precision == "bf16"


@presets
def test_the_base_has_as_many_parameters_as_the_released_model(preset) -> None:
    base = base_of(preset, None)
    assert sum(p.numel() for p in base.parameters()) == RELEASED[preset]


@presets
def test_counts_equal_those_computed_from_the_sizes(preset) -> None:
    towers = count_parameters(adapted(preset))
    assert towers.T.to_dict("list") == expected_towers(preset, RANK)
    cfg = student(preset)
    check_parameter_counts(towers, cfg.name, cfg.quantization, cfg.lora.rank)


@presets
def test_only_projections_of_the_language_tower_are_quantised_and_adapted(preset) -> None:
    model = adapted(preset)
    wanted = projection_names(preset, "base_model.model.model.language_model.")
    assert names_of(model, LoraLayer) == wanted
    assert names_of(model, bnb.nn.Linear4bit) == {f"{name}.base_layer" for name in wanted}


@presets
def test_the_head_is_not_quantised_and_is_tied_as_released(preset) -> None:
    base = base_of(preset, nf4())
    assert type(base.lm_head) is nn.Linear
    tied = base.lm_head.weight is base.model.language_model.embed_tokens.weight
    assert tied == config_of(preset)["tie_word_embeddings"]


@presets
def test_a_bare_model_is_quantised_the_same_way(preset) -> None:
    """A retriever has no head, and its names start one level further down."""
    base = base_of(preset, nf4(), AutoModel)
    assert names_of(base, bnb.nn.Linear4bit) == projection_names(preset, "language_model.")


@presets
@pytest.mark.parametrize("quantized", [True, False], ids=["nf4", "none"])
def test_adapters_are_fp32_over_a_base_that_stays_bf16(preset, quantized) -> None:
    lora = student(preset).lora
    model = adapted(preset) if quantized else loading.add_adapters(base_of(preset, None), lora)
    parameters = dict(model.named_parameters())
    adapters = {name for name in parameters if "lora_" in name}
    assert {parameters[name].dtype for name in adapters} == {torch.float32}
    assert {name for name, p in parameters.items() if p.requires_grad} == adapters
    kept = [p for n, p in parameters.items() if n not in adapters]
    assert {p.dtype for p in kept if not isinstance(p, bnb.nn.Params4bit)} == {torch.bfloat16}


@pytest.mark.parametrize(
    ("changed", "message"),
    [
        ({"skipped": ["visual", "lm_head"]}, "vision has some 4-bit parameters"),
        ({"skipped": ["model.visual"]}, "embeddings and head has some 4-bit parameters"),
        (
            {"skipped": ["model.visual", "model.language_model", "lm_head"]},
            "language has no 4-bit parameters",
        ),
        ({"targets": "all-linear"}, "vision has some LoRA parameters"),
        ({"targets": r".*\.(qkv|q_proj)"}, "vision has some LoRA parameters"),
        ({"targets": r".*\.embed_tokens"}, "embeddings and head has some LoRA parameters"),
    ],
)
def test_only_the_language_tower_may_be_quantised_and_adapted(changed, message) -> None:
    quantization, cfg = nf4(), student("qwen3_vl_2b")
    quantization.llm_int8_skip_modules = changed.get("skipped", quantization.llm_int8_skip_modules)
    lora = replace(cfg.lora, targets=changed.get("targets"))
    model = loading.add_adapters(base_of(cfg.name, quantization), lora)
    with raises_user_error("other-parameters", contains=message):
        check_parameter_counts(count_parameters(model), cfg.name, cfg.quantization, cfg.lora.rank)


@pytest.mark.parametrize("targets", ["q_proj", "model.(language_model", r".*\.input_layernorm"])
def test_a_pattern_that_adapts_nothing_is_named(targets) -> None:
    with raises_user_error("no-lora-targets", contains=targets):
        loading.add_adapters(base_of("qwen3_vl_2b", nf4()), LoraConfig(targets=targets))


def released_processor(
    source: ProcessorMixin, pixels: dict[str, dict[str, int]]
) -> Qwen3VLProcessor:
    """Return the released models' processor with the sizes `pixels` and the tokenizer of `source`,
    which splits rationales into more tokens than the released one."""

    def sized(name: str) -> dict[str, Any]:
        return {"size": pixels[name]} if name in pixels else {}

    return Qwen3VLProcessor(
        image_processor=Qwen2VLImageProcessor(patch_size=16, **sized("image")),
        tokenizer=source.tokenizer,
        video_processor=Qwen3VLVideoProcessor(**sized("video")),
        chat_template=source.chat_template,
    )


@pytest.mark.parametrize("pixels", [RELEASED_PIXELS, {}], ids=["released", "class defaults"])
@presets
def test_frames_are_resized_to_320_px_and_have_their_true_times(
    preset, pixels, micro_store, processor
) -> None:
    cfg = student(preset)
    released = released_processor(processor, pixels)
    loading.pin_sizes(released, cfg.image_size, cfg.frames)
    item = next(
        i for i in micro_store.selection("train") if i.prefix_stop - i.prefix_start >= cfg.frames
    )
    frames = FrameReader(micro_store, cfg.image_size)
    sample = selection_sample(item, "reasoning", "cot", frames, cfg.frames)
    encoded = encode(sample, released, cfg.max_length)
    # 336 px are ten and a half cells of 32 px.
    assert encoded.media["video_grid_thw"].tolist() == [[6, 20, 20]]
    assert encoded.media["image_grid_thw"].tolist() == [[1, 20, 20]] * 4
    assert encoded.input_ids.count(released.video_token_id) == 6 * 100
    assert encoded.input_ids.count(released.image_token_id) == 4 * 100
    shown = sample_prefix_frames(item.prefix_start, item.prefix_stop, cfg.frames)
    assert len(shown) == cfg.frames
    # A patch covers two frames; its timestamp is the mean of their times.
    times = [(a + b) / 2 / FPS for a, b in zip(shown[::2], shown[1::2], strict=True)]
    timestamps = re.findall(r"<(\d+\.\d) seconds>", released.tokenizer.decode(encoded.input_ids))
    assert timestamps == [f"{time:.1f}" for time in times]


@presets
def test_the_longest_rationale_fits_and_the_audit_needs_no_weights(
    preset, micro_store, processor
) -> None:
    cfg = student(preset)
    released = released_processor(processor, RELEASED_PIXELS)
    loading.pin_sizes(released, cfg.image_size, cfg.frames)
    teacher = TeacherConfig(name="template")
    rationales = {r.item_id: r for r in ensure_rationales(micro_store, teacher)}
    regime = compose("train.sft", SftCommand, [f"student={preset}"]).train.regime
    items = micro_store.selection("train")
    supervised = supervised_items(micro_store, items, rationales, regime, teacher)["reasoning"]
    longest = max(supervised, key=lambda s: len(s.text))
    words = longest.rationale.split()
    more = " ".join((words * 250)[: 250 - len(words)])
    rationale = f"{more}\n{longest.rationale}"
    assert len(rationale.split()) == 250
    target = build_response(rationale, longest.matches, longest.item.letter, "reasoning", regime)
    frames = FrameReader(micro_store, cfg.image_size)
    sample = selection_sample(longest.item, "reasoning", regime, frames, cfg.frames, target)
    text = audit_student(adapted(preset), released, cfg, sample, Collator(released, cfg.max_length))
    assert "336 x 336 px become a video of 6 x 10 x 10 tokens and an image of 1 x 10 x 10" in text
    assert text.count(">>>") == 1
    false = replace(sample, false_spans=((20, 30),))
    text = audit_student(adapted(preset), released, cfg, false, Collator(released, cfg.max_length))
    assert text.count(">>>") == 2
    for parameters, *_ in expected_towers(preset, RANK).values():
        assert f"{parameters:,}" in text
