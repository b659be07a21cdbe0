"""Build a small Qwen3-VL and its processor without a download, from sizes and a seed.

All classes are transformers' own. Module names, chat format, timestamps and vision tokens are those
of the released Qwen3-VL models.
"""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import torch
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
from transformers import (
    PreTrainedTokenizerFast,
    Qwen2VLImageProcessor,
    Qwen3VLConfig,
    Qwen3VLForConditionalGeneration,
    Qwen3VLProcessor,
    Qwen3VLVideoProcessor,
)

from dynapix.conf.schema import ArchitectureConfig

SPECIAL_TOKENS = (
    "<|endoftext|>",
    "<|im_start|>",
    "<|im_end|>",
    "<|vision_start|>",
    "<|vision_end|>",
    "<|image_pad|>",
    "<|video_pad|>",
)
CHAT_TEMPLATE = Path(__file__).with_name("tiny_chat_template.jinja").read_text()
MERGE, TEMPORAL = 2, 2


def build_model(sizes: ArchitectureConfig, vocabulary: int) -> Qwen3VLForConditionalGeneration:
    """Return a Qwen3-VL in fp32 with random weights from `sizes.seed`.

    Args:
        vocabulary: Number of tokens of the tokenizer of `build_processor`, including special ones.
    """
    half = sizes.head // 2
    height = width = half // 3
    end = SPECIAL_TOKENS.index("<|im_end|>")
    padding = SPECIAL_TOKENS.index("<|endoftext|>")
    config = Qwen3VLConfig(
        text_config={
            "vocab_size": vocabulary,
            "hidden_size": sizes.hidden,
            "intermediate_size": sizes.feed_forward,
            "num_hidden_layers": sizes.layers,
            "num_attention_heads": sizes.heads,
            "num_key_value_heads": sizes.kv_heads,
            "head_dim": sizes.head,
            "max_position_embeddings": 4096,
            "eos_token_id": end,
            "pad_token_id": padding,
            "rope_parameters": {
                "rope_type": "default",
                "rope_theta": 1000.0,
                "mrope_section": [half - height - width, height, width],
                "mrope_interleaved": True,
            },
            "tie_word_embeddings": True,
        },
        vision_config={
            "depth": sizes.vision_layers,
            "hidden_size": sizes.vision_hidden,
            "intermediate_size": sizes.vision_feed_forward,
            "num_heads": sizes.vision_heads,
            "out_hidden_size": sizes.hidden,
            "patch_size": sizes.patch,
            "spatial_merge_size": MERGE,
            "temporal_patch_size": TEMPORAL,
            "num_position_embeddings": 12 * 12,
            "deepstack_visual_indexes": [sizes.vision_layers // 2],
        },
        image_token_id=SPECIAL_TOKENS.index("<|image_pad|>"),
        video_token_id=SPECIAL_TOKENS.index("<|video_pad|>"),
        vision_start_token_id=SPECIAL_TOKENS.index("<|vision_start|>"),
        vision_end_token_id=SPECIAL_TOKENS.index("<|vision_end|>"),
        tie_word_embeddings=True,
    )
    with torch.random.fork_rng():
        torch.manual_seed(sizes.seed)
        model = Qwen3VLForConditionalGeneration(config)
    model.generation_config.update(eos_token_id=end, pad_token_id=padding)
    return model


def build_processor(
    corpus: Iterable[str], vocabulary: int, image_size: int, patch: int
) -> Qwen3VLProcessor:
    """Return a processor with a byte-level BPE tokenizer that is trained on `corpus`.

    The same texts in the same order give the same tokenizer.

    Args:
        vocabulary: Maximum number of tokens, including the special ones.
        image_size: Width and height (px) of images.
        patch: Width and height (px) of a patch; a visual token covers 2 x 2 patches.
    """
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=vocabulary,
        special_tokens=list(SPECIAL_TOKENS),
        initial_alphabet=sorted(pre_tokenizers.ByteLevel.alphabet()),
        show_progress=False,
    )
    tokenizer.train_from_iterator(corpus, trainer)
    fast = PreTrainedTokenizerFast(
        tokenizer_object=tokenizer,
        eos_token="<|im_end|>",
        pad_token="<|endoftext|>",
        padding_side="left",
        clean_up_tokenization_spaces=False,
        extra_special_tokens=list(SPECIAL_TOKENS[1:]),
    )
    pixels = image_size * image_size
    shared = {
        "patch_size": patch,
        "merge_size": MERGE,
        "temporal_patch_size": TEMPORAL,
        # As in the released Qwen3-VL models, for images and videos alike.
        "image_mean": [0.5, 0.5, 0.5],
        "image_std": [0.5, 0.5, 0.5],
    }
    return Qwen3VLProcessor(
        image_processor=Qwen2VLImageProcessor(
            size={"shortest_edge": 32 * 32, "longest_edge": pixels}, **shared
        ),
        tokenizer=fast,
        video_processor=Qwen3VLVideoProcessor(
            size={"shortest_edge": 32 * 32, "longest_edge": pixels * 64},
            do_sample_frames=False,
            cap_pixels_per_frame=False,
            **shared,
        ),
        chat_template=CHAT_TEMPLATE,
    )
