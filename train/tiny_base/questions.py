"""Questions about frames and clips that train the tiny base to recognise objects and motion.

The oracle answers them. They are about a single frame and about four candidates (the objects and
their places), about the motion of an object in a clip, about a clip and its outcome in the words of
the built-in narrator, about candidates compared with such a description, about which of two frames
is the later one, and about which candidate fits a description. None is the selection task.
"""

from __future__ import annotations

from collections.abc import Callable, Collection, Iterator
from dataclasses import dataclass, replace
from functools import partial
from typing import NamedTuple

import numpy as np

from data.records import LETTERS, Scene, SelectionItem, sample_prefix_frames
from data.render.frame_cache import FrameReader
from data.store import Store
from models.student.prompts import (
    Clip,
    ObjectLabel,
    Sample,
    answer_line,
    conversation,
    load_clip,
)
from teacher.narrator import write_description, write_match_lines
from teacher.predicates import (
    REGIONS,
    Predicates,
    extract_facts,
    extract_predicates,
    object_heading,
    object_region,
)
from train.student.lazy_samples import LazySample, seeded_rng

FRAME = "Describe the frame."
CANDIDATES = "Describe each candidate."
WHERE = "Where does each candidate show the {}?"
COMPARE = "Compare each candidate with the prediction by the {}."
MOVES = "How does the {} move?"
CLIP = "Describe the scene, how its objects move, and what will come of it."
LATER = 'Which candidate comes later? End with a line "Answer:" and the letter.'
MATCH = (
    "Which candidate shows {}? Say of each candidate, in a line of its own, whether it matches and "
    'why. End with a line "Answer:" and the letter.'
)
QUESTIONS = (FRAME, CANDIDATES, WHERE, COMPARE, MOVES, CLIP, LATER, MATCH)
MOVED = 0.08
"""Least displacement of an object in the later of two frames, as a share of the image's width."""
CLEAR = 0.3
"""Visible fraction above which a visual token should name an object."""
HIDDEN = 0.05
"""Visible fraction at or below which an object is not described."""
NAMED = 4
"""Most objects that a description names."""


class Picture(NamedTuple):
    """A frame in a prompt, with its letter if it is a candidate."""

    scene_id: str
    frame: int
    letter: str = ""


@dataclass(frozen=True)
class Question:
    """A question about pictures or a clip, and its answer.

    Attributes:
        after_clip: Whether the prompt begins with the clip of the item's prefix.
    """

    text: str
    answer: str
    pictures: list[Picture]
    after_clip: bool = False


def build_questions(
    store: Store, items: list[SelectionItem], frame_count: int, frames: FrameReader, seed: int
) -> dict[str, list[LazySample]]:
    """Return samples by kind of question. Frames, candidates and their order are random in each
    epoch."""
    builder = QuestionBuilder(store, items, frame_count, frames, seed)
    return {kind: [s for item in items for s in builder.samples(item, kind)] for kind in KINDS}


