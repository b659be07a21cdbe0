"""What the tiny base learns from: questions whose answers the oracle holds, so that it can see and
write before it is ever asked to choose.

A frame is described by its objects and their places, alone and among four candidates, one after the
other; an object is looked for in each of four candidates; an object of a clip is told by how it
moves; a clip is told by the built-in narrator, with the frame that comes of it shown or not; after
a clip and what is told of it, its item's candidates are compared with that by where they show an
object; of several frames the one is named that is the later, or that fits a description. None of it
is the selection task itself.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator
from dataclasses import replace
from functools import partial

import numpy as np

from conf.schema import StudentConfig
from data.records import LETTERS, Scene, SelectionItem, sample_prefix_frames
from data.render.frame_cache import FrameReader
from data.store import Store
from models.student.prompts import Sample, Sight, answer_line, conversation, load_clip
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
ASKED = (FRAME, CANDIDATES, WHERE, COMPARE, MOVES, CLIP, LATER, MATCH)
FRAMES = 2
"""Frames described for each item in an epoch."""
SETS = 2
"""Sets of candidates for each item in an epoch, of those described and of those looked through."""
MOVING = 6
"""Objects of a clip whose motion is told, for each item in an epoch: a few pixels between frames,
which nothing else of a clip makes a model look for."""
CLIPS = 2
"""Times that a clip is told in an epoch."""
COMPARED = 3
"""Objects to compare by after a clip, for each item in an epoch."""
MOVED = 0.08
"""Share of the view's width by which an object has moved in the later of two frames, at least."""
CLEAR = 0.3
"""Share of an object's pixels over which a visual token is to name it."""
HIDDEN = 0.05
"""Share of an object's pixels under which it is not said to be seen."""
NAMED = 4
"""Objects at most that a description to be matched names."""


def build_questions(
    store: Store, items: list[SelectionItem], cfg: StudentConfig, frames: FrameReader, seed: int
) -> dict[str, list[LazySample]]:
    """Samples of each kind from some items. Which frame is described or is the later, among which
    others, and in which order, is another in each epoch."""
    make = _Maker(store, cfg, frames, seed)
    return {
        "frame": [make.frame(item, k) for item in items for k in range(FRAMES)],
        "candidates": [make.candidates(item, items, k) for item in items for k in range(SETS)],
        "where": [make.where(item, items, k) for item in items for k in range(SETS)],
        "moves": [one for item in items for one in make.moves(item)],
        "clip": [clip for item in items for clip in make.clip(item)],
        "compared": [
            one for item in items for k in range(COMPARED) for one in make.compared(item, k)
        ],
        "later": [later for item in items for later in make.later(item)],
        "match": [match for item in items for match in make.matched(item)],
    }


Picture = tuple[str, int, str]
"""A scene's frame, and the letter under which it is a candidate, empty where it is none."""


def lettered(frames: list[tuple[str, int]]) -> list[Picture]:
    """Frames as candidates in their order."""
    return [(*frame, letter) for frame, letter in zip(frames, LETTERS, strict=False)]


