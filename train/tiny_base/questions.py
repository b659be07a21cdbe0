"""Questions about frames and clips that train the tiny base to recognise objects and motion.

The oracle determines the answers. The kinds of questions (`KINDS`) ask for

    frame       the objects of a frame and the regions where they are
    candidates  the same for each of four candidates
    where       the region of one object in each of four candidates
    moves       the motion of one object in a clip
    clip        a description of a clip and its outcome, as the built-in narrator writes it
    compared    the region of one object in each candidate, compared with such a description
    later       the later of two frames after a clip
    match       the candidate that fits a description

None of them is the selection task.
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
from models.student.prompts import Clip, ObjectLabel, Sample, answer_line, conversation, load_clip
from teacher.narrator import write_description, write_match_lines
from teacher.predicates.extraction import extract_facts, extract_predicates
from teacher.predicates.facts import REGIONS, Predicates
from teacher.predicates.motion import object_heading
from teacher.predicates.places import object_region
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
MIN_DISPLACEMENT = 0.08
"""A later frame is distinguishable if an object has moved by more than this share of the width."""
CLEARLY_VISIBLE = 0.3
"""An object gets labels at visual tokens if its visible fraction is above this."""
HIDDEN = 0.05
"""An object is described if its visible fraction is above this."""
MAX_NAMED = 4
"""Maximum number of objects that the description in a question of kind match names."""


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
    """Return samples by kind of question. In each epoch, frames, candidates and their order are
    chosen again."""
    builder = QuestionBuilder(store, items, frame_count, frames, seed)
    return {kind: [s for item in items for s in builder.samples(item, kind)] for kind in KINDS}


@dataclass(frozen=True)
class QuestionBuilder:
    """Builds questions about items.

    Each kind of question has a method, which returns None if an item does not allow the question.
    The random choices depend on the seed, the epoch, the item, the kind and the repetition.
    """

    store: Store
    items: list[SelectionItem]
    frame_count: int
    frames: FrameReader
    seed: int

    def samples(self, item: SelectionItem, kind: str) -> Iterator[LazySample]:
        """Yield the samples of a kind. Their length is estimated from the question of epoch 0."""
        if first := self.build(item, kind, 0, epoch=0):
            media = len(first.pictures) + -(-self.frame_count // 2) * first.after_clip
            for repeat in range(KINDS[kind][1]):
                render = partial(self.render, item, kind, repeat)
                yield LazySample(f"{first.text} {first.answer}", media, render)

    def build(self, item: SelectionItem, kind: str, repeat: int, epoch: int) -> Question | None:
        method, repeats = KINDS[kind]
        keys = (kind, repeat) if repeats > 1 else (kind,)
        return method(self, item, seeded_rng(self.seed, epoch, item.item_id, *keys))

    def render(self, item: SelectionItem, kind: str, repeat: int, epoch: int) -> Sample:
        """Return the sample of a question: the clip, the pictures with captions, and the text."""
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
        """Return the clip of an item's prefix, and labels of its objects with their headings. A
        visual token of a clip covers two frames; the labels are at the places in the first."""
        indices, scene = self.prefix_frames(item), self.scene(item)
        labels = []
        for k, pair in enumerate(zip(indices[::2], [*indices[1::2], indices[-1]], strict=False)):
            for index, place, words in visible_objects(scene, pair[0]):
                heading = object_heading(scene, index, *pair) or "stationary"
                labels.append(ObjectLabel(k, place, (*words, heading)))
        return load_clip(item.scene_id, indices, self.frames), labels

    def frame(self, item: SelectionItem, rng: np.random.Generator) -> Question:
        """Ask for the objects of a random frame and their regions."""
        scene_id, frame = self.random_frame(item, rng)
        answer = describe_frame(self.store.scene(scene_id), frame)
        return Question(FRAME, answer, [Picture(scene_id, frame)])

    def candidates(self, item: SelectionItem, rng: np.random.Generator) -> Question:
        """Ask for the objects and regions of four candidates."""
        pictures = self.random_four(item, rng)
        lines = [
            f"Candidate {p.letter}: {describe_frame(self.store.scene(p.scene_id), p.frame)}"
            for p in pictures
        ]
        return Question(CANDIDATES, "\n".join(lines), pictures)

    def where(self, item: SelectionItem, rng: np.random.Generator) -> Question:
        """Ask for the region of one object in four candidates, as a rationale compares them."""
        pictures = self.random_four(item, rng)
        places = self.regions(pictures)
        phrase = self.choose_object(item, {p for objects in places for p in objects}, places, rng)
        answer = " ".join(
            f"{format_place(letter, phrase, objects.get(phrase))}."
            for letter, objects in zip(LETTERS, places, strict=True)
        )
        return Question(WHERE.format(phrase), answer, pictures)

    def moves(self, item: SelectionItem, rng: np.random.Generator) -> Question | None:
        """Ask for the motion of an object in the clip; half of the objects are stationary."""
        facts = extract_facts(
            self.scene(item), item.prefix_start, item.prefix_stop, item.target_frame
        )
        visible = [o for o in facts.objects if o.sight == "shown"] if facts else []
        if not visible:
            return None
        stationary = rng.random() < 0.5
        chosen = [o for o in visible if (o.speed == "stationary") == stationary] or visible
        fact = chosen[rng.integers(len(chosen))]
        moment = f"{facts.instant[0].upper()}{facts.instant[1:]}"
        heading = f" toward the {fact.heading}" if fact.heading else ""
        motion = "does not move" if fact.speed == "stationary" else f"moves {fact.speed}{heading}"
        answer = f"{moment}, the {fact.object} is {fact.region} and {motion}."
        return Question(MOVES.format(fact.object), answer, [], after_clip=True)

    def clip(self, item: SelectionItem, rng: np.random.Generator) -> Question | None:
        """Ask for a description of the clip; half of the prompts also show the target frame."""
        if (text := self.describe_clip(item)) is None:
            return None
        target = [Picture(item.scene_id, item.target_frame)]
        return Question(CLIP, text, target if rng.random() < 0.5 else [], after_clip=True)

    def compared(self, item: SelectionItem, rng: np.random.Generator) -> Question | None:
        """Ask to compare an object's region in each candidate with a description of the clip.

        The description states the predicted region before the answer states the visible regions,
        as in a rationale; the model must not confuse them. It is in the prompt, because in the
        response it would outweigh the few words about visible regions in the loss.
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
        """Ask which frame is later: the prefix's last one, or one in which an object has moved."""
        if not (frames := find_moved_frames(self.scene(item), item.prefix_stop)):
            return None
        pair = item.prefix_stop, frames[rng.integers(len(frames))]
        order = rng.permutation(2).tolist()
        pictures = add_letters([(item.scene_id, pair[k]) for k in order])
        return Question(LATER, answer_line(LETTERS[order.index(1)]), pictures, after_clip=True)

    def match(self, item: SelectionItem, rng: np.random.Generator) -> Question | None:
        """Ask which candidate fits a description, if regions or missing objects distinguish it."""
        predicates = extract_predicates(item, self.scene(item), self.store.scene)
        predicates = predicates and keep_regional_differences(predicates)
        if not predicates:
            return None
        differing = {d.object for c in predicates.candidates for d in c.differences[:1]}
        visible = [o for o in predicates.objects if o.target_sight == "shown"]
        visible.sort(key=lambda o: o.object not in differing)
        named = ", ".join(f"the {o.object} {o.target_region}" for o in visible[:MAX_NAMED])
        answer = "\n".join([*write_match_lines(predicates, item), answer_line(item.letter)])
        pictures = add_letters([(c.scene_id, c.frame) for c in item.candidates])
        return Question(MATCH.format(named), answer, pictures)

    def scene(self, item: SelectionItem) -> Scene:
        return self.store.scene(item.scene_id)

    def describe_clip(self, item: SelectionItem) -> str | None:
        """Return the narrator's description of the clip and its outcome; None for a short clip."""
        return write_description(
            self.scene(item), item.prefix_start, item.prefix_stop, item.target_frame, self.seed
        )

    def regions(self, pictures: list[Picture]) -> list[dict[str, str]]:
        """Return the regions of the visible objects of each picture, by noun phrase."""
        return [visible_regions(self.store.scene(p.scene_id), p.frame) for p in pictures]

    def choose_object(
        self,
        item: SelectionItem,
        visible: Collection[str],
        places: list[dict[str, str]],
        rng: np.random.Generator,
    ) -> str:
        """Return a random visible object, preferably one whose region differs between pictures."""
        names = sorted(visible) or [o.noun_phrase for o in self.scene(item).objects]
        names = [p for p in names if len({objects.get(p) for objects in places}) > 1] or names
        return names[rng.integers(len(names))]

    def permuted_candidates(self, item: SelectionItem, rng: np.random.Generator) -> list[Picture]:
        frames = [(c.scene_id, c.frame) for c in item.candidates]
        return add_letters([frames[place] for place in rng.permutation(len(frames))])

    def random_four(self, item: SelectionItem, rng: np.random.Generator) -> list[Picture]:
        """Return the item's candidates or, easier to distinguish, frames of four random items."""
        if rng.random() < 0.5:
            return self.permuted_candidates(item, rng)
        items = [self.items[k] for k in rng.integers(len(self.items), size=len(LETTERS))]
        return add_letters([self.random_frame(other, rng) for other in items])

    def random_frame(self, item: SelectionItem, rng: np.random.Generator) -> tuple[str, int]:
        """Return a random frame of an item's candidates or prefix."""
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
"""The kinds of questions: their method, and how many samples an item has of them."""


