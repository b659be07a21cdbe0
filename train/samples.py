"""What a regime trains on and is measured on: lists of samples that are made when asked for."""

from __future__ import annotations

import hashlib
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np
from torch.utils.data import Dataset
from transformers import PreTrainedTokenizerBase

from conf.schema import SftCommand, SftTrainConfig, StudentConfig
from data.frames import Frames
from data.records import LETTERS, Rationale, Scene, SelectionItem
from data.store import Store
from teacher.letters import relabel, reorder
from teacher.predicates import OUT, predicates_of, region_of
from teacher.template import describe, matches
from train.conversation import (
    DESCRIBE,
    MODES,
    Sample,
    answer_line,
    description_sample,
    has_matches,
    instruction,
    response,
    selection_sample,
)

HELD_OUT = 0.1
"""Share of the training scenes whose items measure a run."""
LOOKS = 2
"""Questions about what a candidate shows that the tiny base learns from, for each item."""

Row = TypeVar("Row")


@dataclass(frozen=True)
class Planned:
    """A sample to be made when it is asked for, so that pixels are not held for all of them, and
    the text that it does not share with others of its kind. It may differ by epoch."""

    text: str
    make: Callable[[int], Sample]


class Samples(Dataset):
    """Planned samples as a trainer reads them, as they are in `epoch`."""

    def __init__(self, planned: Sequence[Planned]) -> None:
        self._planned = planned
        self.epoch = 0

    def __len__(self) -> int:
        return len(self._planned)

    def __getitem__(self, index: int) -> Sample:
        return self._planned[index].make(self.epoch)

    def longest(self, tokenizer: PreTrainedTokenizerBase) -> Sample:
        """The sample with the most tokens. Frames are alike in all of them, so the text tells."""
        encoded = tokenizer([p.text for p in self._planned], add_special_tokens=False).input_ids
        return self[max(range(len(self)), key=lambda k: len(encoded[k]))]


def _same(make: Callable[[], Sample], epoch: int) -> Sample:
    """A sample that no epoch changes."""
    return make()


@dataclass(frozen=True)
class Supervised:
    """An item in one mode, with what a student of `regime` is to answer. Where there is a `seed`,
    its candidates stand in an order of their own in each epoch."""

    item: SelectionItem
    rationale: str
    matches: tuple[str, ...]
    mode: str
    regime: str
    seed: int | None = None

    def text(self) -> str:
        told = response(self.rationale, self.matches, self.item.letter, self.mode, self.regime)
        return f"{self.item.question} {instruction(self.mode, self.regime)} {told}"

    def in_epoch(self, epoch: int) -> Supervised:
        """The same with its candidates in the epoch's order, and all letters with them."""
        if self.seed is None:
            return self
        digest = hashlib.sha256(repr((self.seed, epoch, self.item.item_id)).encode()).digest()
        rng = np.random.default_rng(int.from_bytes(digest[:8], "big"))
        order = rng.permutation(len(LETTERS)).tolist()
        return replace(
            self,
            item=reorder(self.item, order),
            rationale=relabel(self.rationale, order),
            # The letters again stand in their own order.
            matches=tuple(sorted(relabel(line, order) for line in self.matches)),
        )

    def sample(self, frames: Frames, cfg: StudentConfig, epoch: int) -> Sample:
        shown = self.in_epoch(epoch)
        told = response(shown.rationale, shown.matches, shown.item.letter, self.mode, self.regime)
        return selection_sample(shown.item, self.mode, self.regime, frames, cfg, told)

    def planned(self, frames: Frames, cfg: StudentConfig) -> Planned:
        return Planned(self.text(), partial(self.sample, frames, cfg))


def held_out_scenes(store: Store) -> set[str]:
    """A share of the training scenes, kept from training to measure it. Test scenes are never
    touched here.

    It goes by the scenes alone, not by a run's seed: a base must not have been trained on what
    measures a student that is trained over it.
    """
    names = sorted(
        store.scene_ids("train"), key=lambda name: hashlib.sha256(name.encode()).digest()
    )
    return set(names[: max(1, round(HELD_OUT * len(names)))])


def shuffled(rows: list[Row], seed: int) -> list[Row]:
    """The rows in a seeded order."""
    return [rows[k] for k in np.random.default_rng([seed, 2]).permutation(len(rows))]


def supervised_items(
    store: Store,
    items: list[SelectionItem],
    rationales: dict[str, Rationale],
    train: SftTrainConfig,
    seed: int | None,
) -> dict[str, list[Supervised]]:
    """Each item in reasoning mode, where it has a rationale, and in answer mode. A `seed` permutes
    candidates from epoch to epoch."""
    made: dict[str, list[Supervised]] = {mode: [] for mode in MODES}
    for item in items:
        if rationale := rationales.get(item.item_id):
            told = rationale.text, _matches(store, item, train.regime)
            made["reasoning"].append(Supervised(item, *told, "reasoning", train.regime, seed))
        made["answer"].append(Supervised(item, "", (), "answer", train.regime, seed))
    return made


