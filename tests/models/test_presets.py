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
from dynapix.conf.schema import SftCommand, StudentConfig, TeacherConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import FPS, sample_prefix_frames
from dynapix.models import loading
from dynapix.models.student.collator import Collator, encode
from dynapix.models.student.prompts import build_response, selection_sample
from dynapix.models.towers import check_parameter_counts, count_parameters
from dynapix.teacher.narrate import ensure_rationales
from dynapix.train.common.audit import audit_student
from dynapix.train.student.dataset import supervised_items
from tests.user_errors import raises_user_error

RELEASED = {"qwen3_vl_8b": 8_767_123_696, "qwen3_vl_2b": 2_127_532_032}
"""Parameters in the safetensors of Qwen/Qwen3-VL-8B-Instruct and Qwen/Qwen3-VL-2B-Instruct."""
SMALLER, LARGER = "qwen3_vl_2b", "qwen3_vl_8b"
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


def projection_names(preset: str, prefix: str) -> set[str]:
    """Return the names of the projections of all language layers."""
    names = [f"self_attn.{name}_proj" for name in "qkvo"]
    names += [f"mlp.{name}_proj" for name in ("gate", "up", "down")]
    layers = config_of(preset)["text_config"]["num_hidden_layers"]
    return {f"{prefix}layers.{layer}.{name}" for layer in range(layers) for name in names}


def names_of(model: nn.Module, kind: type) -> set[str]:
    return {name for name, module in model.named_modules() if isinstance(module, kind)}


@presets
def test_settings_are_those_of_the_paper(preset) -> None:
    cfg = compose("train.sft", SftCommand, [f"student={preset}"])
    student, train = cfg.student, cfg.train
    assert (student.quantization, student.lora.rank, student.lora.alpha) == ("nf4", 16, 32)
    assert (student.frames, student.image_size, student.max_length) == (12, 336, 3072)
    # The paper has micro-batches of 1, which change speed and memory but not the gradients.
    assert (train.lr, train.epochs, train.batch, train.precision) == (2e-5, 3, 16, "bf16")


@presets
def test_only_projections_of_the_language_tower_are_quantised_and_adapted(preset) -> None:
    """The head is not quantised, and is tied as released."""
    plain = base_of(preset, None)
    assert sum(p.numel() for p in plain.parameters()) == RELEASED[preset]
    model, cfg = adapted(preset), student(preset)
    wanted = projection_names(preset, "base_model.model.model.language_model.")
    assert names_of(model, LoraLayer) == wanted
    assert names_of(model, bnb.nn.Linear4bit) == {f"{name}.base_layer" for name in wanted}
    head = model.get_base_model().lm_head
    assert type(head) is nn.Linear
    tied = head.weight is model.get_base_model().model.language_model.embed_tokens.weight
    assert tied == config_of(preset)["tie_word_embeddings"]
    check_parameter_counts(count_parameters(model), cfg.name, cfg.quantization, cfg.lora.rank)
    # Adapters are in fp32, over a base that stays in bf16.
    for each in (model, loading.add_adapters(plain, cfg.lora)):
        parameters = dict(each.named_parameters())
        adapters = {name for name in parameters if "lora_" in name}
        assert {parameters[name].dtype for name in adapters} == {torch.float32}
        assert {name for name, p in parameters.items() if p.requires_grad} == adapters
        kept = [p for n, p in parameters.items() if n not in adapters]
        assert {p.dtype for p in kept if not isinstance(p, bnb.nn.Params4bit)} == {torch.bfloat16}


def test_a_bare_model_is_quantised_the_same_way() -> None:
    """A retriever has no head, and its names start one level further down."""
    base = base_of(SMALLER, nf4(), AutoModel)
    assert names_of(base, bnb.nn.Linear4bit) == projection_names(SMALLER, "language_model.")