class _Maker:
    """Makes samples of items; what is left to chance follows from seed, epoch and item."""

    def __init__(self, store: Store, cfg: StudentConfig, frames: FrameReader, seed: int) -> None:
        self.store, self.cfg, self.frames, self.seed = store, cfg, frames, seed

    def frame(self, item: SelectionItem, k: int) -> LazySample:
        return LazySample(
            f"{FRAME} {account(self.store.scene(item.scene_id), item.prefix_stop)}",
            1,
            partial(self._frame, item, k),
        )

    def _frame(self, item: SelectionItem, k: int, epoch: int) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "frame", k)
        scene_id, frame = self._any(item, rng)
        pixels = self.frames.array(scene_id, frame)
        told = account(self.store.scene(scene_id), frame)
        sights = self._sights([(scene_id, frame, "")])
        return conversation(f"{scene_id} {frame}", [pixels, f"\n{FRAME}"], told, None, sights)

    def candidates(self, item: SelectionItem, others: list[SelectionItem], k: int) -> LazySample:
        """Four frames: an item's candidates or, the easier to tell apart, of four items."""
        told = account(self.store.scene(item.scene_id), item.prefix_stop)
        text = f"{CANDIDATES} " + "\n".join(f"Candidate {letter}: {told}" for letter in LETTERS)
        return LazySample(text, len(LETTERS), partial(self._candidates, item, others, k))

    def _candidates(
        self, item: SelectionItem, others: list[SelectionItem], k: int, epoch: int
    ) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "candidates", k)
        shown = self._four(item, others, rng)
        told = [
            f"Candidate {letter}: {account(self.store.scene(scene_id), frame)}"
            for scene_id, frame, letter in shown
        ]
        name = f"{item.item_id} (candidates {k})"
        return self._of_four(name, shown, CANDIDATES, told)

    def where(self, item: SelectionItem, others: list[SelectionItem], k: int) -> LazySample:
        """An object that one of four frames shows, looked for in all: so does a rationale compare
        candidates."""
        phrase = self.store.scene(item.scene_id).objects[0].phrase
        text = f"{WHERE.format(phrase)} {self._everywhere(phrase)}"
        return LazySample(text, len(LETTERS), partial(self._where, item, others, k))

    def _where(
        self, item: SelectionItem, others: list[SelectionItem], k: int, epoch: int
    ) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "where", k)
        shown = self._four(item, others, rng)
        seen = self._seen(shown)
        phrase = self._telling(item, {p for objects in seen for p in objects}, seen, rng)
        told = " ".join(
            f"{_shows(letter, phrase, objects.get(phrase))}."
            for (*_, letter), objects in zip(shown, seen, strict=True)
        )
        return self._of_four(f"{item.item_id} (where {k})", shown, WHERE.format(phrase), [told])

    def _seen(self, shown: list[Picture]) -> list[dict[str, str]]:
        return [seen_in(self.store.scene(scene_id), frame) for scene_id, frame, _ in shown]

    def _telling(
        self,
        item: SelectionItem,
        there: Collection[str],
        seen: list[dict[str, str]],
        rng: np.random.Generator,
    ) -> str:
        """One of the objects that are there, by whose place candidates are told apart where there
        is such."""
        some = sorted(there) or [o.phrase for o in self.store.scene(item.scene_id).objects]
        apart = [p for p in some if len({objects.get(p) for objects in seen}) > 1] or some
        return apart[rng.integers(len(apart))]

    @staticmethod
    def _everywhere(phrase: str) -> str:
        """As long as what is told of an object that is looked for."""
        lines = [f"Candidate {letter} shows the {phrase} {REGIONS[0][0]}." for letter in LETTERS]
        return " ".join(lines)

    def _four(
        self, item: SelectionItem, others: list[SelectionItem], rng: np.random.Generator
    ) -> list[Picture]:
        """An item's own candidates or, the easier to tell apart, a frame each of four items."""
        if rng.random() < 0.5:
            own = [(c.scene_id, c.frame) for c in item.candidates]
            return lettered([own[place] for place in rng.permutation(len(own))])
        drawn = [others[place] for place in rng.integers(len(others), size=len(LETTERS))]
        return lettered([self._any(one, rng) for one in drawn])

    def _of_four(self, name: str, shown: list[Picture], asked: str, told: list[str]) -> Sample:
        parts = [*self._labelled(shown), f"\n{asked}"]
        return conversation(name, parts, "\n".join(told), None, self._sights(shown))

    def _labelled(self, shown: list[Picture]) -> Iterator[str | np.ndarray]:
        for scene_id, frame, letter in shown:
            yield f"\nCandidate {letter}: "
            yield self.frames.array(scene_id, frame)

    def _any(self, item: SelectionItem, rng: np.random.Generator) -> tuple[str, int]:
        """Any of the frames that an item shows."""
        shown = [(c.scene_id, c.frame) for c in item.candidates]
        shown += [(item.scene_id, f) for f in self._prefix(item)]
        return shown[rng.integers(len(shown))]

    def moves(self, item: SelectionItem) -> Iterator[LazySample]:
        """How an object of the clip moves, as often one that rests as another."""
        scene = self.store.scene(item.scene_id)
        facts = extract_facts(scene, item.prefix_start, item.prefix_stop, item.target_frame)
        seen = [o for o in facts.objects if o.sight == "shown"] if facts else []
        if seen:
            longest = max((_motion(facts.instant, o) for o in seen), key=len)
            text = f"{MOVES.format(seen[0].object)} {longest}"
            for k in range(MOVING):
                make = partial(self._moves, item, facts.instant, seen, k)
                yield LazySample(text, self.cfg.frames // 2, make)

    def _moves(
        self, item: SelectionItem, instant: str, seen: list[ObjectFacts], k: int, epoch: int
    ) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "moves", k)
        rests = rng.random() < 0.5
        some = [o for o in seen if (o.speed == "stationary") == rests] or seen
        told = some[rng.integers(len(some))]
        return self._after_prefix(item, [MOVES.format(told.object)], _motion(instant, told), [])

    def clip(self, item: SelectionItem) -> Iterator[LazySample]:
        """The clip with the frame that comes of it, to be read off, or without, to be foreseen."""
        if (text := self._told(item)) is not None:
            media = self.cfg.frames // 2 + 1
            for k in range(CLIPS):
                yield LazySample(f"{CLIP} {text}", media, partial(self._clip, item, text, k))

    def _told(self, item: SelectionItem) -> str | None:
        """The clip and what comes of it in the narrator's words, None where it is too short."""
        scene = self.store.scene(item.scene_id)
        return write_description(
            scene, item.prefix_start, item.prefix_stop, item.target_frame, self.seed
        )

    def _clip(self, item: SelectionItem, text: str, k: int, epoch: int) -> Sample:
        shown = seeded_rng(self.seed, epoch, item.item_id, "clip", k).random() < 0.5
        pixels = self.frames.array(item.scene_id, item.target_frame)
        later = ["Later: ", pixels, "\n"] if shown else []
        images = [(item.scene_id, item.target_frame, "")] if shown else []
        return self._after_prefix(item, [*later, CLIP], text, images)

    def compared(self, item: SelectionItem, k: int) -> Iterator[LazySample]:
        """A clip, what is told of it, and by an object's place whether its item's candidates agree
        with that. As in a rationale, what is foreseen stands before what is to be seen, and must
        not be taken for it; it is not learnt here, or the few words that are seen would weigh next
        to nothing."""
        if (text := self._told(item)) is not None:
            phrase = self.store.scene(item.scene_id).objects[0].phrase
            differs = f", not {REGIONS[0][0]}" * len(LETTERS)
            long = f"{text} {COMPARE.format(phrase)} {self._everywhere(phrase)}{differs}"
            media = self.cfg.frames // 2 + len(LETTERS)
            yield LazySample(long, media, partial(self._compared, item, text, k))

    def _compared(self, item: SelectionItem, text: str, k: int, epoch: int) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "compared", k)
        own = [(c.scene_id, c.frame) for c in item.candidates]
        shown = lettered([own[place] for place in rng.permutation(len(own))])
        seen = self._seen(shown)
        expected = seen_in(self.store.scene(item.scene_id), item.target_frame)
        phrase = self._telling(item, expected, seen, rng)
        told = " ".join(
            _compared(letter, phrase, objects.get(phrase), expected.get(phrase))
            for (*_, letter), objects in zip(shown, seen, strict=True)
        )
        parts = [*self._labelled(shown), f"\n{text}\n{COMPARE.format(phrase)}"]
        return self._after_prefix(item, parts, told, shown)

    def later(self, item: SelectionItem) -> Iterator[LazySample]:
        """Two frames that can be told apart, where something still moves after the prefix."""
        after = moved(self.store.scene(item.scene_id), item.prefix_stop)
        if after:
            text = f"{LATER} {answer_line(LETTERS[0])}"
            yield LazySample(text, self.cfg.frames // 2 + 2, partial(self._later, item, after))

    def _later(self, item: SelectionItem, after: list[int], epoch: int) -> Sample:
        rng = seeded_rng(self.seed, epoch, item.item_id, "later")
        first, second = item.prefix_stop, after[rng.integers(len(after))]
        order = rng.permutation(2)
        right = LETTERS[order.tolist().index(1)]
        shown = lettered([(item.scene_id, (first, second)[k]) for k in order])
        parts = [*self._labelled(shown), f"\n{LATER}"]
        return self._after_prefix(item, parts, answer_line(right), shown)

    def matched(self, item: SelectionItem) -> Iterator[LazySample]:
        """A description that one candidate alone fits, where there is such."""
        predicates = extract_predicates(item, self.store.scene(item.scene_id), self.store.scene)
        plain = predicates and _plain(predicates)
        if not plain:
            return
        differing = {d.object for c in plain.candidates for d in c.differences[:1]}
        told = [o for o in plain.objects if o.target_sight == "shown"]
        told.sort(key=lambda o: o.object not in differing)
        what = ", ".join(f"the {o.object} {o.target_region}" for o in told[:NAMED])
        asked = MATCH.format(what)
        answer = "\n".join([*write_match_lines(plain, item), answer_line(item.letter)])
        make = partial(self._match, item, asked, answer)
        yield LazySample(f"{asked} {answer}", len(LETTERS), make)

    def _match(self, item: SelectionItem, asked: str, answer: str, epoch: int) -> Sample:
        shown = lettered([(c.scene_id, c.frame) for c in item.candidates])
        return self._of_four(f"{item.item_id} (match)", shown, asked, [answer])

    def _after_prefix(
        self, item: SelectionItem, parts: list[str | np.ndarray], told: str, images: list[Picture]
    ) -> Sample:
        shown = self._prefix(item)
        clip = load_clip(item.scene_id, shown, self.frames)
        scene = self.store.scene(item.scene_id)
        # A visual token of a clip shows two frames; its object is where the first has it.
        pairs = [(f, shown[min(k + 1, len(shown) - 1)]) for k, f in enumerate(shown)][::2]
        watched = [
            Sight(k, place, (*words, object_heading(scene, index, *pair) or "stationary"))
            for k, pair in enumerate(pairs)
            for index, place, words in sights(scene, pair[0])
        ]
        watched += self._sights(images, len(pairs))
        return conversation(f"{item.item_id} (clip and frames)", parts, told, clip, watched)

    def _sights(self, pictures: list[Picture], before: int = 0) -> list[Sight]:
        """What a sample's pictures show, and of a candidate under which letter; so many pictures
        stand `before` them."""
        return [
            Sight(before + k, place, (*words, *letter))
            for k, (scene_id, frame, letter) in enumerate(pictures)
            for _, place, words in sights(self.store.scene(scene_id), frame)
        ]

    def _prefix(self, item: SelectionItem) -> list[int]:
        return sample_prefix_frames(item.prefix_start, item.prefix_stop, self.cfg.frames)


def _motion(instant: str, o: ObjectFacts) -> str:
    """Where an object is at an instant and how it moves, in the words of a rationale."""
    told = f"{instant}, the {o.object} is {o.region} and"
    if o.speed == "stationary":
        return f"{told[0].upper()}{told[1:]} does not move."
    way = f" toward the {o.heading}" if o.heading else ""
    return f"{told[0].upper()}{told[1:]} moves {o.speed}{way}."


def _shows(letter: str, phrase: str, place: str | None) -> str:
    if place is None:
        return f"Candidate {letter} lacks the {phrase}"
    return f"Candidate {letter} shows the {phrase} {place}"


def _compared(letter: str, phrase: str, place: str | None, expected: str | None) -> str:
    """Where a candidate shows an object, None where it does not, and whether that is where it was
    to be."""
    if place == expected:
        return f"{_shows(letter, phrase, place)} and agrees."
    differs = f", not {expected}" if place and expected else ""
    return f"{_shows(letter, phrase, place)}{differs}."


def seen_in(scene: Scene, frame: int) -> dict[str, str]:
    """The places of the objects that a frame shows, by their phrases."""
    return {
        o.phrase: object_region(scene, frame, k)
        for k, o in enumerate(scene.objects)
        if scene.in_view[frame, k] and scene.visible_fraction[frame, k] > HIDDEN
    }


def account(scene: Scene, frame: int) -> str:
    """The objects that a frame shows and where, from the top-left to the bottom-right."""
    places = [region for row in REGIONS for region in row]
    seen = [(places.index(place), phrase) for phrase, place in seen_in(scene, frame).items()]
    told = [f"The {phrase} is {places[place]}." for place, phrase in sorted(seen)]
    return " ".join(told) or "No object is in view."


def sights(scene: Scene, frame: int) -> Iterator[tuple[int, tuple[float, float], tuple[str, ...]]]:
    """The objects that can be made out in a frame: the index of each, where it is, as shares of
    width and height, and the words that name it."""
    places = scene.image_positions[frame] / np.asarray(scene.image_size)
    seen = scene.in_view[frame] & (scene.visible_fraction[frame] > CLEAR)
    for k in np.flatnonzero(seen):
        yield int(k), tuple(places[k].tolist()), tuple(scene.objects[k].phrase.split())


def moved(scene: Scene, start: int) -> list[int]:
    """The frames after `start` in which an object in view has moved by a good piece."""
    way = scene.image_positions[start + 1 :] - scene.image_positions[start]
    far = np.hypot(*np.moveaxis(way, -1, 0)) > MOVED * scene.image_size[0]
    seen = scene.in_view[start + 1 :] & scene.in_view[start]
    return (start + 1 + np.flatnonzero((far & seen).any(axis=1))).tolist()


def _plain(predicates: Predicates) -> Predicates | None:
    """Predicates with the differences that a description by regions tells; None where a candidate
    has none of these."""
    candidates = []
    for c in predicates.candidates:
        told = tuple(d for d in c.differences if d.kind in ("region", "missing"))
        if not c.agrees and not told:
            return None
        candidates.append(replace(c, differences=told))
    return replace(predicates, candidates=tuple(candidates))
