"""Load students: bases, quantised or not, with or without adapters. Save trained students."""

from __future__ import annotations

import re
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import replace
from functools import partial
from pathlib import Path
from typing import Any

import torch
from safetensors import SafetensorError, safe_open
from torch import nn
from transformers import (
    AutoConfig,
    AutoModelForImageTextToText,
    AutoProcessor,
    BitsAndBytesConfig,
    PreTrainedModel,
    ProcessorMixin,
    Qwen2VLProcessor,
    Qwen3VLVideoProcessor,
)
from transformers.utils import logging as transformers_logging

from dynapix.conf.errors import UserError
from dynapix.conf.schema import LoraConfig, RetrieverConfig, StudentConfig
from dynapix.models.checks import (
    ADAPTER_CONFIG,
    ADAPTER_WEIGHTS,
    check_available,
    check_complete,
    check_family,
    check_processor,
    first_line,
)
from dynapix.models.compat import keep_differentiable, write_clips_as_released
from dynapix.models.distributed import is_sharded, lacks_weights, rank_device
from dynapix.models.layers.attention import choose_attention
from dynapix.models.student.chat_format import TIMED_PROCESSORS
from dynapix.models.tiny_qwen3_vl import build_model, build_processor
from dynapix.models.towers import choose_lora_targets, find_unquantized
from dynapix.models.trained_runs import EXPORT

DTYPES = {"bf16": torch.bfloat16, "fp32": torch.float32}
CROPS = ("do_image_splitting", "crop_to_patches", "do_pan_and_scan")
"""Options of image processors that divide an image into crops."""
LOAD_ERRORS = (ImportError, OSError, ValueError, KeyError, TypeError, SafetensorError)
"""Errors that libraries raise for files that are missing, truncated or of another kind, and for
processors that need a library which is not installed."""

Corpus = Callable[[], Iterable[str]]
"""Returns the texts on which the tokenizer of a built model is trained."""

# Progress bars for a model's shards are noise, and peft uses a name that transformers deprecates.
transformers_logging.disable_progress_bar()
warnings.filterwarnings("ignore", "`is_gradient_checkpointing`", FutureWarning)


def load_base(
    cfg: StudentConfig, precision: str, corpus: Corpus, sharded: bool = False
) -> tuple[PreTrainedModel, ProcessorMixin]:
    """Load the base that a preset names and its processor, or build them from its architecture.

    Args:
        corpus: Only called if the base is built.
        sharded: As in `weight_options`.

    Raises:
        UserError: The model is neither a local folder nor in the hub's cache and cannot be
            downloaded, it is no vision-language model, or its processor belongs to another model.
    """
    if cfg.architecture is not None:
        sizes = cfg.architecture
        processor = build_processor(corpus(), sizes.vocabulary, cfg.image_size, sizes.patch)
        pin_sizes(processor, cfg.image_size, cfg.frames)
        model = build_model(sizes, len(processor.tokenizer))
        choose_attention(model, precision, cfg.max_length)
        return model, processor
    origin = {"revision": cfg.revision, "trust_remote_code": cfg.trust_remote_code}
    with explain_unloadable("student", cfg.model):
        config = AutoConfig.from_pretrained(cfg.model, **origin)
        check_family(cfg.model, config)
        processor = AutoProcessor.from_pretrained(cfg.model, **origin)
        check_processor("student", cfg.model, config, processor)
        code = {"trust_remote_code": cfg.trust_remote_code}
        kept = find_unquantized(AutoModelForImageTextToText, config, **code)
        model, info = AutoModelForImageTextToText.from_pretrained(
            cfg.model,
            **weight_options(cfg, precision, kept, sharded),
            **origin,
            output_loading_info=True,
        )
        check_complete(cfg.model, info["missing_keys"])
    write_clips_as_released(processor)
    choose_attention(model, precision, cfg.max_length)
    pin_sizes(processor, cfg.image_size, cfg.frames)
    processor.tokenizer.padding_side = "left"
    return model, processor


def weight_options(
    cfg: StudentConfig | RetrieverConfig,
    precision: str,
    unquantized: Sequence[str],
    sharded: bool = False,
) -> dict[str, Any]:
    """Return the arguments of `from_pretrained` for the weights of a preset.

    If the whole model is trained, its weights are fp32; in bf16, autocast casts them for each
    operation. Otherwise the base's weights are 4-bit or, if the preset does not quantise them, in
    the given precision.

    Args:
        unquantized: Names of modules that are not quantised (see `models.towers`).
        sharded: Whether the model will be sharded. Its unquantised weights are then loaded by one
            rank only: on the others they have no values (device meta), until the trainer
            distributes them.
    """
    trains_all = cfg.quantization == "none" and cfg.lora.rank == 0
    dtype = torch.float32 if trains_all else DTYPES[precision]
    options: dict[str, Any] = {"dtype": dtype, "use_safetensors": True}
    if cfg.quantization == "nf4":
        options["quantization_config"] = nf4_config(dtype, unquantized)
    elif sharded:
        return options | ({"device_map": {"": "meta"}} if lacks_weights() else {})
    return options | place_weights()


