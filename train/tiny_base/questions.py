"""Questions about frames and clips that teach the tiny base to see before it selects.

The oracle answers them. They are about a single frame and about four candidates (the objects and
their places), about the motion of an object in a clip, about a clip and its outcome in the words of
the built-in narrator, about candidates compared with such a description, about which of two frames
is the later one, and about which candidate fits a description. None is the selection task.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from data.records import LETTERS, Scene, SelectionItem, sample_prefix_frames
from data.render.frame_cache import FrameReader
from data.store import Store
from models.student.prompts import ObjectLabel, Sample, answer_line, conversation, load_clip
from teacher.narrator import write_description, write_match_lines
from teacher.predicates import (
    REGIONS,
    ObjectFacts,
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
FRAMES = 2
"""Frames that are described, per item and epoch."""
SETS = 2
"""Sets of candidates that are described, and sets that are searched, per item and epoch."""
MOVING = 6
"""Questions about an object's motion, per item and epoch. Motion is a few pixels per frame, and no
other question about a clip requires it."""
CLIPS = 2
"""Descriptions of a clip, per item and epoch."""
COMPARED = 3
"""Comparisons of candidates with a clip's description, per item and epoch."""
MOVED = 0.08
"""Least displacement of an object in the later of two frames, as a share of the image's width."""
CLEAR = 0.3
"""Visible fraction above which a visual token should name an object."""
HIDDEN = 0.05
"""Visible fraction at or below which an object is not described."""
NAMED = 4
"""Most objects that a description names."""


def build_questions(
    store: Store, items: list[SelectionItem], frame_count: int, frames: FrameReader, seed: int
) -> dict[str, list[LazySample]]:
    """Samples by kind of question. Frames, candidates and their order are random in each epoch."""
    make = _SampleBuilder(store, frame_count, frames, seed, items)
    return {
        "frame": [make.frame(item, k) for item in items for k in range(FRAMES)],
        "candidates": [make.candidates(item, k) for item in items for k in range(SETS)],
        "where": [make.where(item, k) for item in items for k in range(SETS)],
        "moves": [sample for item in items for sample in make.moves(item)],
        "clip": [sample for item in items for sample in make.clip(item)],
        "compared": [sample for item in items for sample in make.compared(item)],
        "later": [sample for item in items for sample in make.later(item)],
        "match": [sample for item in items for sample in make.match(item)],
    }


Picture = tuple[str, int, str]
"""Scene id, frame, and the candidate's letter; empty if the frame is not a candidate."""


