"""Losses and measures of the tiny base: they train the layers that they refer to."""

from __future__ import annotations

import numpy as np
import pytest
import torch
from torch.nn.functional import one_hot

from dynapix.data.records import LETTERS
from dynapix.teacher.predicates.statement_choice import measure_separation
from research.tiny_base.heads import (
    SCALES,
    OracleHeads,
    heading_octant,
    measure_separations,
    regression_loss,
)
from research.tiny_base.oracle_targets import AHEAD, PICTURES
from research.tiny_base.pointing import pointing_losses
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
from research.tiny_base.training import motion_losses, words_losses


def test_texts_without_pictures_have_losses(sampler, collate, deep_model, heads) -> None:
    batch, targets = collate([sampler.make_sample(i, "narrate", "test") for i in sampler.items[:3]])
    losses = words_losses(deep_model, heads, batch, targets)
    assert {"words", "name color", "verdict", "repeat", "match", "matches"} <= losses.keys()
    assert not {"color", "place", "name places", "find 0", "label", "find shown"} & losses.keys()
    assert sum(losses.values()).isfinite()


def test_vision_tower_alone_gives_what_the_whole_model_embeds(samples, collate, deep_model) -> None:
    batch, targets = collate(samples)
    inputs = {k: v for k, v in batch.items() if k not in ("labels", "logits_to_keep")}
    with torch.no_grad():
        with trace_forward(deep_model.model.language_model, batch["attention_mask"]) as trace:
            deep_model.model(**inputs)
        alone = encode_pictures(deep_model, batch)
    torch.testing.assert_close(alone, select_tokens(trace.embedded, targets.visual))


@pytest.mark.parametrize("layer", [PRECEDING, TRACKING, NAMING, RECALLING, SPEAKING])
def test_traced_attention_is_that_of_the_model(samples, collate, deep_model, layer: int) -> None:
    batch, targets = collate(samples)
    inputs = {k: v for k, v in batch.items() if k not in ("labels", "logits_to_keep")}
    deep_model.set_attn_implementation("eager")
    with torch.no_grad():
        with trace_forward(deep_model.model.language_model, batch["attention_mask"]) as trace:
            attention = deep_model(**inputs, output_attentions=True).attentions[layer]
        row = torch.tensor([0, 1, 2, 2])
        query = torch.tensor([-1, -5, -1, -2]) + attention.shape[-1]
        key = targets.visual[row, torch.tensor([0, 4, 8, 9])]
        logarithms = trace.log_attention(layer, 1, row, query, key)
    torch.testing.assert_close(logarithms.exp(), attention[row, 1, query, key])


def test_losses_train_the_layers_that_they_refer_to(samples, collate, deep_model, heads) -> None:
    batch, targets = collate(samples)
    losses = motion_losses(deep_model, heads, batch, targets)
    losses["place"].backward(retain_graph=True)
    layers = deep_model.model.language_model.layers
    weights = [layer.mlp.down_proj.weight.grad for layer in layers]
    assert [w is not None for w in weights] == [True] * 3 + [False] * 4
    deep_model.zero_grad(set_to_none=True)
    losses["color"].backward()
    assert layers[0].mlp.down_proj.weight.grad is None
    assert deep_model.model.visual.blocks[0].attn.qkv.weight.grad is not None


