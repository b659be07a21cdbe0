"""Samples of the tiny base: prompts as students read them, with what the oracle knows of them.

A sample shows the clip, the candidates, both or neither, as a selection prompt shows them, and asks
a question of `train.tiny_base.questions`, or none.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from transformers import PreTrainedTokenizerBase, ProcessorMixin

from data.records import (
    LETTERS,
    SelectionItem,
    original_scene_id,
    sample_prefix_frames,
)
from data.render.frame_cache import FrameReader
from models.student.collator import Collator
from models.student.prompts import Sample, conversation, load_clip
from teacher.predicates.motion import find_cut
from train.tiny_base.mentions import Mention, TokenizedText
from train.tiny_base.oracle_targets import (
    PICTURES,
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
    name_words,
    observed_states,
    stack_targets,
)
from train.tiny_base.questions import Question


@dataclass(frozen=True)
class OracleSample:
    """A sample, and the visible objects in its pictures.

    Attributes:
        last: Index of the last picture of the clip, which the candidates follow; -1 without clip.
        observed: Places and velocities of objects, by name, at the cut, which texts about the clip
            describe.
        future: Displacements of objects, by name, from the end of the clip to the moment that the
            item asks for.
        predicts_target: Whether predictions in the response are true of that moment.
    """

    sample: Sample
    targets: tuple[ObjectTarget, ...]
    last: int
    observed: Mapping[str, tuple[float, ...]]
    future: Mapping[str, tuple[float, float]]
    predicts_target: bool


def make_sample(
    item: SelectionItem, question: Question, frames: FrameReader, frame_count: int
) -> OracleSample:
    """Return the sample of a question about an item."""
    scene = frames.scene(item.scene_id)
    targets: list[ObjectTarget] = []
    parts: list[str | np.ndarray] = [item.question]
    clip, last, observed, future = None, -1, {}, {}
    if question.clip:
        seen = sample_prefix_frames(item.prefix_start, item.prefix_stop, frame_count)
        clip, last = load_clip(item.scene_id, seen, frames), (len(seen) + 1) // 2 - 1
        targets += clip_targets(scene, seen)
        observed = observed_states(scene, find_cut(scene, item.prefix_start, item.prefix_stop))
        future = future_displacements(scene, item.prefix_stop, item.target_frame)
    if question.candidates:
        images = []
        shown = [*item.candidates]
        if question.instead is not None:
            shown[item.answer] = question.instead
        for picture, (letter, c) in enumerate(zip(LETTERS, shown, strict=True), last + 1):
            follows = original_scene_id(c.scene_id) == original_scene_id(item.scene_id)
            before = (scene, item.prefix_stop) if follows and clip else None
            images.append([*image_targets(frames.scene(c.scene_id), c.frame, picture, before)])
            parts += [f"\nCandidate {letter}: ", frames.array(c.scene_id, c.frame)]
        targets += compare_images(images)
    parts.append(f"\n{question.text}")
    sample = conversation(item.item_id, parts, question.answer, clip)
    return OracleSample(sample, tuple(targets), last, observed, future, question.predicts_target)


class OracleCollator:
    """Makes batches of `OracleSample`s: the tensors of `Collator`, and `OracleTargets`."""

    def __init__(self, processor: ProcessorMixin, max_length: int) -> None:
        self._processor = processor
        self._collate = Collator(processor, max_length)
        self._word_ids = {
            "object_words": object_token_ids(processor.tokenizer),
            "spatial_words": spatial_token_ids(processor.tokenizer),
        }

    def __call__(self, samples: Sequence[OracleSample]) -> tuple[dict[str, Any], OracleTargets]:
        batch = self._collate([s.sample for s in samples])
        ids = batch["input_ids"]
        media = torch.tensor([self._processor.image_token_id, self._processor.video_token_id])
        visual = torch.isin(ids, media).nonzero()[:, 1].reshape(len(samples), -1)
        grid = round((visual.shape[1] // max(samples[0].sample.pictures, 1)) ** 0.5)
        texts = [TokenizedText(s.sample.response or "", self._processor.tokenizer) for s in samples]
        mentions: list[LocatedMention] = []
        pairs: dict[str, list[tuple[int, ...]]] = {
            "prompt_letters": [*self._find_letters(ids, visual, samples, grid)],
            "text_tokens": [], "object_words": [], "spatial_words": [], "verdicts": [],
            "choices": [], "comparisons": [], "matches": [],
        }  # fmt: skip
        for row, (sample, text) in enumerate(zip(samples, texts, strict=True)):
            # The token that ends the turn follows the response.
            start = ids.shape[1] - len(text) - 1
            mentions += locate_mentions(sample, text, row, start, grid)
            tokens = range(start, start + len(text))
            pairs["text_tokens"] += [(row, k) for k in tokens]
            for group, word_ids in self._word_ids.items():
                pairs[group] += [(row, k) for k in tokens if int(ids[row, k]) in word_ids]
            pairs["verdicts"] += [
                (row, start + letter - 1, start + agrees) for letter, agrees in text.verdicts()
            ]
            pairs["choices"] += [
                (row, start + letter - 1, start + shown) for letter, shown in text.choices()
            ]
            pairs["matches"] += [
                (row, start + letter, start + outcome) for letter, outcome in text.matches()
            ]
            pairs["comparisons"] += [
                (row, start + shown, start + predicted) for shown, predicted in text.comparisons()
            ]
        start = batch["attention_mask"].argmax(dim=1)
        return batch, stack_samples(samples, mentions, pairs, visual, start, grid)

    def _find_letters(
        self, ids: Tensor, visual: Tensor, samples: Sequence[OracleSample], grid: int
    ) -> Iterator[tuple[int, int, int]]:
        """Yield the row and the position of each visual token of a candidate, and the position of
        the letter before the candidate."""
        letters = letter_token_ids(self._processor.tokenizer)
        for row, sample in enumerate(samples if grid else ()):
            tokens = visual[row].reshape(-1, grid**2)
            for letter, picture in zip(letters, tokens[sample.last + 1 :], strict=False):
                before = (ids[row, : picture[0]] == letter).nonzero()
                yield from ((row, int(token), int(before[-1])) for token in picture)


def letter_token_ids(tokenizer: PreTrainedTokenizerBase) -> list[int]:
    """Return the tokens of the letters of candidates."""
    return [tokenizer.encode(f" {letter}", add_special_tokens=False)[0] for letter in LETTERS]


def object_token_ids(tokenizer: PreTrainedTokenizerBase) -> set[int]:
    """Return the tokens of the words for colours, materials and shapes."""
    words = [word for words in WORDS.values() for word in words]
    return {i for word in words for i in tokenizer.encode(f" {word}", add_special_tokens=False)}


def spatial_token_ids(tokenizer: PreTrainedTokenizerBase) -> set[int]:
    """Return the tokens of the words for places, motion and relations."""
    words = [word for words in SPATIAL_WORDS.values() for word in words]
    words += [f"{row}-{column}" for row in ("top", "bottom") for column in ("left", "right")]
    return {i for word in words for i in tokenizer.encode(f" {word}", add_special_tokens=False)}


@dataclass(frozen=True)
class LocatedMention:
    """A mention of an object, with the oracle's targets. Positions are those of the batch.

    Attributes:
        row, first, position: Row of the batch, and positions of the name's first and last token.
        spoken: Positions of the tokens that describe the object, from the name's last token on.
        section: Title of the section of the rationale; None before the first.
        state: Place (from -0.5 to 0.5) and velocity of the object in the picture that the text
            speaks of; NaN where the oracle does not determine them.
        letter_at: Position of the letter of the candidate that the text speaks of, if any.
        picture: Index of the picture that the text speaks of: 0 for the last one of the clip, 1 to
            4 for the candidates.
        found: Visual token of the object in each of `PICTURES`, or -1.
        places: The object's places in these pictures, NaN where it is not visible.
        future: Its displacement to the moment that the item asks for, or NaN.
        owner: Position of the cube's name if this is the sphere in "the cube has the sphere left of
            it", otherwise None.
        offset: The displacement from the owner to this object in the picture that the text speaks
            of, or NaN.
        off: If the text speaks of a candidate, the displacement of the object there from the place
            where it is expected, otherwise NaN.
    """

    name: str
    row: int
    first: int
    position: int
    spoken: range
    section: str | None
    state: tuple[float, ...]
    letter_at: int | None
    picture: int
    found: tuple[int, ...]
    places: tuple[float, ...]
    future: tuple[float, float]
    owner: int | None
    offset: tuple[float, float]
    off: tuple[float, float]


def locate_mentions(
    sample: OracleSample, text: TokenizedText, row: int, start: int, grid: int
) -> Iterator[LocatedMention]:
    """Yield the mentions of objects in a sample's response, whose first token is at `start`."""
    shown = shown_objects(sample)
    mentions = [*text.mentions()]
    states = [spoken_state(sample, shown, m) for m in mentions]
    for m, state in zip(mentions, states, strict=True):
        owner = None if m.owner is None else start + mentions[m.owner].last
        offset = UNKNOWN
        if m.owner is not None:
            offset = state[0] - states[m.owner][0], state[1] - states[m.owner][1]
        pictures = [shown.get((sample.last + k, m.name)) for k in range(PICTURES)]
        yield LocatedMention(
            m.name,
            row,
            start + m.first,
            start + m.last,
            range(start + m.last, start + m.stop),
            m.section,
            state,
            None if m.letter_at is None else start + m.letter_at,
            0 if m.letter is None else 1 + LETTERS.index(m.letter),
            tuple(t.token(grid) if t else -1 for t in pictures),
            tuple(x for t in pictures for x in (t.place if t else UNKNOWN)),
            sample.future.get(m.name, UNKNOWN),
            owner,
            offset,
            measure_error(sample, shown, m),
        )


