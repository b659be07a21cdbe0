"""Tiny saved retrievers of several families, each with a pooling and prompts of its own."""

from __future__ import annotations

from pathlib import Path

import torch
from sentence_transformers import SentenceTransformer
from sentence_transformers.sentence_transformer.modules import Normalize, Pooling, Transformer
from transformers import BertConfig, BertModel, BertTokenizer

from tests.evaluation.models import released
from tests.families import TEXT, save_family

PROMPTS = {"query": "Find the frame: ", "document": "A frame: "}
RETRIEVERS = ("qwen2_5_vl", "smolvlm", "clip")
WIDTH = 32
"""Hidden size of a sentence encoder."""


def saved_retriever(family: str, folder: Path) -> Path:
    """Write a saved retriever with mean pooling and `PROMPTS`; CLIP needs no pooling."""
    torch.manual_seed(0)
    if family == "clip":
        released.clip(folder / "backbone")
    else:
        save_family(family, [], folder / "backbone")
    backbone = Transformer(str(folder / "backbone"))
    pooling = [Pooling(TEXT["hidden_size"], pooling_mode="mean")] if family != "clip" else []
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
    sizes = {"hidden_size": WIDTH, "intermediate_size": 48, "num_hidden_layers": 2}
    config = BertConfig(**sizes, num_attention_heads=2, vocab_size=len(words))
    BertModel(config).save_pretrained(folder / "backbone")
    tokenizer.save_pretrained(folder / "backbone")
    backbone = Transformer(str(folder / "backbone"), max_seq_length=256)
    modules = [backbone, Pooling(WIDTH, pooling_mode="mean"), Normalize()]
    model = SentenceTransformer(modules=modules, device="cpu")
    model.save_pretrained(str(folder / "saved"), create_model_card=False)
    return folder / "saved"