def test_measures_of_right_heads_and_of_no_displacement(samples, collate, deep_model) -> None:
    # The small tokenizer splits words, and some have the same first token.
    tokens = {"color": [*range(20, 28)], "material": [28, 29], "shape": [30, 31, 32]}
    heads = OracleHeads(deep_model.get_input_embeddings(), tokens, [33, 34, 35, 36])
    _, targets = collate(samples)
    truth, (row, token) = targets.truth, targets.objects.T
    hidden = heads.object["place"].in_features
    heads.norms["vision"] = heads.norms["object"] = torch.nn.Identity()
    moves = truth["velocity"].norm(dim=1) > 0.012

    # Each head of the middle layers reads two numbers of its own.
    known = torch.zeros(*targets.visual.shape, hidden)
    for k, (name, head) in enumerate(heads.object.items()):
        torch.nn.init.zeros_(head.weight)
        torch.nn.init.zeros_(head.bias)
        width = head.out_features
        head.weight.data[:, 2 * k : 2 * k + width] = torch.eye(width)
        values = moves[:, None].float() - 0.5 if name == "moving" else truth[name] * SCALES[name]
        known[row, token, 2 * k : 2 * k + width] = values.nan_to_num()
    # Tokens whose products with the embeddings of the right words are 1, and with others 0.
    right = torch.cat([one_hot(truth[kind], len(ids)) for kind, ids in tokens.items()], dim=1)
    words = deep_model.get_input_embeddings().weight[20:33]
    seen = torch.zeros_like(known)
    seen[row, token] = right.float() @ torch.linalg.pinv(words.detach()).T

    measures = heads.measures(seen, known, targets)
    for name in ("color", "material", "shape", "moving", "heading"):
        assert len(measures[name])
        assert measures[name].float().mean() == 1
    errors = [name for name in measures if name.endswith("_error")]
    assert len(errors) == 3 + len(AHEAD)
    for name in errors:
        assert measures[name].max() < 1e-5

    still = heads.measures(-seen, torch.zeros_like(known), targets)
    assert still["color"].float().mean() < 1
    observed = ~truth["velocity"][:, 0].isnan()
    assert still["moving"].tolist() == (~moves[observed]).tolist()
    for name in errors[1:-1]:
        unmoved = still[name.replace("_error", "_still")]
        torch.testing.assert_close(still[name], unmoved)
    separation = truth["separation"][~truth["separation"].isnan()]
    torch.testing.assert_close(still["separation_error"], separation)
    constant = (separation - separation.median()).abs()
    torch.testing.assert_close(still["separation_constant"], constant)


def test_words_stage_has_all_losses_and_learns(samples, collate, deep_model, heads) -> None:
    batch, targets = collate(samples)
    optimizer = torch.optim.Adam([*deep_model.parameters(), *heads.parameters()], lr=3e-3)
    totals = []
    for _ in range(8):
        losses = words_losses(deep_model, heads, batch, targets)
        assert {"words", "track clip", "find 0", "name places", "color", "since"} <= losses.keys()
        assert {"subject", "letter", "repeat", "choice", "choices"} <= losses.keys()
        assert {"description place", "description letter", "name color"} <= losses.keys()
        total = sum(losses.values())
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert totals[-1] < 0.8 * totals[0]


def test_pointing_is_lossless_if_all_attention_is_on_the_object(sampler, collate) -> None:
    class Certain:
        def log_attention(self, layer, head, row, query, key):
            return torch.zeros(len(row))

    _, targets = collate([sampler.make_sample(i, "compare", "test") for i in sampler.items[:8]])
    losses = pointing_losses(Certain(), targets)
    assert losses.keys() == {
        "before", "second before", "track clip", *(f"find {k}" for k in range(PICTURES)), "subject",
        "find shown", "label", "letter", "repeat", "choice", "reference",
        "next in candidates",
        *(f"track {k}" for k in range(len(LETTERS) - 1)),
    }  # fmt: skip
    assert not any(loss.item() for loss in losses.values())


def test_unknown_values_do_not_count() -> None:
    true = torch.tensor([[0.2, 0.1], [float("nan")] * 2])
    predicted = torch.tensor([[0.6, 0.3], [9.0, 9.0]])
    assert regression_loss(predicted, true, 3.0).item() == pytest.approx(0, abs=1e-12)
    assert regression_loss(predicted, true * float("nan"), 3.0).item() == 0
    assert regression_loss(predicted + 0.2, true, 3.0).item() == pytest.approx(2 * (0.2 - 0.05))


def test_headings_are_eighths_of_the_circle() -> None:
    angles = torch.arange(0, 360, 45) * torch.pi / 180
    vectors = torch.stack([angles.cos(), angles.sin()], dim=1)
    assert len(heading_octant(vectors).unique()) == 8
    assert heading_octant(vectors * 3 + 0.01).equal(heading_octant(vectors))


def test_separations_are_those_by_which_rationales_choose_objects() -> None:
    rng = np.random.default_rng(0)
    places = rng.random((40, PICTURES, 2))
    places[rng.random((40, PICTURES)) < 0.7] = np.nan
    expected = [
        measure_separation([None if np.isnan(p).any() else tuple(p) for p in row[1:]])
        if not np.isnan(row[1:]).all()
        else np.nan
        for row in places
    ]
    found = measure_separations(torch.tensor(places, dtype=torch.float32).flatten(1))
    assert torch.allclose(found, torch.tensor(expected), equal_nan=True)
    assert 0 < found.isnan().sum() < 20