class _SampleBuilder:
    """Builds the samples of items; seed, epoch and item determine the random choices.

    For each kind of question, one method estimates a sample's length and another one builds it.
    """

    def __init__(
        self,
        store: Store,
        frame_count: int,
        frames: FrameReader,
        seed: int,
        items: list[SelectionItem],
    ) -> None:
        self.store, self.frames, self.seed = store, frames, seed
        self.frame_count = frame_count
        self.items = items
        self.media = frame_count // 2
        """Pairs of frames in a clip."""

    def frame(self, item: SelectionItem, k: int) -> LazySample:
        """The objects of a frame and their places."""
        text = f"{FRAME} {describe_frame(self.store.scene(item.scene_id), item.prefix_stop)}"
        return LazySample(text, 1, partial(self._frame, item, k))

    def _frame(self, item: SelectionItem, k: int, epoch: int) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "frame", k)
        scene_id, frame = self._random_frame(item, rng)
        pixels = self.frames.array(scene_id, frame)
        answer = describe_frame(self.store.scene(scene_id), frame)
        labels = self._label_objects([(scene_id, frame, "")])
        return conversation(f"{scene_id} {frame}", [pixels, f"\n{FRAME}"], answer, None, labels)

    def candidates(self, item: SelectionItem, k: int) -> LazySample:
        """The objects and places of four candidates."""
        answer = describe_frame(self.store.scene(item.scene_id), item.prefix_stop)
        lines = "\n".join(f"Candidate {letter}: {answer}" for letter in LETTERS)
        text = f"{CANDIDATES} {lines}"
        return LazySample(text, len(LETTERS), partial(self._candidates, item, k))

    def _candidates(self, item: SelectionItem, k: int, epoch: int) -> Sample:
        pictures = self._random_four(
            item, seeded_rng(self.seed, epoch, item.item_id, "candidates", k)
        )
        lines = [
            f"Candidate {letter}: {describe_frame(self.store.scene(scene_id), frame)}"
            for scene_id, frame, letter in pictures
        ]
        name = f"{item.item_id} (candidates {k})"
        return self._about_four(name, pictures, CANDIDATES, "\n".join(lines))

    def where(self, item: SelectionItem, k: int) -> LazySample:
        """The place of one object in four candidates, as a rationale compares them."""
        phrase = self.store.scene(item.scene_id).objects[0].phrase
        text = f"{WHERE.format(phrase)} {_typical_places(phrase)}"
        return LazySample(text, len(LETTERS), partial(self._where, item, k))

    def _where(self, item: SelectionItem, k: int, epoch: int) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "where", k)
        pictures = self._random_four(item, rng)
        places = self._visible_regions(pictures)
        phrase = self._choose_object(item, {p for objects in places for p in objects}, places, rng)
        answer = " ".join(
            f"{_format_place(letter, phrase, objects.get(phrase))}."
            for (*_, letter), objects in zip(pictures, places, strict=True)
        )
        name = f"{item.item_id} (where {k})"
        return self._about_four(name, pictures, WHERE.format(phrase), answer)

    def moves(self, item: SelectionItem) -> Iterator[LazySample]:
        """The motion of an object in the clip; half of the objects are stationary."""
        facts = extract_facts(
            self.store.scene(item.scene_id), item.prefix_start, item.prefix_stop, item.target_frame
        )
        visible = [o for o in facts.objects if o.sight == "shown"] if facts else []
        if visible:
            longest = max((_describe_motion(facts.instant, o) for o in visible), key=len)
            text = f"{MOVES.format(visible[0].object)} {longest}"
            for k in range(MOVING):
                make = partial(self._moves, item, facts.instant, visible, k)
                yield LazySample(text, self.media, make)

    def _moves(
        self, item: SelectionItem, instant: str, visible: list[ObjectFacts], k: int, epoch: int
    ) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "moves", k)
        stationary = rng.random() < 0.5
        chosen = [o for o in visible if (o.speed == "stationary") == stationary] or visible
        o = chosen[rng.integers(len(chosen))]
        return self._after_clip(item, [MOVES.format(o.object)], _describe_motion(instant, o), [])

    def clip(self, item: SelectionItem) -> Iterator[LazySample]:
        """The clip and its outcome; in half of the samples the target frame is visible."""
        if (text := self._describe_clip(item)) is not None:
            for k in range(CLIPS):
                make = partial(self._clip, item, text, k)
                yield LazySample(f"{CLIP} {text}", self.media + 1, make)

    def _clip(self, item: SelectionItem, text: str, k: int, epoch: int) -> Sample:
        with_target = seeded_rng(self.seed, epoch, item.item_id, "clip", k).random() < 0.5
        pixels = self.frames.array(item.scene_id, item.target_frame)
        target = ["Later: ", pixels, "\n"] if with_target else []
        pictures = [(item.scene_id, item.target_frame, "")] if with_target else []
        return self._after_clip(item, [*target, CLIP], text, pictures)

    def compared(self, item: SelectionItem) -> Iterator[LazySample]:
        """An object's place in the item's candidates, compared with a description of the clip.

        As in a rationale, the text has the predicted place before the visible places, and the model
        must not confuse them. The description is part of the prompt: as part of the response it
        would outweigh the few words about visible places in the loss.
        """
        if (text := self._describe_clip(item)) is not None:
            phrase = self.store.scene(item.scene_id).objects[0].phrase
            differences = f", not {REGIONS[0][0]}" * len(LETTERS)
            longest = f"{text} {COMPARE.format(phrase)} {_typical_places(phrase)}{differences}"
            for k in range(COMPARED):
                make = partial(self._compared, item, text, k)
                yield LazySample(longest, self.media + len(LETTERS), make)

    def _compared(self, item: SelectionItem, text: str, k: int, epoch: int) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "compared", k)
        pictures = self._permuted_candidates(item, rng)
        places = self._visible_regions(pictures)
        expected = visible_regions(self.store.scene(item.scene_id), item.target_frame)
        phrase = self._choose_object(item, expected, places, rng)
        answer = " ".join(
            _format_comparison(letter, phrase, objects.get(phrase), expected.get(phrase))
            for (*_, letter), objects in zip(pictures, places, strict=True)
        )
        parts = [*self._label(pictures), f"\n{text}\n{COMPARE.format(phrase)}"]
        return self._after_clip(item, parts, answer, pictures)

    def later(self, item: SelectionItem) -> Iterator[LazySample]:
        """Which of two distinguishable frames is later; only if something moves after the clip."""
        frames = find_moved_frames(self.store.scene(item.scene_id), item.prefix_stop)
        if frames:
            text = f"{LATER} {answer_line(LETTERS[0])}"
            yield LazySample(text, self.media + 2, partial(self._later, item, frames))

    def _later(self, item: SelectionItem, frames: list[int], epoch: int) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "later")
        pair = item.prefix_stop, frames[rng.integers(len(frames))]
        order = rng.permutation(2)
        letter = LETTERS[order.tolist().index(1)]
        pictures = _add_letters([(item.scene_id, pair[k]) for k in order])
        parts = [*self._label(pictures), f"\n{LATER}"]
        return self._after_clip(item, parts, answer_line(letter), pictures)

    def match(self, item: SelectionItem) -> Iterator[LazySample]:
        """The one candidate that fits a description, if regions distinguish it."""
        predicates = extract_predicates(item, self.store.scene(item.scene_id), self.store.scene)
        predicates = predicates and _keep_regional_differences(predicates)
        if not predicates:
            return
        differing = {d.object for c in predicates.candidates for d in c.differences[:1]}
        visible = [o for o in predicates.objects if o.target_sight == "shown"]
        visible.sort(key=lambda o: o.object not in differing)
        named = ", ".join(f"the {o.object} {o.target_region}" for o in visible[:NAMED])
        question = MATCH.format(named)
        answer = "\n".join([*write_match_lines(predicates, item), answer_line(item.letter)])
        make = partial(self._match, item, question, answer)
        yield LazySample(f"{question} {answer}", len(LETTERS), make)

    def _match(self, item: SelectionItem, question: str, answer: str, epoch: int) -> Sample:
        pictures = _add_letters([(c.scene_id, c.frame) for c in item.candidates])
        return self._about_four(f"{item.item_id} (match)", pictures, question, answer)

    def _describe_clip(self, item: SelectionItem) -> str | None:
        """The clip and its outcome by the built-in narrator; None if the clip is too short."""
        scene = self.store.scene(item.scene_id)
        return write_description(
            scene, item.prefix_start, item.prefix_stop, item.target_frame, self.seed
        )

    def _visible_regions(self, pictures: list[Picture]) -> list[dict[str, str]]:
        return [visible_regions(self.store.scene(name), frame) for name, frame, _ in pictures]

    def _choose_object(
        self,
        item: SelectionItem,
        visible: Collection[str],
        places: list[dict[str, str]],
        rng: np.random.Generator,
    ) -> str:
        """A random visible object, if possible one whose place distinguishes candidates."""
        names = sorted(visible) or [o.phrase for o in self.store.scene(item.scene_id).objects]
        names = [p for p in names if len({objects.get(p) for objects in places}) > 1] or names
        return names[rng.integers(len(names))]

    def _permuted_candidates(self, item: SelectionItem, rng: np.random.Generator) -> list[Picture]:
        frames = [(c.scene_id, c.frame) for c in item.candidates]
        return _add_letters([frames[place] for place in rng.permutation(len(frames))])

    def _random_four(self, item: SelectionItem, rng: np.random.Generator) -> list[Picture]:
        """An item's own candidates or, easier to distinguish, frames of four random items."""
        if rng.random() < 0.5:
            return self._permuted_candidates(item, rng)
        items = [self.items[k] for k in rng.integers(len(self.items), size=len(LETTERS))]
        return _add_letters([self._random_frame(other, rng) for other in items])

    def _random_frame(self, item: SelectionItem, rng: np.random.Generator) -> tuple[str, int]:
        """A frame of an item's candidates or prefix."""
        frames = [(c.scene_id, c.frame) for c in item.candidates]
        frames += [(item.scene_id, f) for f in self._prefix_frames(item)]
        return frames[rng.integers(len(frames))]

    def _prefix_frames(self, item: SelectionItem) -> list[int]:
        return sample_prefix_frames(item.prefix_start, item.prefix_stop, self.frame_count)

    def _label(self, pictures: list[Picture]) -> Iterator[str | np.ndarray]:
        for scene_id, frame, letter in pictures:
            yield f"\nCandidate {letter}: "
            yield self.frames.array(scene_id, frame)

    def _about_four(self, name: str, pictures: list[Picture], question: str, answer: str) -> Sample:
        parts = [*self._label(pictures), f"\n{question}"]
        return conversation(name, parts, answer, None, self._label_objects(pictures))

    def _after_clip(
        self,
        item: SelectionItem,
        parts: list[str | np.ndarray],
        answer: str,
        pictures: list[Picture],
    ) -> Sample:
        frames = self._prefix_frames(item)
        clip = load_clip(item.scene_id, frames, self.frames)
        scene = self.store.scene(item.scene_id)
        # A visual token of a clip covers two frames; objects are labelled as in the first.
        pairs = [(f, frames[min(k + 1, len(frames) - 1)]) for k, f in enumerate(frames)][::2]
        labels = [
            ObjectLabel(k, place, (*words, object_heading(scene, index, *pair) or "stationary"))
            for k, pair in enumerate(pairs)
            for index, place, words in visible_objects(scene, pair[0])
        ]
        labels += self._label_objects(pictures, len(pairs))
        return conversation(f"{item.item_id} (clip and frames)", parts, answer, clip, labels)

    def _label_objects(self, pictures: list[Picture], before: int = 0) -> list[ObjectLabel]:
        """The visible objects of pictures, which come after `before` others in the sample."""
        return [
            ObjectLabel(before + k, place, (*words, *letter))
            for k, (scene_id, frame, letter) in enumerate(pictures)
            for _, place, words in visible_objects(self.store.scene(scene_id), frame)
        ]


