"""Tiny models of other families than Qwen3-VL, in the form in which they are released.

They have the architectures of transformers with random weights, the special tokens and image
processors of their families, and chat templates in the documented formats.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any

import torch
import transformers
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, processors, trainers

from dynapix.models.tiny_qwen3_vl import CHAT_TEMPLATE

IMAGE_SIZE = 56
VISION = {
    "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 2,
    "image_size": IMAGE_SIZE, "patch_size": 14,
}  # fmt: skip
QWEN_VISION = {
    "hidden_size": 32, "intermediate_size": 48, "depth": 2, "num_heads": 2, "out_hidden_size": 64,
    "patch_size": 14,
}  # fmt: skip
TEXT = {
    # The 4-bit layers of a CPU need at least 64 inputs.
    "hidden_size": 64, "intermediate_size": 128, "num_hidden_layers": 2, "num_attention_heads": 2,
    "num_key_value_heads": 2, "head_dim": 32, "max_position_embeddings": 4096,
    "tie_word_embeddings": True,
}  # fmt: skip
QWEN_TOKENS = (
    "<|endoftext|>", "<|im_start|>", "<|im_end|>", "<|vision_start|>", "<|vision_end|>",
    "<|image_pad|>", "<|video_pad|>",
)  # fmt: skip
QWEN3_VL_TEMPLATE = CHAT_TEMPLATE.replace(
    "<|video_pad|>", "<|vision_start|><|video_pad|><|vision_end|>"
)
"""Qwen3-VL Instruct and Embedding."""
PROMPT_END = r"{{ '<|im_start|>assistant\n' }}"
QWEN3_VL_THINKING_TEMPLATE = QWEN3_VL_TEMPLATE.replace(
    PROMPT_END, r"{{ '<|im_start|>assistant\n<think>\n' }}"
)
QWEN3_5_TEMPLATE = QWEN3_VL_TEMPLATE.replace(
    PROMPT_END,
    f"{PROMPT_END}{{%- if enable_thinking is defined and enable_thinking is false -%}}"
    "{{ '<think>\n\n</think>\n\n' }}{%- else -%}{{ '<think>\n' }}{%- endif -%}",
)
QWEN2_5_VL_TEMPLATE = (
    "{%- if messages[0].role != 'system' -%}"
    "{{ '<|im_start|>system\nYou are a helpful assistant.<|im_end|>\n' }}{%- endif -%}"
    + QWEN3_VL_TEMPLATE
)
SMOLVLM_TEMPLATE = (
    "<|im_start|>{% for message in messages %}{{ message['role'] | capitalize }}"
    "{% if message['content'][0]['type'] == 'image' %}{{ ':' }}{% else %}{{ ': ' }}{% endif %}"
    "{% for line in message['content'] %}{% if line['type'] == 'text' %}{{ line['text'] }}"
    "{% elif line['type'] == 'image' %}{{ '<image>' }}{% endif %}{% endfor %}"
    "<end_of_utterance>\n{% endfor %}{% if add_generation_prompt %}{{ 'Assistant:' }}{% endif %}"
)
INTERNVL_TEMPLATE = (
    "{% for message in messages %}{{ '<|im_start|>' + message['role'] + '\n' }}"
    "{% for content in message['content'] %}"
    "{% if content['type'] == 'image' %}{{ '<IMG_CONTEXT>\n' }}"
    "{% elif content['type'] == 'text' %}{{ content['text'] }}{% endif %}{% endfor %}"
    "{{ '<|im_end|>\n' }}{% endfor %}"
    "{% if add_generation_prompt %}{{ '<|im_start|>assistant\n' }}{% endif %}"
)
GEMMA3_TEMPLATE = (
    "{{ bos_token }}{%- for message in messages -%}"
    "{%- set role = 'model' if message['role'] == 'assistant' else message['role'] -%}"
    "{{ '<start_of_turn>' + role + '\n' }}"
    "{%- if message['content'] is string -%}{{ message['content'] | trim }}{%- else -%}"
    "{%- for item in message['content'] -%}"
    "{%- if item['type'] == 'image' -%}{{ '<start_of_image>' }}"
    "{%- elif item['type'] == 'text' -%}{{ item['text'] | trim }}{%- endif -%}"
    "{%- endfor -%}{%- endif -%}{{ '<end_of_turn>\n' }}{%- endfor -%}"
    "{%- if add_generation_prompt -%}{{ '<start_of_turn>model\n' }}{%- endif -%}"
)
LLAVA_ONEVISION_TEMPLATE = (
    "{% for message in messages %}{{ '<|im_start|>' + message['role'] + ' ' }}"
    "{% for content in message['content'] | selectattr('type', 'equalto', 'image') %}"
    "{{ '<image>' }}{% endfor %}"
    "{% for content in message['content'] | selectattr('type', 'equalto', 'text') %}"
    "{{ '\n' + content['text'] }}{% endfor %}{{ '<|im_end|>' }}{% endfor %}"
    "{% if add_generation_prompt %}{{ '<|im_start|>assistant\n' }}{% endif %}"
)
"""It writes all images of a message before its texts."""

Parts = tuple[transformers.PreTrainedModel, transformers.ProcessorMixin]


def qwen2_5_vl(corpus: Iterable[str]) -> Parts:
    tokenizer = build_tokenizer(corpus, QWEN_TOKENS, end="<|im_end|>")
    rope = {"rope_type": "default", "rope_theta": 1e6, "mrope_section": [4, 6, 6]}
    config = transformers.Qwen2_5_VLConfig(
        text_config={**text_config(tokenizer), "rope_parameters": rope},
        vision_config={**QWEN_VISION, "window_size": 56, "fullatt_block_indexes": [1]},
        **media_ids(tokenizer),
    )
    processor = transformers.Qwen2_5_VLProcessor(
        transformers.Qwen2VLImageProcessor(patch_size=14),
        tokenizer,
        transformers.Qwen2VLVideoProcessor(patch_size=14),
        chat_template=QWEN2_5_VL_TEMPLATE,
    )
    return transformers.Qwen2_5_VLForConditionalGeneration(config), processor


def qwen3_5(corpus: Iterable[str]) -> Parts:
    tokenizer = build_tokenizer(corpus, QWEN_TOKENS, end="<|im_end|>")
    rope = {
        "rope_type": "default", "rope_theta": 1e6, "mrope_section": [4, 2, 2],
        "mrope_interleaved": True, "partial_rotary_factor": 0.5,
    }  # fmt: skip
    config = transformers.Qwen3_5Config(
        text_config={
            **text_config(tokenizer), "rope_parameters": rope,
            "layer_types": ["linear_attention", "full_attention"],
            "linear_key_head_dim": 16, "linear_value_head_dim": 4, "linear_num_key_heads": 2,
            # The 4-bit layers of a CPU need a multiple of 32 outputs.
            "linear_num_value_heads": 32,
        },
        vision_config={**QWEN_VISION, "num_position_embeddings": 16},
        tie_word_embeddings=True,
        **media_ids(tokenizer),
    )  # fmt: skip
    half = {"image_mean": [0.5] * 3, "image_std": [0.5] * 3}
    processor = transformers.Qwen3VLProcessor(
        transformers.Qwen2VLImageProcessor(patch_size=14, **half),
        tokenizer,
        transformers.Qwen3VLVideoProcessor(patch_size=14, **half),
        chat_template=QWEN3_5_TEMPLATE,
    )
    return transformers.Qwen3_5ForConditionalGeneration(config), processor


def smolvlm(corpus: Iterable[str]) -> Parts:
    special = (
        "<|endoftext|>", "<|im_start|>", "<end_of_utterance>", "<fake_token_around_image>",
        "<global-img>", "<image>",
    )  # fmt: skip
    tokenizer = build_tokenizer(corpus, special, end="<end_of_utterance>")
    config = transformers.SmolVLMConfig(
        text_config={**text_config(tokenizer), "model_type": "llama"},
        vision_config=VISION,
        scale_factor=2,
        image_token_id=tokenizer.convert_tokens_to_ids("<image>"),
        tie_word_embeddings=True,
    )
    size = {"longest_edge": IMAGE_SIZE}
    processor = transformers.SmolVLMProcessor(
        transformers.SmolVLMImageProcessor(
            size={"longest_edge": 4 * IMAGE_SIZE}, max_image_size=size
        ),
        tokenizer,
        transformers.SmolVLMVideoProcessor(size=size, max_image_size=size),
        image_seq_len=4,
        chat_template=SMOLVLM_TEMPLATE,
    )
    return transformers.SmolVLMForConditionalGeneration(config), processor


def internvl(corpus: Iterable[str]) -> Parts:
    named = {
        "start_image_token": "<img>", "end_image_token": "</img>",
        "context_image_token": "<IMG_CONTEXT>", "video_token": "<video>",
    }  # fmt: skip
    special = ("<|endoftext|>", "<|im_start|>", "<|im_end|>", *named.values())
    tokenizer = build_tokenizer(corpus, special, end="<|im_end|>", named=named)
    config = transformers.InternVLConfig(
        text_config={**text_config(tokenizer), "model_type": "qwen2"},
        vision_config={**VISION, "image_size": [IMAGE_SIZE] * 2, "patch_size": [14, 14]},
        image_token_id=tokenizer.convert_tokens_to_ids("<IMG_CONTEXT>"),
        image_seq_length=4,
        tie_word_embeddings=True,
    )
    size = {"height": IMAGE_SIZE, "width": IMAGE_SIZE}
    processor = transformers.InternVLProcessor(
        transformers.GotOcr2ImageProcessor(size=size, crop_to_patches=True),
        tokenizer,
        transformers.InternVLVideoProcessor(size=size),
        image_seq_length=4,
        chat_template=INTERNVL_TEMPLATE,
    )
    return transformers.InternVLForConditionalGeneration(config), processor


def gemma3(corpus: Iterable[str]) -> Parts:
    named = {
        "boi_token": "<start_of_image>", "eoi_token": "<end_of_image>",
        "image_token": "<image_soft_token>",
    }  # fmt: skip
    special = (
        "<pad>", "<eos>", "<bos>", "<start_of_turn>", "<end_of_turn>", *named.values(),
    )  # fmt: skip
    tokenizer = build_tokenizer(corpus, special, end="<eos>", pad="<pad>", named=named, bos="<bos>")
    ids = {name: tokenizer.convert_tokens_to_ids(token) for name, token in named.items()}
    config = transformers.Gemma3Config(
        text_config={
            **text_config(tokenizer), "sliding_window": 64, "query_pre_attn_scalar": 32,
            "layer_types": ["sliding_attention", "full_attention"],
        },
        vision_config={**VISION, "vision_use_head": False},
        mm_tokens_per_image=4,
        boi_token_index=ids["boi_token"],
        eoi_token_index=ids["eoi_token"],
        image_token_index=ids["image_token"],
        tie_word_embeddings=True,
    )  # fmt: skip
    size = {"height": IMAGE_SIZE, "width": IMAGE_SIZE}
    processor = transformers.Gemma3Processor(
        transformers.Gemma3ImageProcessor(size=size),
        tokenizer,
        chat_template=GEMMA3_TEMPLATE,
        image_seq_length=4,
    )
    model = transformers.Gemma3ForConditionalGeneration(config)
    # As released: the token that ends a turn is not the tokenizer's.
    ends = [tokenizer.eos_token_id, tokenizer.convert_tokens_to_ids("<end_of_turn>")]
    model.generation_config.update(eos_token_id=ends, top_k=64, top_p=0.95, do_sample=True)
    return model, processor


def llava_onevision(corpus: Iterable[str]) -> Parts:
    special = ("<|endoftext|>", "<|im_start|>", "<|im_end|>", "<image>", "<video>")
    tokenizer = build_tokenizer(corpus, special, end="<|im_end|>")
    ids = {name: tokenizer.convert_tokens_to_ids(f"<{name}>") for name in ("image", "video")}
    grid = [[IMAGE_SIZE * k, IMAGE_SIZE * n] for k in (1, 2) for n in (1, 2)]
    config = transformers.LlavaOnevisionConfig(
        text_config={**text_config(tokenizer), "model_type": "qwen2"},
        vision_config={**VISION, "model_type": "siglip_vision_model", "vision_use_head": False},
        image_token_index=ids["image"],
        video_token_index=ids["video"],
        image_grid_pinpoints=grid,
        vision_feature_select_strategy="full",
        vision_feature_layer=-1,
        tie_word_embeddings=True,
    )
    size = {"height": IMAGE_SIZE, "width": IMAGE_SIZE}
    processor = transformers.LlavaOnevisionProcessor(
        transformers.LlavaOnevisionImageProcessor(size=size, image_grid_pinpoints=grid),
        tokenizer,
        transformers.LlavaOnevisionVideoProcessor(size=size),
        num_image_tokens=16,
        vision_feature_select_strategy="full",
        chat_template=LLAVA_ONEVISION_TEMPLATE,
    )
    return transformers.LlavaOnevisionForConditionalGeneration(config), processor


FAMILIES: dict[str, Callable[[Iterable[str]], Parts]] = {
    "qwen2_5_vl": qwen2_5_vl, "qwen3_5": qwen3_5, "smolvlm": smolvlm, "internvl": internvl,
    "gemma3": gemma3, "llava_onevision": llava_onevision,
}  # fmt: skip


def save_family(name: str, corpus: Iterable[str], folder: Path) -> Path:
    """Write a tiny model of a family and its processor to a folder."""
    with torch.random.fork_rng():
        torch.manual_seed(1)
        model, processor = FAMILIES[name](corpus)
    model.save_pretrained(folder)
    processor.save_pretrained(folder)
    return folder


def build_tokenizer(
    corpus: Iterable[str],
    special: tuple[str, ...],
    end: str,
    pad: str = "<|endoftext|>",
    named: dict[str, str] | None = None,
    bos: str | None = None,
) -> transformers.PreTrainedTokenizerFast:
    """Return a byte-level BPE tokenizer with special tokens; those in `named` become attributes."""
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=600,
        special_tokens=list(special),
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    tokenizer.train_from_iterator(corpus, trainer)
    if bos is not None:
        # As released, the tokenizer adds this token too.
        tokenizer.post_processor = processors.TemplateProcessing(
            single=f"{bos} $A", special_tokens=[(bos, tokenizer.token_to_id(bos))]
        )
    others = [token for token in special if token not in (end, pad, bos)]
    return transformers.PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        eos_token=end,
        pad_token=pad,
        bos_token=bos,
        extra_special_tokens=others,
        model_specific_special_tokens=named or {},
    )


def text_config(tokenizer: transformers.PreTrainedTokenizerFast) -> dict[str, Any]:
    return {
        **TEXT,
        "vocab_size": len(tokenizer),
        "eos_token_id": tokenizer.eos_token_id,
        "pad_token_id": tokenizer.pad_token_id,
        "bos_token_id": tokenizer.bos_token_id,
    }


def media_ids(tokenizer: transformers.PreTrainedTokenizerFast) -> dict[str, int]:
    names = {
        "image_token_id": "image_pad", "video_token_id": "video_pad",
        "vision_start_token_id": "vision_start", "vision_end_token_id": "vision_end",
    }  # fmt: skip
    return {key: tokenizer.convert_tokens_to_ids(f"<|{name}|>") for key, name in names.items()}
