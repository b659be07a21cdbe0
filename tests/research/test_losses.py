"""Losses of the tiny base: they train the layers that they refer to."""

from __future__ import annotations

import torch

from research.tiny_base.trace import (
    NAMING,
    PRECEDING,
    RECALLING,
    SPEAKING,
    TRACKING,
    encode_pictures,
    select_tokens,
    trace_forward,
)
from research.tiny_base.training import motion_losses, vision_losses, words_losses


def test_texts_without_pictures_have_losses(ask, collate, deep_model, heads) -> None:
    losses = words_losses(deep_model, heads, *collate(ask("narrate", 3)))
    assert {"words", "name color", "verdict", "repeat", "match", "matches"} <= losses.keys()
    assert not {"color", "place", "name places", "find 0", "label", "find shown"} & losses.keys()
    assert sum(losses.values()).isfinite()


def test_the_trace_is_that_of_the_model(ask, collate, deep_model) -> None:
    """The vision tower alone gives what the whole model embeds."""
    batch, targets = collate(ask("compare", 3))
    inputs = {k: v for k, v in batch.items() if k not in ("labels", "logits_to_keep")}
    deep_model.set_attn_implementation("eager")
    with torch.no_grad():
        with trace_forward(deep_model.model.language_model, batch["attention_mask"]) as trace:
            attentions = deep_model(**inputs, output_attentions=True).attentions
        alone = encode_pictures(deep_model, batch)
    torch.testing.assert_close(alone, select_tokens(trace.embedded, targets.visual))
    row = torch.tensor([0, 1, 2, 2])
    query = torch.tensor([-1, -5, -1, -2]) + batch["input_ids"].shape[1]
    key = targets.visual[row, torch.tensor([0, 4, 8, 9])]
    for layer in (PRECEDING, TRACKING, NAMING, RECALLING, SPEAKING):
        logarithms = trace.log_attention(layer, 1, row, query, key)
        torch.testing.assert_close(logarithms.exp(), attentions[layer][row, 1, query, key])


def test_losses_train_the_layers_that_they_refer_to(ask, collate, deep_model, heads) -> None:
    batch, targets = collate(ask("compare", 3))
    sum(vision_losses(deep_model, heads, batch, targets).values()).backward()
    trained = {name for name, weight in deep_model.named_parameters() if weight.grad is not None}
    # The words of objects are trained too: their embeddings are the targets.
    embeddings = {"model.language_model.embed_tokens.weight"}
    assert all(".visual." in name or name in embeddings for name in trained)
    assert trained > embeddings

    deep_model.zero_grad(set_to_none=True)
    losses = motion_losses(deep_model, heads, batch, targets)
    losses["place"].backward(retain_graph=True)
    layers = deep_model.model.language_model.layers
    weights = [layer.mlp.down_proj.weight.grad for layer in layers]
    assert [w is not None for w in weights] == [True] * 3 + [False] * 4
    deep_model.zero_grad(set_to_none=True)
    losses["color"].backward()
    assert layers[0].mlp.down_proj.weight.grad is None
    assert deep_model.model.visual.blocks[0].attn.qkv.weight.grad is not None


def test_words_stage_has_all_losses_and_learns(ask, collate, deep_model, heads) -> None:
    batch, targets = collate(ask("compare", 3))
    optimizer = torch.optim.Adam([*deep_model.parameters(), *heads.parameters()], lr=3e-3)
    totals = []
    for _ in range(6):
        losses = words_losses(deep_model, heads, batch, targets)
        total = sum(losses.values())
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert losses.keys() >= {
        "words", "track clip", "find 0", "name places", "name color", "color", "since", "subject",
        "letter", "repeat", "choice", "choices", "description place", "description letter",
    }  # fmt: skip
    assert totals[-1] < 0.8 * totals[0]
