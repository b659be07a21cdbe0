"""Targets of the tiny base: they agree with the oracle, and refer to the right tokens."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from transformers import AutoTokenizer

from dynapix.data.records import LETTERS, sample_prefix_frames
from dynapix.data.store import Store
from dynapix.teacher.predicates.motion import find_cut, motion_start
from dynapix.teacher.predicates.statement_choice import UNSEEN_DISTANCE
from research.tiny_base.collator import object_token_ids, spatial_token_ids
from research.tiny_base.mentions import TokenizedText, described_state, measure_error
from research.tiny_base.oracle_targets import (
    AHEAD,
    RATE,
    SPATIAL_WORDS,
    UNKNOWN,
    WORDS,
    ObjectTarget,
    clip_targets,
    compare_images,
    future_displacements,
    image_targets,
    most_visible_per_token,
    observed_states,
)
from research.tiny_base.questions import KINDS
from research.tiny_base.samples import ItemSampler, shown_objects
from research.tiny_base.trace import locate_objects

GRID = 3
"""Visual tokens along the side of an image of 96 px."""


def test_targets_of_a_clip_are_those_of_the_oracle(micro_store: Store, items) -> None:
    seen = earlier_cuts = 0
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
        future = future_displacements(scene, item.prefix_stop, item.target_frame)
        assert future
        for name, moved in future.items():
            k = names.index(name)
            reached = places[item.prefix_stop, k] + moved
            assert reached == pytest.approx(places[item.target_frame, k], nan_ok=True)
        cut = find_cut(scene, item.prefix_start, item.prefix_stop)
        earlier_cuts += cut < item.prefix_stop
        for name, state in observed_states(scene, cut).items():
            k = names.index(name)
            assert state[:2] == pytest.approx(places[cut, k])
            start = motion_start(scene, k, cut)
            moved = (places[cut, k] - places[start, k]) * 10 / max(cut - start, 1)
            assert np.isnan(state[2:]).all() or state[2:] == pytest.approx(moved)
    assert seen > 3 * len(items)
    assert earlier_cuts


def test_targets_of_images_refer_to_the_clip_and_the_earlier_candidates(
    micro_store: Store, items
) -> None:
    scene = micro_store.scene(items[0].scene_id)
    stop, later = items[0].prefix_stop, items[0].target_frame
    after = {t.name: t for t in image_targets(scene, later, 3, (scene, stop))}
    before = {t.name: t for t in image_targets(scene, stop, 3, None)}
    assert after.keys() & before.keys()
    for name in after.keys() & before.keys():
        moved = np.subtract(after[name].place, before[name].place)
        assert after[name].since == pytest.approx(moved)
        assert np.isnan([*after[name].velocity, *before[name].since]).all()

    places = [{"a": (0.1, 0.1), "b": (0.5, 0.5)}, {"a": (0.4, 0.5)}, {"a": (0.4, 0.5), "b": (1, 1)}]
    images = [[ObjectTarget(name, 0, place) for name, place in p.items()] for p in places]
    found = [*compare_images(images)]
    assert [(t.name, t.place) for t in found] == [pair for p in places for pair in p.items()]
    separations = [t.separation for t in found]
    assert np.isnan(separations[:2]).all()
    assert separations[2:] == pytest.approx([0.5, 0, UNSEEN_DISTANCE])


def test_a_token_has_the_target_of_which_most_is_visible() -> None:
    one = ObjectTarget("red metal cube", 0, (0.1, 0.1), visible=0.6)
    other = replace(one, name="blue metal cube", place=(0.2, 0.3), visible=0.9)
    elsewhere = replace(one, name="gray metal cube", place=(0.2, 0.4))
    assert most_visible_per_token([one, other, elsewhere], GRID) == [other, elsewhere]
    # The centre of an object at the border may be outside of the picture.
    assert replace(one, place=(1.2, -0.1)).cell(GRID) == GRID - 1


def test_names_refer_to_the_visual_tokens_of_their_objects(ask, collate, processor) -> None:
    """Also to that in the picture which the text speaks of, and to their last mention."""
    samples = ask("explain", 8)
    batch, targets = collate(samples)
    names = {(row, at): m for m, (row, at) in enumerate(targets.names.tolist())}
    assert {row for row, _ in names} == {*range(8)}
    for (row, position), m in names.items():
        text = processor.decode(batch["input_ids"][row, : position + 1])
        assert text.endswith(("cube", "sphere", "cylinder"))
        shown = {t.picture: t for t in samples[row].targets if text.endswith(t.name)}
        places = targets.name_places[m].unflatten(0, (-1, 2)) + 0.5
        for k, token in enumerate(targets.name_tokens[m].tolist()):
            t = shown.get(samples[row].last + k)
            assert token == (t.token(GRID) if t else -1)
            assert places[k].tolist() == pytest.approx(t.place if t else UNKNOWN, nan_ok=True)
    letters = {(row, at): letter for row, at, letter in targets.text_letters.tolist()}
    assert len(letters) > 20
    assert len(targets.described_tokens) > 40
    for row, at, token in targets.described_tokens.tolist():
        picture = 0
        if letter := letters.get((row, at)):
            word = processor.tokenizer.decode(batch["input_ids"][row, letter]).strip()
            picture = 1 + LETTERS.index(word)
        assert token == targets.name_tokens[names[row, at], picture]
    assert len(targets.repeats) > 20
    for row, before, last in targets.repeats.tolist():
        ids = batch["input_ids"][row]
        assert last < before
        assert ids[before + 1 : before + 4].equal(ids[last : last + 3])


@pytest.mark.parametrize("kind", ["parse", "explain"])
def test_new_names_refer_to_the_object_that_is_named_next(kind, ask, collate) -> None:
    """A scene parse refers to it at the end of the clip, other texts in the last candidate that
    shows it."""
    _, targets = collate(ask(kind, 6))
    pairs = targets.next_in_clip if kind == "parse" else targets.next_in_candidates
    assert len(pairs) > 10
    names = {(row, at): m for m, (row, at) in enumerate(targets.names.tolist())}
    for row, before, token in pairs.tolist():
        following = min(at for r, at in names if r == row and at > before)
        found = targets.name_tokens[names[row, following]].tolist()
        shown = found[:1] if kind == "parse" else [t for t in found[1:] if t >= 0]
        assert token == shown[-1]


def test_candidates_refer_to_their_letters_and_to_the_earlier_ones(ask, collate, processor) -> None:
    samples = ask("compare", 6)
    batch, targets = collate(samples)
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
    assert len(targets.prompt_letters) == len(samples) * 4 * GRID**2
    for row, token, letter in targets.prompt_letters.tolist():
        picture = targets.visual[row].tolist().index(token) // GRID**2 - samples[row].last - 1
        text = processor.tokenizer.decode(batch["input_ids"][row, letter - 1 : letter + 1])
        assert text == f"Candidate {LETTERS[picture]}"


def test_names_of_unseen_objects_refer_to_the_first_token(sampler, collate) -> None:
    crossed = [item for item in sampler.items if "cross" in item.item_id][:6]
    samples = [sampler.make_sample(item, "describe", "test") for item in crossed]
    batch, targets = collate(samples)
    assert targets.has_picture.tolist() == [[False, True, True, True, True]] * len(samples)
    row, _, token = targets.described_tokens.T
    assert (token < 0).sum() > 5
    positions = locate_objects(row, token, targets)
    seen = token >= 0
    assert positions[seen].equal(targets.visual[row[seen], token[seen]])
    first = batch["attention_mask"].argmax(dim=1)
    assert positions[~seen].equal(first[row[~seen]])


def test_spoken_states_and_errors_are_those_of_the_oracle(ask, processor) -> None:
    """An error leads from the place in the supposed target to the shown one."""
    sections, zero = set(), 0
    for kind in ("compare", "explain"):
        for sample in ask(kind, 8):
            shown = shown_objects(sample)
            places = {key: t.place for key, t in shown.items()}
            for m in TokenizedText(sample.sample.response, processor.tokenizer).mentions():
                sections.add(m.section)
                found = np.add(described_state(sample, shown, m)[:2], 0.5)
                if m.letter is not None:
                    first = sample.last + 1
                    place = places.get((first + LETTERS.index(m.letter), m.name), UNKNOWN)
                    assert found == pytest.approx(place, nan_ok=True)
                    if m.supposed is not None:
                        supposed = first + LETTERS.index(m.supposed)
                        error = np.subtract(place, places.get((supposed, m.name), UNKNOWN))
                        assert measure_error(sample, shown, m) == pytest.approx(error, nan_ok=True)
                        zero += m.letter == m.supposed and not error.any()
                elif m.section in ("Scene parse", "Motion analysis"):
                    state = sample.observed.get(m.name, UNKNOWN)[:2]
                    assert found == pytest.approx(state, nan_ok=True)
    assert sections >= {"Scene parse", "Motion analysis", "Prediction", "Candidate analysis"}
    assert zero > 10


def test_samples_depend_on_seed_step_and_rank_only(sampler: ItemSampler, monkeypatch) -> None:
    """An epoch has every item once. Steps show the clip, the candidates or both."""
    epoch = [s.sample.sample_id for s in sampler.make_batch("motion", 0, len(sampler.items))]
    assert sorted(epoch) == sorted(item.item_id for item in sampler.items)
    for stage, step, shown in (("vision", 0, (3, 0)), ("vision", 1, (0, 4)), ("motion", 1, (3, 4))):
        for s in sampler.make_batch(stage, step, 3):
            assert (s.sample.pictures - len(s.sample.images), len(s.sample.images)) == shown
            assert {t.picture for t in s.targets} <= {*range(sum(shown))}

    def responses(step: int) -> list[str]:
        return [s.sample.response for s in sampler.make_batch("words", step, 4)]

    whole = responses(1)
    assert whole == responses(1) != responses(1 + len(KINDS))
    monkeypatch.setenv("LOCAL_RANK", "0")
    monkeypatch.setenv("WORLD_SIZE", "2")
    for rank in (0, 1):
        monkeypatch.setenv("RANK", str(rank))
        assert responses(1) == whole[rank::2]


def test_weighed_words_are_single_tokens_of_the_base() -> None:
    """A piece of a word would also weigh the words that share it."""
    tokenizer = AutoTokenizer.from_pretrained("checkpoints/bases/tiny")
    objects, spatial = object_token_ids(tokenizer), spatial_token_ids(tokenizer)
    assert len(objects) == sum(map(len, WORDS.values()))
    assert not objects & spatial
    words = {word for kind in SPATIAL_WORDS.values() for word in kind}
    assert words <= {tokenizer.decode([i]).strip() for i in spatial}
