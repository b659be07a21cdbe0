"""Samples of the tiny base: prompts as students read them, with what the oracle knows of them.

A sample shows the clip, the candidates, both or neither, as a selection prompt shows them, and asks
a question of `research.tiny_base.questions`, or none. The base is trained on the items of some
scenes and measured on those of held-out scenes.

A model makes mistakes in the predictions and descriptions that it writes. If it was trained only on
true texts, it relies on these mistakes when it chooses a candidate. So some words for places and
relations are replaced by false ones, and the loss ignores them: the base learns to continue
correctly after a mistake, but not to write one.
"""

from __future__ import annotations

import re
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace

import numpy as np

from dynapix.conf.runs import rank, world_size
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import (
    COLORS,
    LETTERS,
    SelectionItem,
    original_scene_id,
    sample_prefix_frames,
)
from dynapix.data.store import Store
from dynapix.models.student.prompts import Sample, build_sample, load_clip
from dynapix.teacher.candidate_letters import reorder_candidates
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.facts import REGIONS
from dynapix.teacher.predicates.motion import find_cut
from dynapix.teacher.predicates.relations import VALUES
from dynapix.teacher.sections import split_sections
from dynapix.teacher.writers.relational import PHRASES
from dynapix.train.common.held_out import check_not_empty, held_out_scenes
from dynapix.train.student.dataset import prompt_corpus, uses_only
from dynapix.train.student.samples import seeded_rng
from research.tiny_base.oracle_targets import (
    ObjectTarget,
    clip_targets,
    compare_images,
    future_displacements,
    image_targets,
    observed_states,
)
from research.tiny_base.questions import KINDS, QUESTIONS, Question, make_question

PICTURES_ONLY = {
    "clip": Question("", "", candidates=False),
    "candidates": Question("", "", clip=False),
    "pictures": Question("", ""),
}
"""What the samples of the stages without words show; they ask nothing."""
COMPARISONS = ("compare", "explain")
"""The kinds of questions whose answers compare candidates with a prediction."""
QUESTION_CYCLE = (*KINDS, *COMPARISONS)
"""The kinds of questions of successive steps. Comparing candidates is harder than the rest."""
SAMPLE_KINDS = {"vision": ("clip", "candidates"), "motion": ("pictures",), "words": QUESTION_CYCLE}
"""The kinds of successive samples of each stage. The pictures of an item resemble each other, so a
step of `vision` shows parts of more items."""
FALSE_WORDS = 0.25
"""Share of the words for places and relations that are replaced in training, in answers to
`COMPARISONS`. A trained base writes about as large a share of its regions wrongly."""
CORPUS_ITEMS = 800
"""Number of items whose texts the tokenizer is trained on."""
FALSIFIED_SECTIONS = ("Prediction", "Candidate analysis")
FALSIFIED_KINDS = ("side", "height", "gap", "cover", "extreme")
"""Kinds of relations whose words are replaced by another word of the kind."""


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


def shown_objects(sample: OracleSample) -> dict[tuple[int, str], ObjectTarget]:
    """Return the visible objects of a sample by picture and name."""
    return {(t.picture, t.name): t for t in sample.targets}


def split_items(
    store: Store, frames: FrameReader
) -> tuple[list[SelectionItem], list[SelectionItem]]:
    """Return the training items, and the items of held-out scenes. Items with too short a prefix to
    describe are left out."""
    held_out = held_out_scenes(store)
    training_scenes = set(store.scene_ids("train")) - held_out
    items = [
        item
        for item in store.selection("train")
        if extract_predicates(item, frames.scene(item.scene_id), frames.scene) is not None
    ]
    training = [item for item in items if uses_only(item, training_scenes)]
    # A distractor may show another scene: an item that shows both kinds of scenes is left out.
    validation = [item for item in items if uses_only(item, held_out)]
    check_not_empty(len(training), "training items", "teacher.narrate")
    check_not_empty(len(validation), "items of held-out training scenes", "teacher.narrate")
    return training, validation


