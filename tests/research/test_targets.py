"""Targets of the tiny base: they agree with the oracle, and refer to the right tokens."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
import torch
from transformers import AutoTokenizer

from dynapix.data.records import LETTERS, sample_prefix_frames
from dynapix.data.store import Store
from dynapix.teacher.predicates.motion import find_cut, motion_start
from dynapix.teacher.predicates.statement_choice import UNSEEN_DISTANCE
from research.tiny_base.collator import object_token_ids, spatial_token_ids
from research.tiny_base.located_mentions import described_state, measure_error
from research.tiny_base.mentions import TokenizedText
from research.tiny_base.oracle_targets import (
    AHEAD,
    RATE,
    SPATIAL_WORDS,
    UNKNOWN,
    WORDS,
    ObjectTarget,
    OracleTargets,
    clip_targets,
    compare_images,
    future_displacements,
    image_targets,
    most_visible_per_token,
    observed_states,
)
from research.tiny_base.pointing import locate_objects
from research.tiny_base.questions import KINDS
from research.tiny_base.samples import ItemSampler, shown_objects

GRID = 3
"""Visual tokens along the side of an image of 96 px."""


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
        targets.names.tolist(), targets.name_tokens.tolist(), targets.name_places, strict=True
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


def test_candidates_are_compared_with_the_earlier_ones() -> None:
    def image(**places: tuple[float, float]) -> list[ObjectTarget]:
        return [ObjectTarget(name, 0, place) for name, place in places.items()]

    images = [image(a=(0.1, 0.1), b=(0.5, 0.5)), image(a=(0.4, 0.5)), image(a=(0.4, 0.5), b=(1, 1))]
    found = [*compare_images(images)]
    assert [t.name for t in found] == ["a", "b", "a", "a", "b"]
    assert [t.place for t in found] == [t.place for image in images for t in image]
    separations = [t.separation for t in found]
    assert np.isnan(separations[:2]).all()
    assert separations[2:] == pytest.approx([0.5, 0, UNSEEN_DISTANCE])


def test_objects_are_recognised_in_the_earlier_candidates(sampler, collate) -> None:
    samples = [sampler.make_sample(item, "compare", "test") for item in sampler.items[:6]]
    _, targets = collate(samples)
    assert len(targets.tracked_to_candidates) > 20
    for row, token, earlier, other in targets.tracked_to_candidates.tolist():
        first = samples[row].last + 1
        picture = token // GRID**2 - first
        assert 0 <= earlier < picture < len(LETTERS)
        # A token of this coarse grid can contain several objects.
        names = [t.name for t in samples[row].targets if t.token(GRID) == token]
        shown = shown_objects(samples[row])
        there = [shown.get((first + earlier, name)) for name in names]
        assert other in [t.token(GRID) if t else -1 for t in there]


def next_names(targets: OracleTargets, pairs: torch.Tensor) -> Iterator[tuple[int, list[int]]]:
    """Yield the token of each of `pairs`, and the tokens of the object that is named next."""
    positions = {(row, at): m for m, (row, at) in enumerate(targets.names.tolist())}
    for row, before, token in pairs.tolist():
        name = min(at for r, at in positions if r == row and at > before)
        yield token, targets.name_tokens[positions[row, name]].tolist()


def test_new_names_refer_to_the_object_in_the_last_candidate_that_shows_it(
    sampler, collate
) -> None:
    samples = [sampler.make_sample(item, "explain", "test") for item in sampler.items[:6]]
    _, targets = collate(samples)
    assert len(targets.next_in_candidates) > 10
    for token, found in next_names(targets, targets.next_in_candidates):
        assert token == [t for t in found[1:] if t >= 0][-1]


def test_scene_parses_refer_to_the_object_that_they_name_next(sampler, collate) -> None:
    samples = [sampler.make_sample(item, "parse", "test") for item in sampler.items[:6]]
    _, targets = collate(samples)
    assert len(targets.next_in_clip) > 10
    for token, found in next_names(targets, targets.next_in_clip):
        assert token == found[0]


def test_pictures_refer_to_the_letters_of_their_candidates(sampler, collate, processor) -> None:
    samples = [sampler.make_sample(item, "describe", "test") for item in sampler.items[:3]]
    samples += [sampler.make_sample(sampler.items[3], "explain", "test")]
    for some in (samples[:3], samples[3:]):
        batch, targets = collate(some)
        assert len(targets.prompt_letters) == len(some) * 4 * GRID**2
        for row, token, letter in targets.prompt_letters.tolist():
            picture = targets.visual[row].tolist().index(token) // GRID**2 - some[row].last - 1
            text = processor.tokenizer.decode(batch["input_ids"][row, letter - 1 : letter + 1])
            assert text == f"Candidate {LETTERS[picture]}"


def test_names_refer_to_the_picture_that_the_text_speaks_of(sampler, collate, processor) -> None:
    samples = [sampler.make_sample(item, "explain", "test") for item in sampler.items[:8]]
    batch, targets = collate(samples)
    letters = {(row, at): letter for row, at, letter in targets.text_letters.tolist()}
    names = {(row, at): m for m, (row, at) in enumerate(targets.names.tolist())}
    assert len(letters) > 20
    assert len(targets.described_tokens) > 40
    for row, at, token in targets.described_tokens.tolist():
        picture = 0
        if letter := letters.get((row, at)):
            word = processor.tokenizer.decode(batch["input_ids"][row, letter]).strip()
            picture = 1 + LETTERS.index(word)
        assert token == targets.name_tokens[names[row, at], picture]


def test_names_of_unseen_objects_refer_to_the_first_token(sampler, collate) -> None:
    crossed = [item for item in sampler.items if "cross" in item.item_id]
    samples = [sampler.make_sample(item, "describe", "test") for item in crossed[:6]]
    batch, targets = collate(samples)
    assert targets.has_picture.tolist() == [[False, True, True, True, True]] * len(samples)
    row, _, token = targets.described_tokens.T
    assert (token < 0).sum() > 5
    positions = locate_objects(row, token, targets)
    seen = token >= 0
    assert positions[seen].equal(targets.visual[row[seen], token[seen]])
    for k, position in zip(row[~seen].tolist(), positions[~seen].tolist(), strict=True):
        mask = batch["attention_mask"][k]
        assert mask[position] == 1
        assert not mask[:position].any()


def test_repeated_names_refer_to_their_last_mention(samples, collate, processor) -> None:
    batch, targets = collate(samples)
    assert len(targets.repeats) > 20
    for row, before, last in targets.repeats.tolist():
        ids = batch["input_ids"][row]
        assert last < before
        assert ids[before + 1 : before + 4].equal(ids[last : last + 3])


def test_spoken_states_are_those_of_the_oracle(sampler, collate, processor) -> None:
    samples = (sampler.make_sample(item, "explain", "test") for item in sampler.items)
    explained = next(s for s in samples if "Outcome:" in s.sample.response)
    _, targets = collate([explained])
    assert len(targets.description_states) == len(targets.description_tokens) > 20
    text = TokenizedText(explained.sample.response, processor.tokenizer)
    shown = {(t.picture, t.name): t.place for t in explained.targets}
    compared = set()
    for m in text.mentions():
        place = np.add(described_state(explained, shown_objects(explained), m)[:2], 0.5)
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
    samples = [sampler.make_sample(item, "describe", "test") for item in sampler.items[:12]]
    _, targets = collate(samples)
    at = [tuple(position) for position in targets.description_tokens.tolist()]
    states = dict(zip(at, targets.description_states, strict=True))
    references = {(row, k): (row, reference) for row, k, reference in targets.references.tolist()}
    assert len(references) > 20
    compared = 0
    for position, state in states.items():
        if position in references:
            expected = state[:2] - states[references[position]][:2]
            assert torch.allclose(state[4:6], expected, equal_nan=True)
            compared += int(not expected.isnan().any())
        else:
            assert state[4:6].isnan().all()
    assert compared > 10


def test_errors_lead_from_the_expected_place_to_the_shown_one(sampler, processor) -> None:
    zero = compared = 0
    for kind in ("compare", "explain"):
        for item in sampler.items[:8]:
            sample = sampler.make_sample(item, kind, "test")
            shown = {(t.picture - sample.last - 1, t.name): t.place for t in sample.targets}
            for m in TokenizedText(sample.sample.response, processor.tokenizer).mentions():
                error = measure_error(sample, shown_objects(sample), m)
                place = m.letter and shown.get((LETTERS.index(m.letter), m.name))
                if not place:
                    assert np.isnan(error).all()
                    continue
                expected = None
                if kind == "compare":
                    expected = shown.get((LETTERS.index(m.supposed), m.name))
                elif (now := shown.get((-1, m.name))) and m.name in sample.future:
                    expected = np.add(now, sample.future[m.name])
                if expected is None:
                    assert np.isnan(error).all()
                    continue
                assert error == pytest.approx(np.subtract(place, expected), nan_ok=True)
                zero += kind == "compare" and m.letter == m.supposed and error == (0, 0)
                compared += 1
    assert compared > 40
    assert zero > 10


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


def test_samples_depend_on_seed_and_step_only(sampler: ItemSampler) -> None:
    first, again, later = (sampler.make_batch("words", step, 4) for step in (1, 1, 1 + len(KINDS)))
    assert [s.sample.response for s in first] == [s.sample.response for s in again]
    assert [s.sample.response for s in first] != [s.sample.response for s in later]
    epoch = [
        s.sample.sample_id
        for k in range(len(sampler.items))
        for s in sampler.make_batch("motion", k, 1)
    ]
    assert sorted(epoch) == sorted(item.item_id for item in sampler.items)


def test_steps_show_the_clip_the_candidates_or_both(sampler: ItemSampler) -> None:
    for stage, step, shown in (
        ("vision", 0, (3, 0)),
        ("vision", 1, (0, 4)),
        ("motion", 0, (3, 4)),
        ("motion", 1, (3, 4)),
    ):
        for s in sampler.make_batch(stage, step, 3):
            assert (s.sample.pictures - len(s.sample.images), len(s.sample.images)) == shown
            assert {t.picture for t in s.targets} <= {*range(sum(shown))}


def test_ranks_share_the_samples_of_a_step(sampler: ItemSampler, monkeypatch) -> None:
    whole = [s.sample.response for s in sampler.make_batch("words", 3, 4)]
    monkeypatch.setenv("LOCAL_RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "2")
    parts = []
    for rank in ("0", "1"):
        monkeypatch.setenv("RANK", rank)
        parts.append([s.sample.response for s in sampler.make_batch("words", 3, 4)])
    assert parts == [whole[::2], whole[1::2]]


def test_weighed_words_are_single_tokens_of_the_base() -> None:
    """A piece of a word would also weigh the words that share it."""
    tokenizer = AutoTokenizer.from_pretrained("checkpoints/bases/tiny")
    objects, spatial = object_token_ids(tokenizer), spatial_token_ids(tokenizer)
    assert len(objects) == sum(map(len, WORDS.values()))
    assert not objects & spatial
    words = {word for kind in SPATIAL_WORDS.values() for word in kind}
    assert words <= {tokenizer.decode([i]).strip() for i in spatial}