@pytest.mark.parametrize(
    ("skipped", "targets", "code", "message"),
    [
        (["visual", "lm_head"], None, "other-parameters", "vision has some 4-bit parameters"),
        (["model.visual"], None, "other-parameters", "head has some 4-bit parameters"),
        (None, r".*\.(qkv|q_proj)", "other-parameters", "vision has some LoRA parameters"),
        (None, r".*\.embed_tokens", "other-parameters", "head has some LoRA parameters"),
        (None, "q_proj", "no-lora-targets", "q_proj"),
        (None, "model.(language_model", "no-lora-targets", "model.(language_model"),
    ],
)
def test_only_the_language_tower_may_be_quantised_and_adapted(
    skipped, targets, code, message
) -> None:
    """A pattern that adapts nothing is named."""
    quantization, cfg = nf4(), student(SMALLER)
    quantization.llm_int8_skip_modules = skipped or quantization.llm_int8_skip_modules
    with raises_user_error(code, contains=message):
        base = base_of(cfg.name, quantization)
        model = loading.add_adapters(base, replace(cfg.lora, targets=targets))
        check_parameter_counts(count_parameters(model), cfg.name, cfg.quantization, cfg.lora.rank)


def released_processor(
    source: ProcessorMixin, cfg: StudentConfig, pixels: dict[str, dict[str, int]]
) -> Qwen3VLProcessor:
    """Return the released models' processor as a preset changes it, with the sizes `pixels` and the
    tokenizer of `source`, which splits rationales into more tokens than the released one."""
    sizes = {name: {"size": pixels[name]} if pixels else {} for name in RELEASED_PIXELS}
    processor = Qwen3VLProcessor(
        image_processor=Qwen2VLImageProcessor(patch_size=16, **sizes["image"]),
        tokenizer=source.tokenizer,
        video_processor=Qwen3VLVideoProcessor(**sizes["video"]),
        chat_template=source.chat_template,
    )
    loading.pin_sizes(processor, cfg.image_size, cfg.frames)
    return processor


@pytest.mark.parametrize("pixels", [RELEASED_PIXELS, {}], ids=["released", "class defaults"])
def test_frames_are_resized_to_320_px_and_have_their_true_times(
    pixels, micro_store, processor
) -> None:
    cfg = student(LARGER)
    released = released_processor(processor, cfg, pixels)
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
    # A patch covers two frames; its timestamp is the mean of their times.
    times = [(a + b) / 2 / FPS for a, b in zip(shown[::2], shown[1::2], strict=True)]
    assert len(times) == 6
    timestamps = re.findall(r"<(\d+\.\d) seconds>", released.tokenizer.decode(encoded.input_ids))
    assert timestamps == [f"{time:.1f}" for time in times]


def test_the_longest_rationale_fits_and_the_audit_needs_no_weights(micro_store, processor) -> None:
    cfg = student(LARGER)
    released = released_processor(processor, cfg, RELEASED_PIXELS)
    teacher = TeacherConfig(name="template")
    rationales = {r.item_id: r for r in ensure_rationales(micro_store, teacher)}
    items = micro_store.selection("train")
    supervised = supervised_items(micro_store, items, rationales, "cot", teacher)["reasoning"]
    longest = max(supervised, key=lambda s: len(s.text))
    words = longest.rationale.split()
    more = " ".join((words * 250)[: 250 - len(words)])
    rationale = f"{more}\n{longest.rationale}"
    target = build_response(rationale, longest.matches, longest.item.letter, "reasoning", "cot")
    frames = FrameReader(micro_store, cfg.image_size)
    sample = selection_sample(longest.item, "reasoning", "cot", frames, cfg.frames, target)
    model, collator = adapted(LARGER), Collator(released, cfg.max_length)
    text = audit_student(model, released, cfg, sample, collator)
    assert "336 x 336 px become a video of 6 x 10 x 10 tokens and an image of 1 x 10 x 10" in text
    assert text.count(">>>") == 1
    for parameters in count_parameters(model)["parameters"]:
        assert f"{parameters:,}" in text
    false = replace(sample, false_spans=((20, 30),))
    assert audit_student(model, released, cfg, false, collator).count(">>>") == 2
