"""Tiny models of every kind of released embedder.

They have the real architectures with random weights, tokenizers and processors, and are written to
folders with the files of the released models.
"""

from __future__ import annotations

import json
from pathlib import Path

import peft
import torch
from tokenizers import pre_tokenizers
from transformers import (
    CLIPConfig,
    CLIPImageProcessor,
    CLIPModel,
    CLIPProcessor,
    CLIPTokenizer,
    GemmaTokenizer,
    Qwen2VLConfig,
    Qwen2VLForConditionalGeneration,
    Qwen2VLImageProcessor,
    Qwen2VLProcessor,
    Qwen2VLVideoProcessor,
    SiglipConfig,
    SiglipImageProcessor,
    SiglipModel,
    SiglipProcessor,
)

from dynapix.evaluation.embedders.languagebind import LanguageBindVideo
from tests.families import (
    IMAGE_SIZE,
    QWEN2_5_VL_TEMPLATE,
    QWEN_TOKENS,
    VISION,
    build_tokenizer,
    media_ids,
)

CLIP_FRAMES = 4
TOWER = {
    "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 2,
}  # fmt: skip
ALPHABET = sorted(pre_tokenizers.ByteLevel.alphabet())


def clip(folder: Path) -> Path:
    torch.manual_seed(0)
    tokenizer = clip_tokenizer()
    CLIPModel(clip_config(tokenizer)).save_pretrained(folder)
    size = {"height": IMAGE_SIZE, "width": IMAGE_SIZE}
    images = CLIPImageProcessor(size={"shortest_edge": IMAGE_SIZE}, crop_size=size)
    CLIPProcessor(images, tokenizer).save_pretrained(folder)
    return folder


def clip_tokenizer() -> CLIPTokenizer:
    tokens = [*ALPHABET, *(f"{character}</w>" for character in ALPHABET)]
    tokens += ["<|startoftext|>", "<|endoftext|>"]
    return CLIPTokenizer(vocab={token: k for k, token in enumerate(tokens)}, merges=[])


def clip_config(tokenizer: CLIPTokenizer, **vision: object) -> CLIPConfig:
    text = {
        **TOWER, "vocab_size": len(tokenizer), "max_position_embeddings": 77,
        "bos_token_id": tokenizer.bos_token_id, "eos_token_id": tokenizer.eos_token_id,
    }  # fmt: skip
    return CLIPConfig(text_config=text, vision_config={**VISION, **vision}, projection_dim=24)


def siglip2(folder: Path) -> Path:
    torch.manual_seed(0)
    tokens = ["<pad>", "<eos>", "<bos>", "<unk>", "<mask>", "▁", *map(chr, range(33, 127))]
    tokens += [f"<0x{byte:02X}>" for byte in range(256)]
    tokenizer = GemmaTokenizer(vocab={token: k for k, token in enumerate(tokens)}, merges=[])
    text = {**TOWER, "vocab_size": len(tokenizer), "max_position_embeddings": 64}
    SiglipModel(SiglipConfig(text_config=text, vision_config=VISION)).save_pretrained(folder)
    images = SiglipImageProcessor(size={"height": IMAGE_SIZE, "width": IMAGE_SIZE})
    SiglipProcessor(images, tokenizer).save_pretrained(folder)
    return folder


def languagebind(videos: Path, images: Path) -> tuple[Path, Path]:
    """Write a video model and an image model, with the weights as pytorch_model.bin as released.
    Their config files have model types that transformers does not know, and there is no processor
    file."""
    torch.manual_seed(0)
    tokenizer = clip_tokenizer()
    config = clip_config(tokenizer, add_time_attn=True, num_frames=CLIP_FRAMES)
    video = LanguageBindVideo(config)
    for layer in video.vision_model.encoder.layers:
        torch.nn.init.normal_(layer.temporal_embedding)
    for model, folder, kind in (
        (video, videos, "LanguageBindVideo"),
        (CLIPModel(clip_config(tokenizer)), images, "LanguageBindImage"),
    ):
        model.save_pretrained(folder)
        (folder / "model.safetensors").unlink()
        torch.save(model.state_dict(), folder / "pytorch_model.bin")
        tokenizer.save_pretrained(folder)
        saved = json.loads((folder / "config.json").read_text())
        (folder / "config.json").write_text(json.dumps(saved | {"model_type": kind}))
    return videos, images


def vlm2vec(base: Path, adapters: Path) -> Path:
    """Write a Qwen2-VL to `base`, and adapters over it with the processor to `adapters`."""
    torch.manual_seed(0)
    tokenizer = build_tokenizer([], QWEN_TOKENS, end="<|im_end|>")
    rope = {"rope_type": "default", "rope_theta": 1e6, "mrope_section": [2, 3, 3]}
    config = Qwen2VLConfig(
        text_config={
            **TOWER, "vocab_size": len(tokenizer), "num_key_value_heads": 2,
            "tie_word_embeddings": True, "rope_parameters": rope,
        },
        vision_config={
            "depth": 2, "embed_dim": 32, "hidden_size": 32, "num_heads": 2, "patch_size": 14,
            "mlp_ratio": 2,
        },
        **media_ids(tokenizer),
    )  # fmt: skip
    model = Qwen2VLForConditionalGeneration(config)
    model.save_pretrained(base)
    low_rank = peft.LoraConfig(
        r=2, target_modules=r".*language_model.*\.q_proj", init_lora_weights=False
    )
    peft.get_peft_model(model, low_rank).save_pretrained(adapters)
    settings = adapters / "adapter_config.json"
    saved = json.loads(settings.read_text()) | {"base_model_name_or_path": str(base)}
    settings.write_text(json.dumps(saved))
    images, videos = Qwen2VLImageProcessor(), Qwen2VLVideoProcessor()
    processor = Qwen2VLProcessor(images, tokenizer, videos, chat_template=QWEN2_5_VL_TEMPLATE)
    processor.save_pretrained(adapters)
    return adapters