@dataclass(frozen=True)
class ItemSampler:
    """Makes the samples of each stage and step."""

    items: Sequence[SelectionItem]
    frames: FrameReader
    frame_count: int
    seed: int

    def make_batch(self, stage: str, step: int, size: int) -> list[OracleSample]:
        """Return this rank's samples of a step with `size` samples over all ranks. All are of the
        same kind, so that they show the same number of pictures."""
        samples = []
        kind = SAMPLE_KINDS[stage][step % len(SAMPLE_KINDS[stage])]
        for position in range(step * size + rank(), (step + 1) * size, world_size()):
            epoch, index = divmod(position, len(self.items))
            order = seeded_rng(self.seed, stage, epoch).permutation(len(self.items))
            item, key = self.items[order[index]], f"{stage} {epoch}"
            samples.append(self.make_sample(item, kind, key, FALSE_WORDS))
        return samples

    def make_sample(
        self, item: SelectionItem, kind: str, key: str, false_words: float = 0.0
    ) -> OracleSample:
        """Return a sample of an item (see `ask_question`)."""
        return self.show_question(*self.ask_question(item, kind, key, false_words))

    def ask_question(
        self, item: SelectionItem, kind: str, key: str, false_words: float = 0.0
    ) -> tuple[SelectionItem, Question]:
        """Return an item with its candidates in random order, and a question about it.

        Args:
            kind: The kind of question, or of `PICTURES_ONLY`.
            key: Seed of the order and of the question, with the run's seed and the item.
            false_words: Share of the words for places and relations that are replaced in answers
                that compare candidates with a prediction.
        """
        rng = seeded_rng(self.seed, key, item.item_id)
        item = reorder_candidates(item, rng.permutation(len(LETTERS)).tolist())
        if kind in PICTURES_ONLY:
            return item, PICTURES_ONLY[kind]
        question = make_question(kind, item, self.frames.scene, rng)
        if kind in COMPARISONS:
            answer, spans = falsify_words(question.answer, false_words, rng)
            question = replace(question, answer=answer, false_spans=spans)
        return item, question

    def show_question(self, item: SelectionItem, question: Question) -> OracleSample:
        """Return the sample of a question about an item."""
        scene = self.frames.scene(item.scene_id)
        targets: list[ObjectTarget] = []
        parts: list[str | np.ndarray] = [item.question]
        clip, last, observed, future = None, -1, {}, {}
        if question.clip:
            seen = sample_prefix_frames(item.prefix_start, item.prefix_stop, self.frame_count)
            clip, last = load_clip(item.scene_id, seen, self.frames), (len(seen) + 1) // 2 - 1
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
                images.append(
                    [*image_targets(self.frames.scene(c.scene_id), c.frame, picture, before)]
                )
                parts += [f"\nCandidate {letter}: ", self.frames.array(c.scene_id, c.frame)]
            targets += compare_images(images)
        parts.append(f"\n{question.text}")
        sample = build_sample(item.item_id, parts, question.answer, clip)
        sample = replace(sample, false_spans=question.false_spans)
        return OracleSample(
            sample, tuple(targets), last, observed, future, question.predicts_target
        )


def tokenizer_corpus(sampler: ItemSampler) -> list[str]:
    """Return texts to train the tokenizer on: the answers of the base, and prompts of students."""
    items = sampler.items
    step = max(1, len(items) // CORPUS_ITEMS)
    answers = [
        sampler.ask_question(item, kind, "tokenizer")[1].answer
        for item in items[::step]
        for kind in KINDS
    ]
    return prompt_corpus(items, QUESTIONS) + answers


def list_alternatives() -> dict[str, list[str]]:
    """Return the words that may replace each word: for a region those beside it, and for a relation
    the others of its kind."""
    found = {
        region: [
            other
            for y, others in enumerate(REGIONS)
            for x, other in enumerate(others)
            if abs(x - column) + abs(y - row) == 1
        ]
        for row, regions in enumerate(REGIONS)
        for column, region in enumerate(regions)
    }
    for kind in FALSIFIED_KINDS:
        words = [PHRASES[value].removesuffix(" {b}") for value in VALUES[kind]]
        found |= {word: [other for other in words if other != word] for word in words}
    return found


ALTERNATIVES = list_alternatives()
WORD = re.compile(
    rf"\b(?:{'|'.join(sorted(ALTERNATIVES, key=len, reverse=True))})"
    # "near" is a relation only before an object: "near the red cube", "near it".
    rf"(?![-\w])(?:(?<!\bnear)|(?= it\b| the (?:{'|'.join(COLORS)})\b))"
)


def falsify_words(
    text: str, share: float, rng: np.random.Generator
) -> tuple[str, tuple[tuple[int, int], ...]]:
    """Replace a share of the words for places and relations in predictions and candidate analyses.

    Args:
        share: Probability that a word is replaced.
        rng: Chooses the words and their replacements.

    Returns:
        The text, and the spans that are not to be trained: each false word and the character after
        it, because "near the top" may replace "near the top-left".
    """
    parts, spans, length, end = [], [], 0, 0
    for title, start, stop in split_sections(text):
        if title not in FALSIFIED_SECTIONS:
            continue
        for match in WORD.finditer(text, start, stop):
            if rng.random() >= share:
                continue
            options = ALTERNATIVES[match.group()]
            false = options[rng.integers(len(options))]
            before = text[end : match.start()]
            parts += [before, false]
            length += len(before) + len(false)
            spans.append((length - len(false), length + 1))
            end = match.end()
    return "".join([*parts, text[end:]]), tuple(spans)