def place_weights() -> dict[str, Any]:
    """Return the arguments of `from_pretrained` that load weights straight onto this rank's GPU, if
    there is one."""
    return {"device_map": {"": rank_device()}} if torch.cuda.is_available() else {}


def nf4_config(compute: torch.dtype, unquantized: Sequence[str]) -> BitsAndBytesConfig:
    """Return a configuration that quantises a model to 4-bit NF4, except the modules in
    `unquantized`. Computations dequantise the weights to the type `compute`."""
    return BitsAndBytesConfig(
        load_in_4bit=True,
        bnb_4bit_quant_type="nf4",
        bnb_4bit_compute_dtype=compute,
        llm_int8_skip_modules=list(unquantized),
    )


def pin_sizes(processor: ProcessorMixin, image_size: int, frames: int) -> None:
    """Make a processor resize a frame to one size in images and in clips of up to 2 x `frames`.

    Qwen's processors take frames of any size. A square frame of `image_size` px gets the edge that
    is the nearest multiple of the edge of a visual token (patch size x merge size), and larger
    frames are shrunk to about this area. By default, a video has another pixel budget than an
    image, and one frame could get two sizes. In clips of an odd number of frames, processors count
    a frame too many or too few, and frames whose area is near the limit can differ.

    The processors of other families resize all frames to the size of the vision tower. They do not
    divide them into crops, of which the number would depend on their size.
    """
    image_processor = processor.image_processor
    for option in CROPS:
        if hasattr(image_processor, option):
            setattr(image_processor, option, False)
    if not isinstance(processor, (*TIMED_PROCESSORS, Qwen2VLProcessor)):
        return
    step = image_processor.patch_size * image_processor.merge_size
    # An eighth more than the tokens of a square frame: then this frame is not shrunk in an odd
    # clip, of which a processor counts at most 8 frames for 7.
    tokens = -(-(round(image_size / step) ** 2) * 8 // 7)
    limit = {"shortest_edge": step * step, "longest_edge": tokens * step * step}
    video = processor.video_processor
    image_processor.size, video.size = limit, dict(limit)
    if isinstance(video, Qwen3VLVideoProcessor):
        # Its budget is that of a whole clip, which it divides by the number of frames.
        video.size["longest_edge"] *= 2 * frames
        video.max_video_tokens = tokens
        video.cap_pixels_per_frame = True
    else:
        video.cap_pixels_per_frame = False
    video.do_sample_frames = False


def load_student(
    cfg: StudentConfig, precision: str, corpus: Corpus
) -> tuple[nn.Module, ProcessorMixin]:
    """Load a student for training: its base, with new adapters if the preset has adapters."""
    base, processor = load_base(cfg, precision, corpus, is_sharded())
    prepare_for_training(base)
    model = name_base(add_adapters(base, cfg.lora), cfg) if cfg.lora.rank else base
    if lacks_weights():
        allocate_trained(model)
    return model, processor


def allocate_trained(model: nn.Module) -> None:
    """Give the trained weights without values (device meta) memory on the CPU, which stays unused:
    accelerate tells an optimizer's weights apart by their addresses."""
    for module in model.modules():
        for name, weight in module.named_parameters(recurse=False):
            if weight.is_meta and weight.requires_grad:
                setattr(module, name, nn.Parameter(torch.empty_like(weight, device="cpu")))
    model.tie_weights()


def prepare_for_training(base: PreTrainedModel) -> None:
    """Keep a base from caching keys and values, and from repacking its 4-bit weights."""
    # The language tower has its own setting.
    base.config.use_cache = base.config.get_text_config().use_cache = False
    keep_differentiable(base)


def add_adapters(model: PreTrainedModel, lora: LoraConfig) -> nn.Module:
    """Freeze the base and add LoRA to the projections of its language tower.

    Adapters are fp32 even on a bf16 base, because updates of their size vanish in bf16's rounding.

    Raises:
        UserError: `lora.targets` is an invalid pattern or matches no module that can be adapted.
    """
    import peft

    model.requires_grad_(False)
    with lora_config("student", lora, model, task_type="CAUSAL_LM") as config:
        return without_embeddings(peft.get_peft_model(model, config))


@contextmanager
def lora_config(
    group: str, lora: LoraConfig, model: PreTrainedModel, task_type: str | None = None
) -> Iterator[Any]:
    """Yield peft's configuration of adapters, for adding them to `model` in the block.

    Raises:
        UserError: In the block, `lora.targets` is an invalid pattern or matches no module that can
            be adapted. The message names it as a key of `group`.
    """
    import peft

    try:
        yield peft.LoraConfig(
            r=lora.rank,
            lora_alpha=lora.alpha,
            lora_dropout=lora.dropout,
            target_modules=lora.targets or choose_lora_targets(model),
            task_type=task_type,
        )
    except (ValueError, re.error) as error:
        raise UserError(
            f"{group}.lora.targets={lora.targets} is invalid or adapts no layer of this model "
            f"({error}): give a pattern that matches full names of linear layers, such as "
            "model.language_model.layers.0.self_attn.q_proj",
            code="no-lora-targets",
        ) from error


def load_trainable(
    cfg: StudentConfig, precision: str, folder: Path
) -> tuple[nn.Module, ProcessorMixin]:
    """Load a trained student to train it further: adapters and their base, or a whole model.

    Raises:
        UserError: As `load_trained`; or `folder` contains a merged export, which has no adapters.
    """
    if not cfg.lora.rank:
        return load_student(replace(cfg, model=str(folder), architecture=None), precision, list)
    check_safetensors(folder)
    base, processor = load_base(cfg, precision, list)
    prepare_for_training(base)
    model = load_adapters(base, folder, is_trainable=True)
    return name_base(without_embeddings(model), cfg), processor


def load_adapters(base: nn.Module, folder: Path, is_trainable: bool = False) -> nn.Module:
    """Load the adapters in a folder over a base. Raises UserError if they are damaged, or those of
    another model: peft would leave layers without adapters."""
    import peft

    with explain_damage(folder):
        with safe_open(folder / ADAPTER_WEIGHTS, "pt") as file:
            saved = set(file.keys())
        model = peft.PeftModel.from_pretrained(base, folder, is_trainable=is_trainable)
        # By default, peft looks up the base on the hub (see `without_embeddings`).
        own = peft.get_peft_model_state_dict(model, save_embedding_layers=False)
        if others := saved ^ set(own):
            raise ValueError(f"its adapters are those of another model: {min(others)}")
    return model


def without_embeddings(model: nn.Module) -> nn.Module:
    """Let a model with adapters save these alone. By default, PEFT looks up the base on the hub at
    each save, to find out whether its table of embeddings has grown."""
    model.save_pretrained = partial(model.save_pretrained, save_embedding_layers=False)
    return model


def name_base(model: nn.Module, cfg: StudentConfig | RetrieverConfig) -> nn.Module:
    """Let saved adapters name their base so that the libraries find it from any directory: a folder
    by its absolute path, a hub model by its name and revision. Loading with this project ignores
    these entries, and takes the base from the settings of the run."""
    for config in model.peft_config.values():
        is_folder = Path(cfg.model).is_dir()
        config.base_model_name_or_path = str(Path(cfg.model).resolve()) if is_folder else cfg.model
        config.revision = None if is_folder else cfg.revision
    return model


def check_safetensors(folder: Path) -> None:
    """Raise UserError if the adapters in a folder have no safetensors; peft would read a pickle."""
    if not (weights := folder / ADAPTER_WEIGHTS).exists():
        raise UserError(
            f"{folder} has no adapters: {weights} is missing; give the folder of a finished run (a "
            "merged export has none), or train again",
            code="missing-run",
        )


def load_trained(
    cfg: StudentConfig, precision: str, folder: Path, merge: bool = True
) -> tuple[nn.Module, ProcessorMixin]:
    """Load a trained student for inference: adapters and their base, or a whole model.

    A merged export keeps the precision of its weights instead of `precision`.

    Args:
        merge: In fp32, merge adapters into an unquantised base.

    Raises:
        UserError: `folder` contains no student or is damaged, or the base cannot be loaded.
    """
    if (folder / ADAPTER_CONFIG).exists():
        check_safetensors(folder)
        base, processor = load_base(cfg, precision, list)
        model = load_adapters(base, folder)
        if merge and precision == "fp32" and cfg.quantization == "none":
            # A forward pass takes 0.87 times as long. In bf16, the sum of the weights is rounded.
            model = model.merge_and_unload()
        return for_inference(model), processor
    if (folder / EXPORT).exists():
        return load_merged(folder, cfg.max_length)
    whole = replace(
        cfg, model=str(folder), architecture=None, quantization="none", lora=LoraConfig(rank=0)
    )
    model, processor = load_base(whole, precision, list)
    return for_inference(model), processor


def load_merged(folder: Path, max_length: int) -> tuple[PreTrainedModel, ProcessorMixin]:
    """Load a student that `train.export` merged into its base, with transformers' classes only.

    Args:
        max_length: As in `choose_attention`.

    Raises:
        UserError: The folder is damaged.
    """
    with explain_damage(folder):
        processor = AutoProcessor.from_pretrained(folder)
        model = AutoModelForImageTextToText.from_pretrained(
            folder, dtype="auto", use_safetensors=True, **place_weights()
        )
    choose_attention(model, precision_of(model), max_length)
    processor.tokenizer.padding_side = "left"
    return for_inference(model), processor


def precision_of(model: PreTrainedModel) -> str:
    """Return the precision of a model's weights, bf16 or fp32."""
    return next(name for name, dtype in DTYPES.items() if dtype == model.dtype)


def merge_adapters(
    base: PreTrainedModel, adapters: Path, quantization: str, precision: str
) -> PreTrainedModel:
    """Dequantise a base to `precision`, and merge the adapters in the folder `adapters` into it.

    Merging into the 4-bit weights would round most of the training away. The weights before
    quantisation lack the quantisation errors with which the adapters were trained.
    """
    dtype = DTYPES[precision]
    if quantization == "nf4":
        base = base.dequantize(dtype)
    return load_adapters(base.to(dtype), adapters).merge_and_unload()


def for_inference(model: nn.Module) -> nn.Module:
    """Set a model to evaluation mode on this rank's device. A model that was built from an
    architecture is on the CPU."""
    return model.to(rank_device()).eval()


def save_student(
    model: nn.Module,
    processor: ProcessorMixin,
    folder: Path,
    precision: str,
    weights: dict[str, torch.Tensor] | None = None,
) -> None:
    """Save the processor, and the adapters or, without adapters, the whole model in `precision`.

    Args:
        weights: All weights of the model, if it is sharded and contains only a part of them.

    Raises:
        UserError: The files cannot be written.
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
    """Save a processor, and a model in its own precision; of a model with adapters, only these.

    Args:
        weights: As in `save_student`.

    Raises:
        UserError: The files cannot be written.
    """
    try:
        model.save_pretrained(folder, state_dict=weights)
    except SafetensorError as error:
        # Unlike an OSError, this error does not name the file.
        raise UserError(
            f"the weights cannot be written to {folder.parent} ({error}); correct this and run the "
            "same command again",
            code="cannot-write",
        ) from error
    processor.save_pretrained(folder)


@contextmanager
def explain_unloadable(group: str, model: str, key: str = "model") -> Iterator[None]:
    """Turn errors of loading a base in the block into UserErrors that name the setting GROUP.KEY.

    Raises:
        UserError: The model is neither a local folder nor in the hub's cache and cannot be
            downloaded; or its files cannot be read.
    """
    check_available(group, model, key)
    try:
        yield
    except (*LOAD_ERRORS, RuntimeError) as error:
        has_other_shapes = "ignore_mismatched_sizes" in str(error)
        # A lack of memory is a RuntimeError, too.
        if isinstance(error, RuntimeError) and not has_other_shapes:
            raise
        reason = "other shapes than in config.json" if has_other_shapes else first_line(error)
        raise UserError(
            f"{group}.{key}={model} cannot be loaded from its folder, the hub or its cache "
            f"({reason}): restore the files that belong together, or give another model",
            code="unloadable-model",
        ) from error


@contextmanager
def explain_damage(folder: Path) -> Iterator[None]:
    """Turn errors of loading a trained or exported model in the block into a UserError."""
    try:
        yield
    except (*LOAD_ERRORS, RuntimeError) as error:
        # A lack of memory is a RuntimeError, too.
        if isinstance(error, RuntimeError) and "size mismatch" not in str(error):
            raise
        exported = (folder / EXPORT).exists()
        shapes = "its weights have other shapes than its base or its config.json"
        reason = shapes if isinstance(error, RuntimeError) else first_line(error)
        raise UserError(
            f"{folder} is damaged and cannot be read ({reason}): "
            f"{'delete it and export' if exported else 'delete the run and train'} again",
            code="damaged-file",
        ) from error
