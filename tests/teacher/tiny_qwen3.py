"""A Qwen3 with a few hundred thousand random weights and its own tokenizer, built offline."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

TEMPLATE = (
    "{%- for message in messages -%}"
    "{{ '<|im_start|>' + message.role + '\\n' + message.content + '<|im_end|>\\n' }}"
    "{%- endfor -%}"
    "{%- if add_generation_prompt -%}{{ '<|im_start|>assistant\\n' }}{%- endif -%}"
)


def save_tiny_qwen3(folder: Path, texts: Iterable[str]) -> Path:
    """Save a model, and a tokenizer trained on `texts`, in the format that vLLM reads."""
    # Imported here because they are slow to import, and most tests do not serve a model.
    import torch
    from transformers import Qwen3Config, Qwen3ForCausalLM

    from dynapix.models.tiny_qwen3_vl import build_processor

    tokenizer = build_processor(texts, vocabulary=1024, image_size=32, patch=16).tokenizer
    tokenizer.chat_template = TEMPLATE
    torch.manual_seed(0)
    config = Qwen3Config(
        vocab_size=len(tokenizer),
        hidden_size=128,
        intermediate_size=256,
        num_hidden_layers=2,
        num_attention_heads=4,
        num_key_value_heads=2,
        head_dim=32,
        max_position_embeddings=8192,
        tie_word_embeddings=True,
        bos_token_id=None,
        eos_token_id=tokenizer.eos_token_id,
        pad_token_id=tokenizer.pad_token_id,
        dtype="bfloat16",
    )
    model = Qwen3ForCausalLM(config).to(torch.bfloat16)
    with torch.no_grad():
        # Responses then never end early, so that all have the maximum length.
        model.model.embed_tokens.weight[config.eos_token_id] = 0
    model.save_pretrained(folder)
    tokenizer.save_pretrained(folder)
    return folder


def teach(folder: Path, dialogues: Iterable[tuple[list[dict[str, str]], str]]) -> None:
    """Train the saved model until it writes the response to each list of messages by heart."""
    import torch
    from transformers import AutoTokenizer, Qwen3ForCausalLM

    tokenizer = AutoTokenizer.from_pretrained(folder)
    model = Qwen3ForCausalLM.from_pretrained(folder, dtype=torch.float32)
    examples = []
    for messages, response in dialogues:
        prompt = tokenizer.apply_chat_template(messages, add_generation_prompt=True)["input_ids"]
        answer = [*tokenizer(response)["input_ids"], tokenizer.eos_token_id]
        examples.append((torch.tensor([prompt + answer]), len(answer)))
    optimizer = torch.optim.AdamW(model.parameters(), lr=5e-3)
    for _ in range(300):
        losses = []
        for ids, length in examples:
            logits = model(ids[:, :-1], logits_to_keep=length).logits[0]
            targets = ids[0, -length:]
            losses.append(torch.nn.functional.cross_entropy(logits, targets, reduction="none"))
        # Each token then has a probability of at least 74%.
        if max(loss.max() for loss in losses) < 0.3:
            break
        sum(loss.mean() for loss in losses).backward()
        optimizer.step()
        optimizer.zero_grad()
    model.to(torch.bfloat16).save_pretrained(folder)
