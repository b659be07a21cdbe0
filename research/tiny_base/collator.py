"""Batches of samples of the tiny base, with the targets of its losses."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
import torch
from torch import Tensor
from transformers import PreTrainedTokenizerBase, ProcessorMixin

from dynapix.data.records import LETTERS
from dynapix.models.student.collator import Collator
from research.tiny_base.mentions import (
    LocatedMention,
    TokenizedText,
    find_next_in_candidates,
    find_next_in_clip,
    find_repeats,
    locate_mentions,
)
from research.tiny_base.oracle_targets import (
    PICTURES,
    SPATIAL_WORDS,
    WORDS,
    ObjectTarget,
    OracleTargets,
    most_visible_per_token,
    name_words,
    stack_targets,
)
from research.tiny_base.samples import OracleSample, shown_objects


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
            "choices": [], "matches": [],
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
        description_tokens=integers([(m.row, k) for m in mentions for k in m.described], 2),
        description_states=torch.tensor(
            [(*m.state, *m.offset, *m.error) for m in mentions for _ in m.described]
        ).reshape(-1, 8),
        description_letters=torch.tensor(
            [
                -1 if m.section == "Outcome" else m.picture - 1
                for m in mentions
                for _ in m.described
            ],
            dtype=torch.long,
        ),
        subjects=integers([(m.row, k, m.position) for m in mentions for k in m.described[1:]], 3),
        references=integers(
            [
                (m.row, k, m.reference)
                for m in mentions
                if m.reference is not None
                for k in m.described
            ],
            3,
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
        matches=integers(pairs["matches"], 3),
        next_in_clip=integers([*find_next_in_clip(mentions)], 3),
        next_in_candidates=integers([*find_next_in_candidates(mentions)], 3),
    )


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