def add_letters(frames: list[tuple[str, int]]) -> list[Picture]:
    return [Picture(*frame, letter) for frame, letter in zip(frames, LETTERS, strict=False)]


def format_place(letter: str, phrase: str, place: str | None) -> str:
    if place is None:
        return f"Candidate {letter} lacks the {phrase}"
    return f"Candidate {letter} shows the {phrase} {place}"


def visible_regions(scene: Scene, frame: int) -> dict[str, str]:
    """Return the region of each visible object of a frame, by the object's noun phrase."""
    return {
        o.noun_phrase: object_region(scene, frame, k)
        for k, o in enumerate(scene.objects)
        if scene.in_view[frame, k] and not scene.visible_fraction[frame, k] <= HIDDEN
    }


def describe_frame(scene: Scene, frame: int) -> str:
    """State each visible object's region in a sentence, from the top-left to the bottom-right."""
    order = [region for row in REGIONS for region in row]
    places = [(order.index(region), o) for o, region in visible_regions(scene, frame).items()]
    sentences = [f"The {phrase} is {order[place]}." for place, phrase in sorted(places)]
    return " ".join(sentences) or "No object is in view."


def visible_objects(
    scene: Scene, frame: int
) -> Iterator[tuple[int, tuple[float, float], tuple[str, ...]]]:
    """Yield index, place (shares of width and height) and words of each clearly visible object."""
    places = scene.image_positions[frame] / np.asarray(scene.image_size)
    # A fraction that the simulator does not record is NaN.
    visible = scene.in_view[frame] & ~(scene.visible_fraction[frame] <= CLEARLY_VISIBLE)
    for k in np.flatnonzero(visible):
        yield int(k), tuple(places[k].tolist()), tuple(scene.objects[k].noun_phrase.split())


def find_moved_frames(scene: Scene, start: int) -> list[int]:
    """Return frames after `start` where an object in view has moved more than MIN_DISPLACEMENT."""
    displacement = scene.image_positions[start + 1 :] - scene.image_positions[start]
    far = np.hypot(*np.moveaxis(displacement, -1, 0)) > MIN_DISPLACEMENT * scene.image_size[0]
    in_view = scene.in_view[start + 1 :] & scene.in_view[start]
    return (start + 1 + np.flatnonzero((far & in_view).any(axis=1))).tolist()


def keep_regional_differences(predicates: Predicates) -> Predicates | None:
    """Return predicates with only the differences in regions and missing objects, or None if a
    wrong candidate has no such difference."""
    candidates = []
    for c in predicates.candidates:
        differences = tuple(d for d in c.differences if d.kind in ("region", "missing"))
        if not c.agrees and not differences:
            return None
        candidates.append(replace(c, differences=differences))
    return replace(predicates, candidates=tuple(candidates))