def _add_letters(frames: list[tuple[str, int]]) -> list[Picture]:
    return [(*frame, letter) for frame, letter in zip(frames, LETTERS, strict=False)]


def _describe_motion(instant: str, o: ObjectFacts) -> str:
    """An object's place and motion at an instant, in the words of a rationale."""
    text = f"{instant[0].upper()}{instant[1:]}, the {o.object} is {o.region} and"
    if o.speed == "stationary":
        return f"{text} does not move."
    return f"{text} moves {o.speed}{f' toward the {o.heading}' if o.heading else ''}."


def _typical_places(phrase: str) -> str:
    """A text as long as the answer to WHERE, to estimate its length."""
    return " ".join(f"{_format_place(letter, phrase, REGIONS[0][0])}." for letter in LETTERS)


def _format_place(letter: str, phrase: str, place: str | None) -> str:
    if place is None:
        return f"Candidate {letter} lacks the {phrase}"
    return f"Candidate {letter} shows the {phrase} {place}"


def _format_comparison(letter: str, phrase: str, place: str | None, expected: str | None) -> str:
    """An object's place in a candidate, and whether it is the expected one; None if not visible."""
    if place == expected:
        return f"{_format_place(letter, phrase, place)} and agrees."
    difference = f", not {expected}" if place and expected else ""
    return f"{_format_place(letter, phrase, place)}{difference}."


def visible_regions(scene: Scene, frame: int) -> dict[str, str]:
    """The region of each visible object of a frame, by the object's phrase."""
    return {
        o.phrase: object_region(scene, frame, k)
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
        yield int(k), tuple(places[k].tolist()), tuple(scene.objects[k].phrase.split())


def find_moved_frames(scene: Scene, start: int) -> list[int]:
    """The frames after `start` in which an object in view has moved by more than MOVED."""
    displacement = scene.image_positions[start + 1 :] - scene.image_positions[start]
    far = np.hypot(*np.moveaxis(displacement, -1, 0)) > MOVED * scene.image_size[0]
    in_view = scene.in_view[start + 1 :] & scene.in_view[start]
    return (start + 1 + np.flatnonzero((far & in_view).any(axis=1))).tolist()


def _keep_regional_differences(predicates: Predicates) -> Predicates | None:
    """Predicates with only the differences in regions and missing objects; None if a wrong
    candidate has no such difference."""
    candidates = []
    for c in predicates.candidates:
        differences = tuple(d for d in c.differences if d.kind in ("region", "missing"))
        if not c.agrees and not differences:
            return None
        candidates.append(replace(c, differences=differences))
    return replace(predicates, candidates=tuple(candidates))