@dataclass(frozen=True)
class QuestionBuilder:
    """Builds questions about items; seed, epoch and item determine the random choices.

    Each kind of question has a method, which returns None for items that do not allow it.
    """

    store: Store
    items: list[SelectionItem]
    frame_count: int
    frames: FrameReader
    seed: int

    def samples(self, item: SelectionItem, kind: str) -> Iterator[LazySample]:
        """Return the samples of a kind; the first epoch's question estimates their length."""
        if first := self.build(item, kind, 0, epoch=0):
            media = len(first.pictures) + self.frame_count // 2 * first.after_clip
            for repeat in range(KINDS[kind][1]):
                render = partial(self.render, item, kind, repeat)
                yield LazySample(f"{first.text} {first.answer}", media, render)

    def build(self, item: SelectionItem, kind: str, repeat: int, epoch: int) -> Question | None:
        method, repeats = KINDS[kind]
        keys = (kind, repeat) if repeats > 1 else (kind,)
        return method(self, item, seeded_rng(self.seed, epoch, item.item_id, *keys))

    def render(self, item: SelectionItem, kind: str, repeat: int, epoch: int) -> Sample:
        """Return the sample of a question: the clip, the pictures with their captions, the text."""
        question = self.build(item, kind, repeat, epoch)
        clip, labels = self.labelled_clip(item) if question.after_clip else (None, [])
        pairs = (len(clip.indices) + 1) // 2 if clip else 0
        parts: list[str | np.ndarray] = []
        for k, picture in enumerate(question.pictures, pairs):
            if picture.letter:
                parts.append(f"\nCandidate {picture.letter}: ")
            elif clip:
                parts.append("Later: ")
            parts.append(self.frames.array(picture.scene_id, picture.frame))
            objects = visible_objects(self.store.scene(picture.scene_id), picture.frame)
            labels += [ObjectLabel(k, at, (*words, *picture.letter)) for _, at, words in objects]
        parts.append(f"\n{question.text}" if question.pictures else question.text)
        name = f"{item.item_id} ({kind} {repeat})"
        return conversation(name, parts, question.answer, clip, labels)

    def labelled_clip(self, item: SelectionItem) -> tuple[Clip, list[ObjectLabel]]:
        """Return the clip of an item's prefix, and its objects with their headings. A visual token
        of a clip covers two frames; objects are labelled as in the first."""
        indices, scene = self.prefix_frames(item), self.scene(item)
        labels = []
        for k, pair in enumerate(zip(indices[::2], [*indices[1::2], indices[-1]], strict=False)):
            for index, place, words in visible_objects(scene, pair[0]):
                heading = object_heading(scene, index, *pair) or "stationary"
                labels.append(ObjectLabel(k, place, (*words, heading)))
        return load_clip(item.scene_id, indices, self.frames), labels

    def frame(self, item: SelectionItem, rng: np.random.Generator) -> Question:
        """The objects of a frame and their places."""
        scene_id, frame = self.random_frame(item, rng)
        answer = describe_frame(self.store.scene(scene_id), frame)
        return Question(FRAME, answer, [Picture(scene_id, frame)])

    def candidates(self, item: SelectionItem, rng: np.random.Generator) -> Question:
        """The objects and places of four candidates."""
        pictures = self.random_four(item, rng)
        lines = [
            f"Candidate {p.letter}: {describe_frame(self.store.scene(p.scene_id), p.frame)}"
            for p in pictures
        ]
        return Question(CANDIDATES, "\n".join(lines), pictures)

    def where(self, item: SelectionItem, rng: np.random.Generator) -> Question:
        """The place of one object in four candidates, as a rationale compares them."""
        pictures = self.random_four(item, rng)
        places = self.regions(pictures)
        phrase = self.choose_object(item, {p for objects in places for p in objects}, places, rng)
        answer = " ".join(
            f"{format_place(letter, phrase, objects.get(phrase))}."
            for letter, objects in zip(LETTERS, places, strict=True)
        )
        return Question(WHERE.format(phrase), answer, pictures)

    def moves(self, item: SelectionItem, rng: np.random.Generator) -> Question | None:
        """The motion of an object in the clip; half of the objects are stationary."""
        facts = extract_facts(
            self.scene(item), item.prefix_start, item.prefix_stop, item.target_frame
        )
        visible = [o for o in facts.objects if o.sight == "shown"] if facts else []
        if not visible:
            return None
        stationary = rng.random() < 0.5
        chosen = [o for o in visible if (o.speed == "stationary") == stationary] or visible
        o = chosen[rng.integers(len(chosen))]
        moment = f"{facts.instant[0].upper()}{facts.instant[1:]}"
        heading = f" toward the {o.heading}" if o.heading else ""
        motion = "does not move" if o.speed == "stationary" else f"moves {o.speed}{heading}"
        answer = f"{moment}, the {o.object} is {o.region} and {motion}."
        return Question(MOVES.format(o.object), answer, [], after_clip=True)

    def clip(self, item: SelectionItem, rng: np.random.Generator) -> Question | None:
        """The clip and its outcome; in half of the samples the target frame is visible."""
        if (text := self.describe_clip(item)) is None:
            return None
        target = [Picture(item.scene_id, item.target_frame)]
        return Question(CLIP, text, target if rng.random() < 0.5 else [], after_clip=True)

    def compared(self, item: SelectionItem, rng: np.random.Generator) -> Question | None:
        """An object's place in the item's candidates, compared with a description of the clip.

        As in a rationale, the text has the predicted place before the visible places, and the model
        must not confuse them. The description is part of the prompt: as part of the response it
        would outweigh the few words about visible places in the loss.
        """
        if (text := self.describe_clip(item)) is None:
            return None
        pictures = self.permuted_candidates(item, rng)
        places = self.regions(pictures)
        predicted = visible_regions(self.scene(item), item.target_frame)
        phrase = self.choose_object(item, predicted, places, rng)
        expected, verdicts = predicted.get(phrase), []
        for letter, objects in zip(LETTERS, places, strict=True):
            place = objects.get(phrase)
            difference = f", not {expected}" if place and expected else ""
            verdict = " and agrees" if place == expected else difference
            verdicts.append(f"{format_place(letter, phrase, place)}{verdict}.")
        question = f"{text}\n{COMPARE.format(phrase)}"
        return Question(question, " ".join(verdicts), pictures, after_clip=True)

    def later(self, item: SelectionItem, rng: np.random.Generator) -> Question | None:
        """Which of two distinguishable frames is later; only if something moves after the clip."""
        if not (frames := find_moved_frames(self.scene(item), item.prefix_stop)):
            return None
        pair = item.prefix_stop, frames[rng.integers(len(frames))]
        order = rng.permutation(2).tolist()
        pictures = add_letters([(item.scene_id, pair[k]) for k in order])
        return Question(LATER, answer_line(LETTERS[order.index(1)]), pictures, after_clip=True)

    def match(self, item: SelectionItem, rng: np.random.Generator) -> Question | None:
        """The one candidate that fits a description, if regions distinguish it."""
        predicates = extract_predicates(item, self.scene(item), self.store.scene)
        predicates = predicates and keep_regional_differences(predicates)
        if not predicates:
            return None
        differing = {d.object for c in predicates.candidates for d in c.differences[:1]}
        visible = [o for o in predicates.objects if o.target_sight == "shown"]
        visible.sort(key=lambda o: o.object not in differing)
        named = ", ".join(f"the {o.object} {o.target_region}" for o in visible[:NAMED])
        answer = "\n".join([*write_match_lines(predicates, item), answer_line(item.letter)])
        pictures = add_letters([(c.scene_id, c.frame) for c in item.candidates])
        return Question(MATCH.format(named), answer, pictures)

    def scene(self, item: SelectionItem) -> Scene:
        return self.store.scene(item.scene_id)

    def describe_clip(self, item: SelectionItem) -> str | None:
        """The clip and its outcome by the built-in narrator; None if the clip is too short."""
        return write_description(
            self.scene(item), item.prefix_start, item.prefix_stop, item.target_frame, self.seed
        )

    def regions(self, pictures: list[Picture]) -> list[dict[str, str]]:
        """The regions of the visible objects of each picture."""
        return [visible_regions(self.store.scene(p.scene_id), p.frame) for p in pictures]

    def choose_object(
        self,
        item: SelectionItem,
        visible: Collection[str],
        places: list[dict[str, str]],
        rng: np.random.Generator,
    ) -> str:
        """A random visible object, if possible one whose place distinguishes candidates."""
        names = sorted(visible) or [o.noun_phrase for o in self.scene(item).objects]
        names = [p for p in names if len({objects.get(p) for objects in places}) > 1] or names
        return names[rng.integers(len(names))]

    def permuted_candidates(self, item: SelectionItem, rng: np.random.Generator) -> list[Picture]:
        frames = [(c.scene_id, c.frame) for c in item.candidates]
        return add_letters([frames[place] for place in rng.permutation(len(frames))])

    def random_four(self, item: SelectionItem, rng: np.random.Generator) -> list[Picture]:
        """An item's own candidates or, easier to distinguish, frames of four random items."""
        if rng.random() < 0.5:
            return self.permuted_candidates(item, rng)
        items = [self.items[k] for k in rng.integers(len(self.items), size=len(LETTERS))]
        return add_letters([self.random_frame(other, rng) for other in items])

    def random_frame(self, item: SelectionItem, rng: np.random.Generator) -> tuple[str, int]:
        """A frame of an item's candidates or prefix."""
        frames = [(c.scene_id, c.frame) for c in item.candidates]
        frames += [(item.scene_id, f) for f in self.prefix_frames(item)]
        return frames[rng.integers(len(frames))]

    def prefix_frames(self, item: SelectionItem) -> list[int]:
        return sample_prefix_frames(item.prefix_start, item.prefix_stop, self.frame_count)


