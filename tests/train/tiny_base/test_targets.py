"""Targets of the tiny base: they agree with the oracle, and refer to the right tokens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch.nn.functional import one_hot

from data.records import LETTERS, SelectionItem, sample_prefix_frames
from data.render.frame_cache import FrameReader
from data.store import Store
from teacher.predicates.motion import find_cut, motion_start
from train.tiny_base.data import TEXT_FACTOR, ItemSampler
from train.tiny_base.heads import (
    PICTURES,
    SCALES,
    UNSEEN_DISTANCE,
    OracleHeads,
    distance,
    locate_objects,
    measure_spread,
    octant,
    pointing_losses,
)
from train.tiny_base.mentions import TokenizedText
from train.tiny_base.oracle_targets import (
    AHEAD,
    RATE,
    UNKNOWN,
    ObjectTarget,
    clip_targets,
    future_displacements,
    image_targets,
    most_visible_per_token,
    observed_states,
)
from train.tiny_base.questions import KINDS, WITHOUT_PICTURES
from train.tiny_base.samples import (
    OracleCollator,
    OracleSample,
    shown_objects,
    spoken_state,
)
from train.tiny_base.trace import (
    NAMING,
    PRECEDING,
    RECALLING,
    SPEAKING,
    TRACKING,
    encode_pictures,
    select_tokens,
    trace_forward,
)
from train.tiny_base.training import first_tokens, motion_losses, words_losses

GRID = 3
"""Visual tokens along the side of an image of 96 px."""


@pytest.fixture(scope="module")
def items(micro_store: Store) -> list[SelectionItem]:
    return [
        item
        for item in micro_store.selection("train")
        if find_cut(micro_store.scene(item.scene_id), item.prefix_start, item.prefix_stop)
    ]


@pytest.fixture(scope="module")
def sampler(items: list[SelectionItem], frames: FrameReader) -> ItemSampler:
    return ItemSampler(items, frames, 6, seed=0)


@pytest.fixture(scope="module")
def samples(sampler: ItemSampler) -> list[OracleSample]:
    return [sampler.sample(item, "compare", "test") for item in sampler.items[:3]]


@pytest.fixture
def collate(processor) -> OracleCollator:
    return OracleCollator(processor, 1500)


@pytest.fixture(params=[PICTURES + 1, 1], ids=["", "grouped"])
def deep_model(model, request: pytest.FixtureRequest):
    """A model with enough layers for all targets, without and with grouped-query attention."""
    from models.tiny_qwen3_vl import build_model
    from tests.tiny_models import SMALL

    model = build_model(
        replace(SMALL, layers=SPEAKING + 1, heads=PICTURES + 1, kv_heads=request.param),
        model.config.text_config.vocab_size,
    )
    return model.eval()


@pytest.fixture
def heads(deep_model, processor) -> OracleHeads:
    words = first_tokens(processor)
    kinds = {kind: words[kind] for kind in ("color", "material", "shape")}
    return OracleHeads(deep_model.get_input_embeddings(), kinds)


def test_clip_targets_are_those_of_the_oracle(micro_store: Store, items) -> None:
    seen = 0
    for item in items:
        scene = micro_store.scene(item.scene_id)
        shown = sample_prefix_frames(item.prefix_start, item.prefix_stop, 6)
        names = [o.noun_phrase for o in scene.objects]
        places = scene.image_positions / scene.image_size
        for t in clip_targets(scene, shown):
            earlier, later = shown[2 * t.picture], shown[2 * t.picture + 1]
            k = names.index(t.name)
            assert t.place == pytest.approx(places[later, k])
            moved = np.multiply(t.velocity, (later - earlier) / RATE)
            assert places[earlier, k] + moved == pytest.approx(places[later, k], nan_ok=True)
            for h, ahead in zip(AHEAD, t.ahead, strict=True):
                if not np.isnan(ahead).any():
                    assert np.add(t.place, ahead) == pytest.approx(places[later + h, k])
            assert np.isnan(t.since).all()
            seen += 1
    assert seen > 3 * len(items)


def test_image_targets_refer_to_the_end_of_the_clip(micro_store: Store, items) -> None:
    scene = micro_store.scene(items[0].scene_id)
    stop, later = items[0].prefix_stop, items[0].target_frame
    after = {t.name: t for t in image_targets(scene, later, 3, (scene, stop))}
    before = {t.name: t for t in image_targets(scene, stop, 3, None)}
    assert after.keys() & before.keys()
    for name in after.keys() & before.keys():
        moved = np.subtract(after[name].place, before[name].place)
        assert after[name].since == pytest.approx(moved)
        assert np.isnan([*after[name].velocity, *before[name].since]).all()


def test_the_future_is_the_displacement_to_the_item_s_moment(micro_store: Store, items) -> None:
    for item in items:
        scene = micro_store.scene(item.scene_id)
        places = scene.image_positions / scene.image_size
        names = [o.noun_phrase for o in scene.objects]
        future = future_displacements(scene, item.prefix_stop, item.target_frame)
        assert future
        for name, moved in future.items():
            k = names.index(name)
            reached = places[item.prefix_stop, k] + moved
            assert reached == pytest.approx(places[item.target_frame, k], nan_ok=True)


def test_a_token_has_the_target_of_which_most_is_visible() -> None:
    one = ObjectTarget("red metal cube", 0, (0.1, 0.1), visible=0.6)
    other = replace(one, name="blue metal cube", place=(0.2, 0.3), visible=0.9)
    elsewhere = replace(one, name="gray metal cube", place=(0.2, 0.4))
    assert [t.cell(GRID) for t in (one, other, elsewhere)] == [0, 0, 3]
    assert most_visible_per_token([one, other, elsewhere], GRID) == [other, elsewhere]
    assert replace(one, place=(1.2, -0.1)).cell(GRID) == GRID - 1


def test_places_in_tokens_and_in_pictures_agree(samples, collate) -> None:
    """Also at the border, where the centre of an object may be outside of the picture."""
    beyond = replace(samples[0].targets[0], place=(1.1, -0.2), name="gray metal cube")
    outside = replace(samples[0], targets=(*samples[0].targets, beyond))
    _, targets = collate([outside, *samples[1:]])
    cell = targets.objects[:, 1] % GRID**2
    corner = torch.stack([cell % GRID, cell // GRID], dim=1)
    places = targets.truth["place"] + 0.5
    assert ((corner + targets.inside + 0.5) / GRID).allclose(places)
    assert targets.inside.abs().max() > 0.5


def test_names_end_where_the_text_names_objects(samples, collate, processor) -> None:
    batch, targets = collate(samples)
    rows = targets.names[:, 0].tolist()
    assert {*rows} == {0, 1, 2}
    for row, position in targets.names.tolist():
        text = processor.decode(batch["input_ids"][row, : position + 1])
        assert text.endswith(("cube", "sphere", "cylinder"))
    for (row, position), found, places in zip(
        targets.names.tolist(), targets.found.tolist(), targets.places, strict=True
    ):
        text = processor.decode(batch["input_ids"][row, : position + 1])
        for k, token in enumerate(found):
            place = places[2 * k : 2 * k + 2] + 0.5
            assert (token == -1) == bool(place.isnan().all())
            if token >= 0:
                (t,) = (
                    t
                    for t in samples[row].targets
                    if t.picture == samples[row].last + k and text.endswith(t.name)
                )
                assert token == t.picture * GRID**2 + t.cell(GRID)
                assert place.tolist() == pytest.approx(t.place, abs=1e-6)


def test_scene_parses_refer_to_the_object_that_they_name_next(sampler, collate) -> None:
    samples = [sampler.sample(item, "parse", "test") for item in sampler.items[:6]]
    _, targets = collate(samples)
    assert len(targets.following) > 10
    positions = {(row, at): m for m, (row, at) in enumerate(targets.names.tolist())}
    for row, before, token in targets.following.tolist():
        name = min(at for r, at in positions if r == row and at > before)
        assert targets.found[positions[row, name], 0] == token


def test_pictures_refer_to_the_letters_of_their_candidates(sampler, collate, processor) -> None:
    samples = [sampler.sample(item, "describe", "test") for item in sampler.items[:3]]
    samples += [sampler.sample(sampler.items[3], "explain", "test")]
    for some in (samples[:3], samples[3:]):
        batch, targets = collate(some)
        assert len(targets.prompt_letters) == len(some) * 4 * GRID**2
        for row, token, letter in targets.prompt_letters.tolist():
            picture = targets.visual[row].tolist().index(token) // GRID**2 - some[row].last - 1
            text = processor.tokenizer.decode(batch["input_ids"][row, letter - 1 : letter + 1])
            assert text == f"Candidate {LETTERS[picture]}"


def test_names_refer_to_the_picture_that_the_text_speaks_of(sampler, collate, processor) -> None:
    samples = [sampler.sample(item, "explain", "test") for item in sampler.items[:8]]
    batch, targets = collate(samples)
    letters = {(row, at): letter for row, at, letter in targets.text_letters.tolist()}
    names = {(row, at): m for m, (row, at) in enumerate(targets.names.tolist())}
    assert len(letters) > 20
    assert len(targets.shown) > 40
    for row, at, token in targets.shown.tolist():
        picture = 0
        if letter := letters.get((row, at)):
            word = processor.tokenizer.decode(batch["input_ids"][row, letter]).strip()
            picture = 1 + LETTERS.index(word)
        assert token == targets.found[names[row, at], picture]


def test_names_of_unseen_objects_refer_to_the_first_token(sampler, collate) -> None:
    crossed = [item for item in sampler.items if "cross" in item.item_id]
    samples = [sampler.sample(item, "describe", "test") for item in crossed[:6]]
    batch, targets = collate(samples)
    assert targets.has_picture.tolist() == [[False, True, True, True, True]] * len(samples)
    row, _, token = targets.shown.T
    assert (token < 0).sum() > 5
    positions = locate_objects(row, token, targets)
    seen = token >= 0
    assert positions[seen].equal(targets.visual[row[seen], token[seen]])
    for k, position in zip(row[~seen].tolist(), positions[~seen].tolist(), strict=True):
        mask = batch["attention_mask"][k]
        assert mask[position] == 1
        assert not mask[:position].any()


def test_texts_without_pictures_have_losses(sampler, collate, deep_model, heads) -> None:
    batch, targets = collate([sampler.sample(i, "narrate", "test") for i in sampler.items[:3]])
    losses = words_losses(deep_model, heads, batch, targets)
    assert {"words", "spelled color", "verdict", "repeat"} <= losses.keys()
    assert not {"color", "place", "named places", "find 0", "label", "find shown"} & losses.keys()
    assert sum(losses.values()).isfinite()


def test_repeated_names_refer_to_their_last_mention(samples, collate, processor) -> None:
    batch, targets = collate(samples)
    assert len(targets.repeats) > 20
    for row, before, last in targets.repeats.tolist():
        ids = batch["input_ids"][row]
        assert last < before
        assert ids[before + 1 : before + 4].equal(ids[last : last + 3])


def test_spoken_states_are_those_of_the_oracle(sampler, collate, processor) -> None:
    samples = (sampler.sample(item, "explain", "test") for item in sampler.items)
    explained = next(s for s in samples if "Outcome:" in s.sample.response)
    _, targets = collate([explained])
    assert len(targets.spoken_state) == len(targets.spoken) > 20
    text = TokenizedText(explained.sample.response, processor.tokenizer)
    shown = {(t.picture, t.name): t.place for t in explained.targets}
    compared = set()
    for m in text.mentions():
        place = np.add(spoken_state(explained, shown_objects(explained), m)[:2], 0.5)
        if m.letter is not None:
            expected = shown.get((explained.last + 1 + LETTERS.index(m.letter), m.name))
        elif m.section in ("Prediction", "Outcome"):
            before = shown.get((explained.last, m.name))
            expected = before and np.add(before, explained.future[m.name])
        else:
            expected = explained.observed.get(m.name, UNKNOWN)[:2]
        assert place == pytest.approx(UNKNOWN if expected is None else expected, nan_ok=True)
        compared.add(m.section)
    assert compared >= {"Scene parse", "Motion analysis", "Prediction", "Candidate analysis"}


def test_offsets_lead_from_the_owner_to_the_object(sampler, collate) -> None:
    samples = [sampler.sample(item, "describe", "test") for item in sampler.items[:12]]
    _, targets = collate(samples)
    at = [tuple(position) for position in targets.spoken.tolist()]
    states = dict(zip(at, targets.spoken_state, strict=True))
    owners = {(row, k): (row, owner) for row, k, owner in targets.owners.tolist()}
    assert len(owners) > 20
    compared = 0
    for position, state in states.items():
        if position in owners:
            expected = state[:2] - states[owners[position]][:2]
            assert torch.allclose(state[4:], expected, equal_nan=True)
            compared += int(not expected.isnan().any())
        else:
            assert state[4:].isnan().all()
    assert compared > 10


def test_observed_states_are_those_of_the_cut(micro_store: Store, items) -> None:
    earlier = 0
    for item in items:
        scene = micro_store.scene(item.scene_id)
        places = scene.image_positions / scene.image_size
        cut = find_cut(scene, item.prefix_start, item.prefix_stop)
        earlier += cut < item.prefix_stop
        for k, o in enumerate(scene.objects):
            if state := observed_states(scene, cut).get(o.noun_phrase):
                assert state[:2] == pytest.approx(places[cut, k])
                start = motion_start(scene, k, cut)
                moved = (places[cut, k] - places[start, k]) * 10 / max(cut - start, 1)
                assert np.isnan(state[2:]).all() or state[2:] == pytest.approx(moved)
    assert earlier


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
    assert [w is not None for w in weights] == [True] * 3 + [False] * 3
    deep_model.zero_grad(set_to_none=True)
    losses["color"].backward()
    assert layers[0].mlp.down_proj.weight.grad is None
    assert deep_model.model.visual.blocks[0].attn.qkv.weight.grad is not None


def test_measures_of_what_is_right_and_of_staying_put(samples, collate, deep_model) -> None:
    # The small tokenizer splits words, and some have the same first token.
    tokens = {"color": [*range(20, 28)], "material": [28, 29], "shape": [30, 31, 32]}
    heads = OracleHeads(deep_model.get_input_embeddings(), tokens)
    _, targets = collate(samples)
    truth, (row, token) = targets.truth, targets.objects.T
    hidden = heads.known["place"].in_features
    heads.norms["seen"] = heads.norms["known"] = torch.nn.Identity()
    moves = truth["velocity"].norm(dim=1) > 0.012

    # Each head of the middle layers reads two numbers of its own.
    known = torch.zeros(*targets.visual.shape, hidden)
    for k, (name, head) in enumerate(heads.known.items()):
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
    assert len(errors) == 2 + len(AHEAD)
    for name in errors:
        assert measures[name].max() < 1e-5

    still = heads.measures(-seen, torch.zeros_like(known), targets)
    assert still["color"].float().mean() < 1
    observed = ~truth["velocity"][:, 0].isnan()
    assert still["moving"].tolist() == (~moves[observed]).tolist()
    for name in errors[1:]:
        unmoved = still[name.replace("_error", "_still")]
        torch.testing.assert_close(still[name], unmoved)


def test_words_stage_has_all_losses_and_learns(samples, collate, deep_model, heads) -> None:
    batch, targets = collate(samples)
    optimizer = torch.optim.Adam([*deep_model.parameters(), *heads.parameters()], lr=3e-3)
    totals = []
    for _ in range(8):
        losses = words_losses(deep_model, heads, batch, targets)
        assert {"words", "track", "find 0", "named places", "color", "since"} <= losses.keys()
        assert {"subject", "letter", "repeat", "verdict"} <= losses.keys()
        assert {"spoken place", "spelled color"} <= losses.keys()
        total = sum(losses.values())
        optimizer.zero_grad()
        total.backward()
        optimizer.step()
        totals.append(total.item())
    assert totals[-1] < 0.8 * totals[0]


def test_pointing_is_lossless_if_all_attention_is_on_the_object(samples, collate) -> None:
    class Certain:
        def log_attention(self, layer, head, row, query, key):
            return torch.zeros(len(row))

    _, targets = collate(samples)
    losses = pointing_losses(Certain(), targets)
    assert losses.keys() == {
        "before", "second before", "track", *(f"find {k}" for k in range(PICTURES)), "subject",
        "find shown", "label", "letter", "repeat", "verdict", "comparison", "owner",
    }  # fmt: skip
    assert not any(loss.item() for loss in losses.values())


def test_unknown_values_do_not_count() -> None:
    true = torch.tensor([[0.2, 0.1], [float("nan")] * 2])
    predicted = torch.tensor([[0.6, 0.3], [9.0, 9.0]])
    assert distance(predicted, true, 3.0).item() == pytest.approx(0, abs=1e-12)
    assert distance(predicted, true * float("nan"), 3.0).item() == 0
    assert distance(predicted + 0.2, true, 3.0).item() == pytest.approx(2 * (0.2 - 0.05))


def test_headings_are_eighths_of_the_circle() -> None:
    angles = torch.arange(0, 360, 45) * torch.pi / 180
    vectors = torch.stack([angles.cos(), angles.sin()], dim=1)
    assert len(octant(vectors).unique()) == 8
    assert octant(vectors * 3 + 0.01).equal(octant(vectors))


def test_samples_depend_on_seed_and_step_only(sampler: ItemSampler) -> None:
    first, again, later = (sampler.batch("words", step, 4) for step in (1, 1, 1 + len(KINDS)))
    assert [s.sample.response for s in first] == [s.sample.response for s in again]
    assert [s.sample.response for s in first] != [s.sample.response for s in later]
    epoch = [
        s.sample.sample_id for k in range(len(sampler.items)) for s in sampler.batch("motion", k, 1)
    ]
    assert sorted(epoch) == sorted(item.item_id for item in sampler.items)


def test_steps_ask_more_questions_without_pictures(sampler: ItemSampler) -> None:
    for step, kind in enumerate(KINDS):
        expected = 2 * TEXT_FACTOR if kind in WITHOUT_PICTURES else 2
        assert len(sampler.batch("words", step, 2)) == expected


def test_spread_is_the_mean_distance_from_the_mean_place() -> None:
    unseen = float("nan")
    places = torch.tensor(
        [
            [9, 9, 0.1, 0.2, 0.1, 0.2, 0.1, 0.2, 0.1, 0.2],
            [9, 9, 0.0, 0.0, 0.4, 0.0, 0.4, 0.0, 0.0, 0.0],
            [9, 9, 0.3, 0.0, 0.3, 0.0, 0.3, 0.0, unseen, unseen],
            [0.5, 0.5, *[unseen] * 8],
        ]
    )
    expected = torch.tensor([0, 0.2, UNSEEN_DISTANCE / 4, unseen])
    assert torch.allclose(measure_spread(places), expected, equal_nan=True)
