"""Tiny saved retrievers of several families, each with a pooling and prompts of its own.

They have the real architectures with random weights, tokenizers and processors.
"""

from __future__ import annotations

from pathlib import Path

import torch
from sentence_transformers import SentenceTransformer
from sentence_transformers.sentence_transformer.modules import Normalize, Pooling, Transformer
from tokenizers import Tokenizer, decoders, models, pre_tokenizers, trainers
from transformers import (
    BertConfig,
    BertModel,
    BertTokenizer,
    Gemma3Config,
    Gemma3ForConditionalGeneration,
    Gemma3ImageProcessor,
    Gemma3Processor,
    Idefics3Config,
    Idefics3ForConditionalGeneration,
    Idefics3ImageProcessor,
    Idefics3Processor,
    PreTrainedTokenizerFast,
    Qwen2_5_VLConfig,
    Qwen2_5_VLForConditionalGeneration,
    Qwen2_5_VLProcessor,
    Qwen2VLImageProcessor,
    Qwen2VLVideoProcessor,
)

from models.tiny_qwen3_vl import CHAT_TEMPLATE, SPECIAL_TOKENS
from tests.evaluation.models import released

PROMPTS = {"query": "Find the frame: ", "document": "A frame: "}
TOWER = {
    "hidden_size": 32, "intermediate_size": 48, "num_hidden_layers": 2, "num_attention_heads": 2,
}  # fmt: skip
TEXT = {**TOWER, "num_key_value_heads": 2, "max_position_embeddings": 4096}
TEMPLATE = (
    "{% for message in messages %}{{ message['role'] }}:{% for part in message['content'] %}"
    "{% if part['type'] == 'image' %}IMAGE{% else %}{{ part['text'] }}{% endif %}{% endfor %}\n"
    "{% endfor %}{% if add_generation_prompt %}assistant:{% endif %}"
)
"""A chat template, in which IMAGE stands for the token of an image."""
ALPHABET = sorted(pre_tokenizers.ByteLevel.alphabet())


def byte_tokenizer(special: tuple[str, ...], **roles: object) -> PreTrainedTokenizerFast:
    """Return a tokenizer whose tokens are bytes, after special ones."""
    tokenizer = Tokenizer(models.BPE())
    tokenizer.pre_tokenizer = pre_tokenizers.ByteLevel(add_prefix_space=False)
    tokenizer.decoder = decoders.ByteLevel()
    trainer = trainers.BpeTrainer(
        vocab_size=len(special) + len(ALPHABET), special_tokens=list(special),
        initial_alphabet=ALPHABET, show_progress=False,
    )  # fmt: skip
    tokenizer.train_from_iterator([], trainer)
    return PreTrainedTokenizerFast(
        tokenizer_object=tokenizer, pad_token=special[0], eos_token=special[1],
        extra_special_tokens=roles or list(special[2:]),
    )  # fmt: skip


def qwen2_5_vl(folder: Path) -> None:
    tokenizer = byte_tokenizer(SPECIAL_TOKENS)
    ids = {token: k for k, token in enumerate(SPECIAL_TOKENS)}
    rope = {"rope_type": "default", "rope_theta": 1e6, "mrope_section": [2, 3, 3]}
    config = Qwen2_5_VLConfig(
        text_config={**TEXT, "vocab_size": len(tokenizer), "rope_parameters": rope},
        vision_config={
            "depth": 2, "hidden_size": 32, "out_hidden_size": 32, "num_heads": 2, "patch_size": 14,
            "intermediate_size": 48, "fullatt_block_indexes": [1],
        },
        image_token_id=ids["<|image_pad|>"], video_token_id=ids["<|video_pad|>"],
        vision_start_token_id=ids["<|vision_start|>"], vision_end_token_id=ids["<|vision_end|>"],
    )  # fmt: skip
    Qwen2_5_VLForConditionalGeneration(config).save_pretrained(folder)
    Qwen2_5_VLProcessor(
        Qwen2VLImageProcessor(), tokenizer, Qwen2VLVideoProcessor(), chat_template=CHAT_TEMPLATE
    ).save_pretrained(folder)