def _matches(store: Store, item: SelectionItem, regime: str) -> tuple[str, ...]:
    if not has_matches(regime):
        return ()
    predicates = predicates_of(item, store.scene(item.scene_id), store.scene)
    # An item with too short a prefix has no rationale either.
    assert predicates is not None
    return matches(predicates, item)


def descriptions(
    store: Store, scenes: set[str], cfg: StudentConfig, frames: Frames, seed: int
) -> list[Planned]:
    """The built-in narrator's descriptions of training scenes: what the tiny base learns to write.
    Windows are those that items and queries show."""
    windows = {
        (a.scene_id, a.prefix_start, a.prefix_stop, frame)
        for a, frame in (
            *((i, i.target_frame) for i in store.selection("train")),
            *((q, q.target.frame) for q in store.retrieval("train")),
        )
        if a.scene_id in scenes
    }
    made: list[Planned] = []
    for scene_id, start, stop, target in sorted(windows):
        text = describe(store.scene(scene_id), start, stop, target, seed)
        if text is not None:
            sample = partial(description_sample, scene_id, start, stop, target, frames, cfg, text)
            made.append(Planned(text, partial(_same, sample)))
    return made


def looks(
    store: Store, scenes: set[str], cfg: StudentConfig, frames: Frames, seed: int
) -> list[Planned]:
    """Questions about what stands where in a candidate, which need no foresight: they give the
    tiny base the words and letters of the candidate analysis."""
    made: list[Planned] = []
    for item in store.selection("train"):
        if item.scene_id not in scenes:
            continue
        shown = [_regions(store.scene(c.scene_id), c.frame) for c in item.candidates]
        telling = [
            (letter, f"the {look} {region}")
            for letter, regions in zip(LETTERS, shown, strict=True)
            for look, region in regions.items()
            if region != OUT and sum(other.get(look) == region for other in shown) == 1
        ]
        for letter, what in shuffled(telling, seed)[:LOOKS]:
            asked = replace(item, question=f"Which candidate shows {what}?")
            text = f"Candidate {letter} shows {what}.\n{answer_line(letter)}"
            sample = partial(selection_sample, asked, "answer", "describe", frames, cfg, text)
            made.append(Planned(text, partial(_same, sample)))
    return made


def _regions(scene: Scene, frame: int) -> dict[str, str]:
    return {o.phrase: region_of(scene, frame, k) for k, o in enumerate(scene.objects)}


def splits(
    store: Store, rationales: list[Rationale], cfg: SftCommand, frames: Frames
) -> tuple[Samples, dict[str, Samples]]:
    """Training samples of a regime, and what measures it on held-out training scenes, by mode."""
    held_out = held_out_scenes(store)
    others = set(store.scene_ids("train")) - held_out
    limit = cfg.train.validation_items
    if cfg.train.regime == "describe":
        made = {
            kind: [make(store, some, cfg.student, frames, cfg.seed) for some in (others, held_out)]
            for kind, make in (("describe", descriptions), ("look", looks))
        }
        training = [sample for told, _ in made.values() for sample in told]
        return Samples(training), {
            kind: Samples(shuffled(kept, cfg.seed)[:limit]) for kind, (_, kept) in made.items()
        }
    by_item = {r.item_id: r for r in rationales}
    items = store.selection("train")
    # The items of every family stand together: a shuffled slice measures all of them.
    kept = shuffled([i for i in items if i.scene_id in held_out], cfg.seed)[:limit]
    seed = cfg.seed if cfg.train.permute_candidates else None
    training = supervised_items(
        store, [i for i in items if i.scene_id in others], by_item, cfg.train, seed
    )
    validation = supervised_items(store, kept, by_item, cfg.train, None)

    def planned(supervised: list[Supervised]) -> list[Planned]:
        return [s.planned(frames, cfg.student) for s in supervised]

    # A CoT student learns both modes, so that it can be asked in either.
    return (
        Samples([sample for mode in MODES for sample in planned(training[mode])]),
        {mode: Samples(planned(made)) for mode, made in validation.items() if made},
    )


def corpus(store: Store, rationales: list[Rationale]) -> list[str]:
    """Texts for a tokenizer built from nothing: all that a student reads and writes."""
    questions = sorted({item.question for item in store.selection("train")})
    letters = [f"\nCandidate {x}: \n{answer_line(x)}" for x in LETTERS]
    # Every digit and the timestamps' frame, often enough to be worth merges.
    clock = [f"<{tenths / 10:.1f} seconds>" for tenths in range(52)]
    asked = [instruction(mode, "cot") for mode in MODES]
    prompts = [*questions, *letters, *asked, DESCRIBE, "user", "assistant", "Later: "]
    return [*prompts * 20, *clock, *(r.text for r in rationales)]
