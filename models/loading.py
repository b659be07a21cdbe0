"""Load a student, its base, 4-bit weights and adapters, and write what was trained."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable
from dataclasses import replace
from pathlib import Path

import torch
from safetensors import SafetensorError
from torch import nn
from transformers import (
    AutoConfig,
    AutoModelForImageTextToText,
    AutoProcessor,
    BitsAndBytesConfig,
    PreTrainedModel,
    ProcessorMixin,
)
from transformers.utils import logging as transformers_logging

from conf.errors import UserError
from conf.schema import LoraConfig, StudentConfig
from models.attention import choose_attention
from models.checks import check_adapters, check_processor, check_tower
from models.tiny_qwen3_vl import build_model, build_processor
from models.trained_runs import EXPORT

UNQUANTIZED = ["model.visual", "visual", "lm_head"]
"""Modules that keep their precision. Matching is anchored at the name's start, so the tower is
named both as it stands in the generative model and in the bare one."""
DTYPES = {"bf16": torch.bfloat16, "fp32": torch.float32}
UNREADABLE = (OSError, ValueError, KeyError, TypeError, SafetensorError)
"""What the libraries raise at files that are missing, cut or of another kind."""

Corpus = Callable[[], Iterable[str]]

# A model's shards load in moments, and peft asks transformers by a name that is about to go.
transformers_logging.disable_progress_bar()
warnings.filterwarnings("ignore", "`is_gradient_checkpointing`", FutureWarning)


def load_base(
    cfg: StudentConfig, precision: str, corpus: Corpus
) -> tuple[PreTrainedModel, ProcessorMixin]:
    """The base that a preset names, or builds from a seed, with its processor.

    `corpus` gives the texts that a built model's tokenizer is trained on.

    Raises:
        UserError: the model is neither a folder here nor in the hub's cache, and cannot be fetched;
            it has no vision tower, or a processor of another model.
    """
    if cfg.architecture is not None:
        processor = build_processor(corpus(), cfg.architecture.vocabulary, cfg.image_size)
        pin_sizes(processor, cfg.image_size, cfg.frames)
        model = build_model(cfg.architecture, len(processor.tokenizer))
        choose_attention(model, precision, cfg.max_length)
        return model, processor
    check_reachable("student", cfg.model)
    origin = {"revision": cfg.revision, "trust_remote_code": cfg.trust_remote_code}
    # Weights that are trained stay fp32 and are computed in lower precision by autocast.
    whole = cfg.quantization == "none" and cfg.lora.rank == 0
    dtype = torch.float32 if whole else DTYPES[precision]
    quantization = nf4_config(dtype) if cfg.quantization == "nf4" else None
    try:
        config = AutoConfig.from_pretrained(cfg.model, **origin)
        check_tower("student", cfg.model, config)
        processor = AutoProcessor.from_pretrained(cfg.model, **origin)
        check_processor("student", cfg.model, config, processor)
        model = AutoModelForImageTextToText.from_pretrained(
            cfg.model,
            dtype=dtype,
            quantization_config=quantization,
            use_safetensors=True,
            **origin,
        )
    except UNREADABLE as error:
        raise load_error("student", cfg.model, error) from error
    choose_attention(model, precision, cfg.max_length)
    pin_sizes(processor, cfg.image_size, cfg.frames)
    processor.tokenizer.padding_side = "left"
    return model, processor


def nf4_config(compute: torch.dtype) -> BitsAndBytesConfig:
    """4-bit NF4 for the language tower; vision tower and head keep their precision."""
    return BitsAndBytesConfig(
        load_in_4bit=True,
        bnb_4bit_quant_type="nf4",
        bnb_4bit_compute_dtype=compute,
        llm_int8_skip_modules=UNQUANTIZED,
    )


def check_reachable(group: str, model: str, key: str = "model") -> None:
    """Ask once whether a model can be had, before libraries try again and again for minutes.

    Raises:
        UserError: it is no folder here, not in the hub's cache, and cannot be fetched.
    """
    from huggingface_hub import model_info, try_to_load_from_cache

    if Path(model).is_dir():
        return
    try:
        # Adapters have no settings of a whole model beside them.
        files = ("config.json", "adapter_config.json")
        if not any(isinstance(try_to_load_from_cache(model, file), str) for file in files):
            model_info(model, timeout=10)
    except Exception as error:
        # The hub's client raises errors of whichever HTTP library it has; all mean the same here.
        raise load_error(group, model, error, key) from error


def load_error(group: str, model: str, error: Exception, key: str = "model") -> UserError:
    """What to tell a user whose model did not load."""
    first = next(iter(str(error).strip().splitlines()), type(error).__name__)
    if Path(model).is_dir():
        return UserError(f"{group}.{key}={model} cannot be loaded from that folder: {first}")
    if Path(model).is_absolute() or model.startswith("."):
        return UserError(f"{group}.{key}={model}: there is no such folder; give the one it is in")
    return UserError(
        f"{group}.{key}={model} is not on this machine and cannot be fetched: there is no "
        f"folder of that name, and the hub's cache does not hold it. Point at a local copy with "
        f"{group}.{key}=FOLDER (config.json, *.safetensors, tokenizer and processor files), or "
        f"fetch it where there is a network with: hf download {model}"
    )


def damaged_error(
    folder: Path, error: Exception, mend: str = "delete the run's folder and train again"
) -> UserError:
    """What to tell a user whose trained model cannot be read back."""
    first = next(iter(str(error).strip().splitlines()), type(error).__name__)
    return UserError(f"{folder} is damaged and cannot be read ({first}): {mend}")


def pin_sizes(processor: ProcessorMixin, image_size: int, frames: int) -> None:
    """Keep frames of image_size x image_size px at the nearest size on the tower's grid, in an
    image and in a video of up to `frames` alike. By default a video is shrunk to a budget that an
    image does not have, and one frame comes in two sizes."""
    step = processor.image_processor.patch_size * processor.image_processor.merge_size
    edge = round(image_size / step) * step
    smallest = step * step
    processor.image_processor.size = {"shortest_edge": smallest, "longest_edge": edge * edge}
    # Twice the pixels there are: frames of a shorter or odd video fall under no budget either.
    processor.video_processor.size = {
        "shortest_edge": smallest,
        "longest_edge": 2 * frames * edge * edge,
    }
    processor.video_processor.do_sample_frames = False
    processor.video_processor.cap_pixels_per_frame = False


def add_adapters(model: PreTrainedModel, lora: LoraConfig) -> nn.Module:
    """Freeze the base and add LoRA to the language tower's projections. Adapters are fp32 even
    over a bf16 base: updates of this size vanish in bf16's steps.

    Raises:
        UserError: the pattern is none, or matches no module that can be adapted.
    """
    import peft

    model.requires_grad_(False)
    config = peft.LoraConfig(
        r=lora.rank,
        lora_alpha=lora.alpha,
        lora_dropout=lora.dropout,
        target_modules=lora.targets,
        task_type="CAUSAL_LM",
    )
    try:
        return peft.get_peft_model(model, config)
    except (ValueError, re.error) as error:
        raise no_targets_error("student", lora) from error


def no_targets_error(group: str, lora: LoraConfig) -> UserError:
    """What to tell a user whose pattern matches nothing that can be adapted."""
    return UserError(
        f"{group}.lora.targets={lora.targets} adapts nothing in this model: give a pattern that "
        "matches whole names of linear layers, such as "
        "model.language_model.layers.0.self_attn.q_proj"
    )


def load_student(
    cfg: StudentConfig, precision: str, corpus: Corpus
) -> tuple[nn.Module, ProcessorMixin]:
    """A student ready to train: its base, with adapters where the preset has them."""
    base, processor = load_base(cfg, precision, corpus)
    # Each tower has a setting of its own.
    base.config.use_cache = base.config.get_text_config().use_cache = False
    keep_differentiable(base)
    return (add_adapters(base, cfg.lora) if cfg.lora.rank else base), processor


def keep_differentiable(model: nn.Module) -> None:
    """Keep bitsandbytes from repacking 4-bit weights on a CPU with AVX-512 BF16. It does so at the
    first evaluation, and what is packed passes no gradient on: every later step would silently
    train on a part of it."""
    for module in model.modules():
        if hasattr(module, "support_avx512bf16_for_cpu"):
            module.support_avx512bf16_for_cpu = False


def load_trained(
    cfg: StudentConfig, precision: str, folder: Path
) -> tuple[nn.Module, ProcessorMixin]:
    """A trained student as `save` wrote it, ready to answer: adapters over their base, or a whole
    model.

    Raises:
        UserError: `folder` holds no student, or one of another base or rank, or its base is not on
            this machine.
    """
    import peft

    if (folder / "adapter_config.json").exists():
        # peft would read a pickle where there are no safetensors.
        if not (weights := folder / "adapter_model.safetensors").exists():
            raise UserError(f"{folder} holds no student: {weights} is missing")
        base, processor = load_base(cfg, precision, list)
        try:
            check_adapters(folder, base, cfg)
            return for_inference(peft.PeftModel.from_pretrained(base, folder)), processor
        except UNREADABLE as error:
            raise damaged_error(folder, error) from error
    if (folder / EXPORT).exists():
        return load_merged(folder)
    whole = replace(
        cfg, model=str(folder), architecture=None, quantization="none", lora=LoraConfig(rank=0)
    )
    model, processor = load_base(whole, precision, list)
    return for_inference(model), processor


def merge_adapters(
    base: PreTrainedModel, adapters: Path, quantization: str, precision: str
) -> PreTrainedModel:
    """A base as its 4-bit weights say it, with the adapters in a folder added in `precision`.

    Merged into the 4-bit weights themselves, most of what was trained would be rounded away; over
    the base as it was before it was quantised, the adapters would miss what they were trained to
    make up for.
    """
    import peft

    dtype = DTYPES[precision]
    if quantization == "nf4":
        base = base.dequantize(dtype)
    return peft.PeftModel.from_pretrained(base.to(dtype), adapters).merge_and_unload()


def load_merged(folder: Path) -> tuple[PreTrainedModel, ProcessorMixin]:
    """A student merged into its base, as `train.export` wrote it: in the precision of its weights,
    and with nothing that the standard classes do not read themselves.

    Raises:
        UserError: it cannot be read.
    """
    try:
        processor = AutoProcessor.from_pretrained(folder)
        model = AutoModelForImageTextToText.from_pretrained(
            folder, dtype="auto", use_safetensors=True
        )
    except UNREADABLE as error:
        raise damaged_error(folder, error, "delete it and export again") from error
    processor.tokenizer.padding_side = "left"
    return for_inference(model), processor


def for_inference(model: nn.Module) -> nn.Module:
    """A model ready to answer, on the GPU where there is one: unlike a 4-bit model, one that is not
    quantised is loaded beside the CPU."""
    return model.to("cuda" if torch.cuda.is_available() else "cpu").eval()


def save_student(
    model: nn.Module,
    processor: ProcessorMixin,
    folder: Path,
    precision: str,
    weights: dict[str, torch.Tensor] | None = None,
) -> None:
    """Write what was trained, the adapters or the whole model, and the processor that goes with
    it. A whole model is written in the precision that it computed in. `weights` are the model's
    where it holds a part of them.

    Raises:
        UserError: the disk does not take it.
    """
    import peft

    if not isinstance(model, peft.PeftModel):
        model = model.to(DTYPES[precision])
        model.config.use_cache = model.config.get_text_config().use_cache = True
        if weights is not None:
            weights = {name: weight.to(DTYPES[precision]) for name, weight in weights.items()}
    write_model(model, processor, folder, weights)


def write_model(
    model: nn.Module,
    processor: ProcessorMixin,
    folder: Path,
    weights: dict[str, torch.Tensor] | None = None,
) -> None:
    """Write a model, or its adapters, and its processor as they are; `weights` where the model
    holds a part of them.

    Raises:
        UserError: the disk does not take it.
    """
    try:
        model.save_pretrained(folder, state_dict=weights)
    except SafetensorError as error:
        raise unwritable_error(folder.parent, str(error)) from error
    processor.save_pretrained(folder)


def unwritable_error(folder: Path, why: str) -> UserError:
    """What to tell a user whose disk did not take the weights. Unlike a full disk's OSError, what
    the libraries raise names no file, and what filled the disk may be gone again."""
    return UserError(
        f"the weights cannot be written to {folder} ({why}); once that is mended, run the same "
        "command again"
    )