def stack_samples(
    samples: Sequence[OracleSample],
    mentions: Sequence[LocatedMention],
    pairs: Mapping[str, list[tuple[int, ...]]],
    visual: Tensor,
    start: Tensor,
    grid: int,
) -> OracleTargets:
    """Return the targets of a batch.

    Args:
        pairs: Further rows and positions, by attribute of `OracleTargets`.
        visual: (B, T) positions of the visual tokens, grid x grid for each picture.
        start: (B,) positions of the first tokens.
    """
    objects = [
        (row, t) for row, s in enumerate(samples) for t in most_visible_per_token(s.targets, grid)
    ]

    def integers(rows: list[tuple[int, ...]], columns: int) -> Tensor:
        return torch.tensor(rows, dtype=torch.long).reshape(-1, columns)

    at = integers([(row, t.token(grid)) for row, t in objects], 2)
    presence = torch.zeros(visual.shape)
    presence[at[:, 0], at[:, 1]] = 1
    truth = stack_targets([t for _, t in objects])
    scaled = truth["place"] * grid
    truth["place"] = truth["place"] - 0.5

    has_picture = torch.tensor(
        [[0 <= s.last + k < s.sample.pictures for k in range(PICTURES)] for s in samples]
    )
    return OracleTargets(
        visual=visual,
        start=start,
        has_picture=has_picture,
        presence=presence,
        objects=at,
        truth=truth,
        inside=scaled - scaled.floor().clamp(0, grid - 1) - 0.5,
        tracked_to_clip=integers([*track_to_clip(samples, objects, grid)], 3),
        tracked_to_candidates=integers([*track_to_candidates(samples, objects, grid)], 4),
        names=integers([(m.row, m.position) for m in mentions], 2),
        name_words=name_words([m.name for m in mentions]),
        name_tokens=integers([m.found for m in mentions], PICTURES),
        described_tokens=integers(
            [
                (m.row, m.position, m.found[m.picture])
                for m in mentions
                if has_picture[m.row, m.picture]
            ],
            3,
        ),
        name_places=torch.tensor([m.places for m in mentions]).reshape(-1, 2 * PICTURES) - 0.5,
        name_displacements=torch.tensor([m.future for m in mentions]).reshape(-1, 2),
        description_tokens=integers([(m.row, k) for m in mentions for k in m.spoken], 2),
        description_states=torch.tensor(
            [(*m.state, *m.offset, *m.off) for m in mentions for _ in m.spoken]
        ).reshape(-1, 8),
        description_letters=torch.tensor(
            [-1 if m.section == "Outcome" else m.picture - 1 for m in mentions for _ in m.spoken],
            dtype=torch.long,
        ),
        subjects=integers([(m.row, k, m.position) for m in mentions for k in m.spoken[1:]], 3),
        owners=integers(
            [(m.row, k, m.owner) for m in mentions if m.owner is not None for k in m.spoken], 3
        ),
        text_letters=integers(
            [(m.row, m.position, m.letter_at) for m in mentions if m.letter_at is not None], 3
        ),
        prompt_letters=integers(pairs["prompt_letters"], 3),
        repeats=integers([*find_repeats(mentions)], 3),
        text_tokens=integers(pairs["text_tokens"], 2),
        object_words=integers(pairs["object_words"], 2),
        spatial_words=integers(pairs["spatial_words"], 2),
        verdicts=integers(pairs["verdicts"], 3),
        choices=integers(pairs["choices"], 3),
        comparisons=integers(pairs["comparisons"], 3),
        mentioned=integers([*find_mentioned(mentions)], 3),
        matches=integers(pairs["matches"], 3),
        next_in_clip=integers([*find_next_in_clip(mentions)], 3),
        next_in_candidates=integers([*find_next_in_candidates(mentions)], 3),
    )


