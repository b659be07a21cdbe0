"""Samples of the tiny base: prompts as students read them, with what the oracle knows of them.

A sample shows a clip and four candidates, as a selection prompt does, and asks one of the questions
of `train.tiny_base.questions`.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np
import torch
from torch import Tensor
from transformers import ProcessorMixin

from data.records import (
    LETTERS,
    SelectionItem,
    original_scene_id,
    sample_prefix_frames,
)
from data.render.frame_cache import FrameReader
from models.student.collator import Collator
from models.student.prompts import Sample, conversation, load_clip
from train.tiny_base.heads import PICTURES, OracleTargets
from train.tiny_base.mentions import Mention, find_mentions
from train.tiny_base.oracle_targets import (
    UNKNOWN,
    ObjectTarget,
    clip_targets,
    future_displacements,
    image_targets,
    largest_per_token,
    name_words,
    stack_targets,
)
from train.tiny_base.questions import Question


@dataclass(frozen=True)
class OracleSample:
    """A sample, and the visible objects in its pictures.

    Attributes:
        last: Index of the last picture of the clip, which the candidates follow; -1 without clip.
        future: Displacements of objects, by name, from the end of the clip to the moment that the
            item asks for.
        foresees: Whether predictions in the response are true of that moment.
    """

    sample: Sample
    targets: tuple[ObjectTarget, ...]
    last: int
    future: Mapping[str, tuple[float, float]]
    foresees: bool


def make_sample(
    item: SelectionItem, question: Question, frames: FrameReader, frame_count: int
) -> OracleSample:
    """Return the sample of a question about an item."""
    scene = frames.scene(item.scene_id)
    targets: list[ObjectTarget] = []
    parts: list[str | np.ndarray] = [item.question]
    clip, last, future = None, -1, {}
    if question.clip:
        shown = sample_prefix_frames(item.prefix_start, item.prefix_stop, frame_count)
        clip, last = load_clip(item.scene_id, shown, frames), (len(shown) + 1) // 2 - 1
        targets += clip_targets(scene, shown)
        future = future_displacements(scene, item.prefix_stop, item.target_frame)
    if question.candidates:
        for picture, (letter, c) in enumerate(zip(LETTERS, item.candidates, strict=True), last + 1):
            follows = original_scene_id(c.scene_id) == original_scene_id(item.scene_id)
            before = (scene, item.prefix_stop) if follows and clip else None
            targets += image_targets(frames.scene(c.scene_id), c.frame, picture, before)
            parts += [f"\nCandidate {letter}: ", frames.array(c.scene_id, c.frame)]
    parts.append(f"\n{question.text}")
    sample = conversation(item.item_id, parts, question.answer, clip)
    return OracleSample(sample, tuple(targets), last, future, question.foresees)


class OracleCollator:
    """Makes batches of `OracleSample`s: the tensors of `Collator`, and `OracleTargets`."""

    def __init__(self, processor: ProcessorMixin, max_length: int) -> None:
        self._processor = processor
        self._collate = Collator(processor, max_length)

    def __call__(self, samples: Sequence[OracleSample]) -> tuple[dict[str, Any], OracleTargets]:
        batch = self._collate([s.sample for s in samples])
        ids = batch["input_ids"]
        media = torch.tensor([self._processor.image_token_id, self._processor.video_token_id])
        visual = torch.isin(ids, media).nonzero()[:, 1].reshape(len(samples), -1)
        tokens = visual.shape[1] // samples[0].sample.pictures
        return batch, self._stack(samples, visual, round(tokens**0.5), ids.shape[1])

    def _stack(
        self, samples: Sequence[OracleSample], visual: Tensor, grid: int, length: int
    ) -> OracleTargets:
        presence = torch.zeros(visual.shape)
        kept: list[ObjectTarget] = []
        objects: list[tuple[int, int]] = []
        tracked: list[tuple[int, int, int]] = []
        names: list[tuple[int, int]] = []
        named: list[str] = []
        found: list[list[int]] = []
        places: list[list[float]] = []
        future: list[tuple[float, float]] = []
        spoken: list[tuple[int, int]] = []
        said: list[tuple[float, ...]] = []
        subjects: list[tuple[int, int, int]] = []
        letters: list[tuple[int, int, int]] = []
        for row, s in enumerate(samples):
            largest = largest_per_token(s.targets, grid)
            at = {id(t): t.picture * grid**2 + t.cell(grid) for t in s.targets}
            kept += largest
            objects += [(row, at[id(t)]) for t in largest]
            presence[row, [at[id(t)] for t in largest]] = 1
            where = {(t.picture, t.name): t for t in s.targets}
            for t in largest:
                if t.picture > s.last and (s.last, t.name) in where and not np.isnan(t.since[0]):
                    tracked.append((row, at[id(t)], at[id(where[s.last, t.name])]))
            mentions, tokens = find_mentions(s.sample.response or "", self._processor.tokenizer)
            # The token that ends the turn follows the response.
            first = length - tokens - 1
            for m in mentions:
                name, position = m.name, first + m.last
                names.append((row, position))
                named.append(name)
                spoken += [(row, first + k) for k in range(m.last, m.stop)]
                said += [spoken_state(s, where, m)] * (m.stop - m.last)
                subjects += [(row, first + k, position) for k in range(m.last + 1, m.stop)]
                if m.letter_at is not None:
                    letters += [
                        (row, first + k, first + m.letter_at) for k in range(m.last, m.stop)
                    ]
                pictures = [where.get((s.last + k, name)) for k in range(PICTURES)]
                found.append([at[id(t)] if t else -1 for t in pictures])
                places.append([x for t in pictures for x in (t.place if t else UNKNOWN)])
                future.append(s.future.get(name, UNKNOWN))
        truth = stack_targets(kept)
        return OracleTargets(
            visual=visual,
            presence=presence,
            objects=torch.tensor(objects, dtype=torch.long).reshape(-1, 2),
            truth=truth,
            inside=truth["place"] * grid % 1 - 0.5,
            tracked=torch.tensor(tracked, dtype=torch.long).reshape(-1, 3),
            names=torch.tensor(names, dtype=torch.long).reshape(-1, 2),
            named=name_words(named),
            found=torch.tensor(found, dtype=torch.long).reshape(-1, PICTURES),
            places=torch.tensor(places).reshape(-1, 2 * PICTURES) - 0.5,
            future=torch.tensor(future).reshape(-1, 2),
            spoken=torch.tensor(spoken, dtype=torch.long).reshape(-1, 2),
            said=torch.tensor(said).reshape(-1, 4),
            subjects=torch.tensor(subjects, dtype=torch.long).reshape(-1, 3),
            letters=torch.tensor(letters, dtype=torch.long).reshape(-1, 3),
        )


def spoken_state(
    sample: OracleSample, where: Mapping[tuple[int, str], ObjectTarget], mention: Mention
) -> tuple[float, ...]:
    """Return the place (from -0.5 to 0.5) and the velocity of a named object in the picture that
    the text speaks of there; NaN where the oracle does not determine them."""
    now = where.get((sample.last, mention.name))
    place, velocity = UNKNOWN, UNKNOWN
    if mention.letter is not None:
        shown = where.get((sample.last + 1 + LETTERS.index(mention.letter), mention.name))
        place = shown.place if shown else UNKNOWN
    elif mention.section in ("Prediction", "Outcome"):
        moved = sample.future.get(mention.name, UNKNOWN) if sample.foresees else UNKNOWN
        place = (now.place[0] + moved[0], now.place[1] + moved[1]) if now else UNKNOWN
    elif now is not None:
        place, velocity = now.place, now.velocity
    return place[0] - 0.5, place[1] - 0.5, *velocity