KINDS: dict[str, tuple[Callable[..., Question | None], int]] = {
    "frame": (QuestionBuilder.frame, 2),
    "candidates": (QuestionBuilder.candidates, 2),
    "where": (QuestionBuilder.where, 2),
    # Motion is a few pixels per frame, and no other question about a clip requires it.
    "moves": (QuestionBuilder.moves, 6),
    "clip": (QuestionBuilder.clip, 2),
    "compared": (QuestionBuilder.compared, 3),
    "later": (QuestionBuilder.later, 1),
    "match": (QuestionBuilder.match, 1),
}
"""The kinds of questions: their method, and how often they are asked per item and epoch."""


def add_letters(frames: list[tuple[str, int]]) -> list[Picture]:
    return [Picture(*frame, letter) for frame, letter in zip(frames, LETTERS, strict=False)]


def format_place(letter: str, phrase: str, place: str | None) -> str:
    if place is None:
        return f"Candidate {letter} lacks the {phrase}"
    return f"Candidate {letter} shows the {phrase} {place}"


def visible_regions(scene: Scene, frame: int) -> dict[str, str]:
    """The region of each visible object of a frame, by the object's phrase."""
    return {
        o.noun_phrase: object_region(scene, frame, k)
        for k, o in enumerate(scene.objects)
        if scene.in_view[frame, k] and scene.visible_fraction[frame, k] > HIDDEN
    }