def find_repeats(mentions: Sequence[LocatedMention]) -> Iterator[tuple[int, int, int]]:
    """Yield the row, the position before a name that the text has mentioned before, and the
    position of the first token of its last mention."""
    mentioned: dict[tuple[int, str], int] = {}
    for m in mentions:
        if (m.row, m.name) in mentioned:
            yield m.row, m.first - 1, mentioned[m.row, m.name]
        mentioned[m.row, m.name] = m.first


def find_mentioned(mentions: Sequence[LocatedMention]) -> Iterator[tuple[int, int, int]]:
    """Yield the row, the position before a name in a section about the scene, and the position of
    each other name that the section has mentioned before, where it was last mentioned."""
    by_section: dict[tuple[int, str | None], dict[str, int]] = {}
    for m in mentions:
        if m.letter_at is not None:
            continue
        mentioned = by_section.setdefault((m.row, m.section), {})
        yield from ((m.row, m.first - 1, at) for name, at in mentioned.items() if name != m.name)
        mentioned[m.name] = m.position


def find_next_in_clip(mentions: Sequence[LocatedMention]) -> Iterator[tuple[int, int, int]]:
    """Yield the row, the position before the first mention of an object in a scene parse, and the
    object's visual token at the end of the clip."""
    mentioned = set()
    for m in mentions:
        if m.section == "Scene parse" and (m.row, m.name) not in mentioned and m.found[0] >= 0:
            yield m.row, m.first - 1, m.found[0]
        mentioned.add((m.row, m.name))