def idefics3(folder: Path) -> None:
    special = (
        "<pad>", "<eos>", "<image>", "<fake_token_around_image>", "<global-img>",
        "<end_of_utterance>",
    )  # fmt: skip
    tokenizer = byte_tokenizer(special)
    config = Idefics3Config(
        text_config={**TEXT, "model_type": "llama", "vocab_size": len(tokenizer)},
        vision_config={**TOWER, "image_size": 56, "patch_size": 14},
        image_token_id=2, scale_factor=2, pad_token_id=0,
    )  # fmt: skip
    Idefics3ForConditionalGeneration(config).save_pretrained(folder)
    images = Idefics3ImageProcessor(size={"longest_edge": 56}, max_image_size={"longest_edge": 56})
    template = TEMPLATE.replace("IMAGE", "<image>")
    Idefics3Processor(images, tokenizer, image_seq_len=4, chat_template=template).save_pretrained(
        folder
    )


def gemma3(folder: Path) -> None:
    special = ("<pad>", "<eos>", "<start_of_image>", "<end_of_image>", "<image_soft_token>")
    roles = {"boi_token": special[2], "eoi_token": special[3], "image_token": special[4]}
    tokenizer = byte_tokenizer(special, **roles)
    config = Gemma3Config(
        text_config={**TEXT, "vocab_size": len(tokenizer), "head_dim": 16},
        vision_config={**TOWER, "image_size": 56, "patch_size": 14},
        mm_tokens_per_image=4, boi_token_index=2, eoi_token_index=3, image_token_index=4,
    )  # fmt: skip
    Gemma3ForConditionalGeneration(config).save_pretrained(folder)
    images = Gemma3ImageProcessor(size={"height": 56, "width": 56})
    template = TEMPLATE.replace("IMAGE", "<start_of_image>")
    Gemma3Processor(images, tokenizer, template, image_seq_length=4).save_pretrained(folder)


def clip(folder: Path) -> None:
    released.clip(folder)


FAMILIES = {"qwen2_5_vl": qwen2_5_vl, "idefics3": idefics3, "gemma3": gemma3, "clip": clip}


def saved_retriever(family: str, folder: Path) -> Path:
    """Write a saved retriever with mean pooling and `PROMPTS`; CLIP needs no pooling."""
    torch.manual_seed(0)
    FAMILIES[family](folder / "backbone")
    backbone = Transformer(str(folder / "backbone"))
    pooling = [Pooling(32, pooling_mode="mean")] if family != "clip" else []
    modules = [backbone, *pooling, Normalize()]
    model = SentenceTransformer(modules=modules, prompts=PROMPTS, device="cpu")
    model.save_pretrained(str(folder / "saved"), create_model_card=False)
    return folder / "saved"


def sentence_encoder(folder: Path) -> Path:
    """Write a sentence encoder like all-MiniLM-L6-v2, which reads texts only."""
    torch.manual_seed(0)
    folder.mkdir(parents=True)
    words = ["[PAD]", "[UNK]", "[CLS]", "[SEP]", "[MASK]", *map(chr, range(33, 127))]
    words += [f"##{chr(k)}" for k in range(33, 127)]
    (folder / "vocab.txt").write_text("\n".join(words))
    tokenizer = BertTokenizer(str(folder / "vocab.txt"))
    BertModel(BertConfig(**TOWER, vocab_size=len(words))).save_pretrained(folder / "backbone")
    tokenizer.save_pretrained(folder / "backbone")
    backbone = Transformer(str(folder / "backbone"), max_seq_length=256)
    modules = [backbone, Pooling(32, pooling_mode="mean"), Normalize()]
    model = SentenceTransformer(modules=modules, device="cpu")
    model.save_pretrained(str(folder / "saved"), create_model_card=False)
    return folder / "saved"