def describe_frame(scene: Scene, frame: int) -> str:
    """The visible objects of a frame and their regions, from the top-left to the bottom-right."""
    order = [region for row in REGIONS for region in row]
    places = [(order.index(region), o) for o, region in visible_regions(scene, frame).items()]
    sentences = [f"The {phrase} is {order[place]}." for place, phrase in sorted(places)]
    return " ".join(sentences) or "No object is in view."


def visible_objects(
    scene: Scene, frame: int
) -> Iterator[tuple[int, tuple[float, float], tuple[str, ...]]]:
    """The clearly visible objects of a frame: index, place as shares of width and height, words."""
    places = scene.image_positions[frame] / np.asarray(scene.image_size)
    visible = scene.in_view[frame] & (scene.visible_fraction[frame] > CLEAR)
    for k in np.flatnonzero(visible):
        yield int(k), tuple(places[k].tolist()), tuple(scene.objects[k].noun_phrase.split())


def find_moved_frames(scene: Scene, start: int) -> list[int]:
    """The frames after `start` in which an object in view has moved by more than MOVED."""
    displacement = scene.image_positions[start + 1 :] - scene.image_positions[start]
    far = np.hypot(*np.moveaxis(displacement, -1, 0)) > MOVED * scene.image_size[0]
    in_view = scene.in_view[start + 1 :] & scene.in_view[start]
    return (start + 1 + np.flatnonzero((far & in_view).any(axis=1))).tolist()


def keep_regional_differences(predicates: Predicates) -> Predicates | None:
    """Predicates with only the differences in regions and missing objects; None if a wrong
    candidate has no such difference."""
    candidates = []
    for c in predicates.candidates:
        differences = tuple(d for d in c.differences if d.kind in ("region", "missing"))
        if not c.agrees and not differences:
            return None
        candidates.append(replace(c, differences=differences))
    return replace(predicates, candidates=tuple(candidates))