def find_next_in_candidates(mentions: Sequence[LocatedMention]) -> Iterator[tuple[int, int, int]]:
    """Yield the row, the position before the first mention of an object in a text and in its
    predictions, and the object's visual token in the last candidate that shows it."""
    mentioned = set()
    for m in mentions:
        shown = [token for token in m.found[1:] if token >= 0]
        key = m.row, m.name, m.section == "Prediction"
        if key not in mentioned and shown:
            yield m.row, m.first - 1, shown[-1]
        mentioned.add(key)


def track_to_candidates(
    samples: Sequence[OracleSample], objects: Sequence[tuple[int, ObjectTarget]], grid: int
) -> Iterator[tuple[int, int, int, int]]:
    """Yield the row, the visual token of each object in a candidate, the index of each earlier
    candidate, and the token of the same object there, or -1 if it is not visible there."""
    shown = [shown_objects(s) for s in samples]
    for row, t in objects:
        first = samples[row].last + 1
        for k in range(t.picture - first):
            earlier = shown[row].get((first + k, t.name))
            yield row, t.token(grid), k, earlier.token(grid) if earlier else -1


def track_to_clip(
    samples: Sequence[OracleSample], objects: Sequence[tuple[int, ObjectTarget]], grid: int
) -> Iterator[tuple[int, int, int]]:
    """Yield the row, the visual token in a candidate and that at the end of the clip of each object
    that both show."""
    before = [{t.name: t for t in s.targets if t.picture == s.last} for s in samples]
    for row, t in objects:
        if t.picture > samples[row].last and t.name in before[row] and not np.isnan(t.since[0]):
            yield row, t.token(grid), before[row][t.name].token(grid)


def shown_objects(sample: OracleSample) -> dict[tuple[int, str], ObjectTarget]:
    """Return the visible objects of a sample by picture and name."""
    return {(t.picture, t.name): t for t in sample.targets}


def measure_error(
    sample: OracleSample, shown: Mapping[tuple[int, str], ObjectTarget], mention: Mention
) -> tuple[float, float]:
    """Return the displacement of a named object in the candidate that the text speaks of from its
    place in the supposed target or, if none is supposed, at the target; NaN where the oracle does
    not determine it."""
    if mention.letter is None:
        return UNKNOWN
    there = shown.get((sample.last + 1 + LETTERS.index(mention.letter), mention.name))
    if mention.supposed is not None:
        place = sample.last + 1 + LETTERS.index(mention.supposed), mention.name
        expected = shown[place].place if place in shown else UNKNOWN
    else:
        expected = predicted_place(sample, shown, mention.name)
    if there is None:
        return UNKNOWN
    return there.place[0] - expected[0], there.place[1] - expected[1]


def predicted_place(
    sample: OracleSample, shown: Mapping[tuple[int, str], ObjectTarget], name: str
) -> tuple[float, float]:
    """Return the place of an object at the target, if the response predicts it; NaN if it does not
    or if the object is not visible at the end of the clip or at the target."""
    now, moved = shown.get((sample.last, name)), sample.future.get(name)
    if now is None or moved is None or not sample.predicts_target:
        return UNKNOWN
    return now.place[0] + moved[0], now.place[1] + moved[1]


def spoken_state(
    sample: OracleSample, shown: Mapping[tuple[int, str], ObjectTarget], mention: Mention
) -> tuple[float, ...]:
    """Return the place (from -0.5 to 0.5) and the velocity of a named object in the picture that
    the text speaks of there; NaN where the oracle does not determine them."""
    place, velocity = UNKNOWN, UNKNOWN
    if mention.letter is not None:
        seen = shown.get((sample.last + 1 + LETTERS.index(mention.letter), mention.name))
        place = seen.place if seen else UNKNOWN
    elif mention.section in ("Prediction", "Outcome"):
        place = predicted_place(sample, shown, mention.name)
    elif mention.name in sample.observed:
        state = sample.observed[mention.name]
        place, velocity = state[:2], state[2:]
    return place[0] - 0.5, place[1] - 0.5, *velocity
