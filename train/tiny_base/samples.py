"""Samples of the tiny base: prompts as students read them, with what the oracle knows of them.

A sample shows the clip, the candidates, both or neither, as a selection prompt shows them, and asks
a question of `train.tiny_base.questions`, or none.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from data.records import LETTERS, SelectionItem, original_scene_id, sample_prefix_frames
from data.render.frame_cache import FrameReader
from models.student.prompts import Sample, build_sample, load_clip
from teacher.predicates.motion import find_cut
from train.tiny_base.oracle_targets import (
    ObjectTarget,
    clip_targets,
    compare_images,
    future_displacements,
    image_targets,
    observed_states,
)
from train.tiny_base.questions import Question


@dataclass(frozen=True)
class OracleSample:
    """A sample, and the visible objects in its pictures.

    Attributes:
        last: Index of the last picture of the clip, which the candidates follow; -1 without clip.
        observed: Places and velocities of objects, by name, at the cut, which texts about the clip
            describe.
        future: Displacements of objects, by name, from the end of the clip to the moment of the
            target.
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
    sample = build_sample(item.item_id, parts, question.answer, clip)
    sample = replace(sample, false_spans=question.false_spans)
    return OracleSample(sample, tuple(targets), last, observed, future, question.predicts_target)


def shown_objects(sample: OracleSample) -> dict[tuple[int, str], ObjectTarget]:
    """Return the visible objects of a sample by picture and name."""
    return {(t.picture, t.name): t for t in sample.targets}
