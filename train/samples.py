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

from conf.schema import SftCommand, StudentConfig
from data.frames import Frames
from data.records import LETTERS, Rationale, Scene, SelectionItem
from data.store import Store
from teacher.predicates import OUT, region_of
from teacher.template import describe
from train.conversation import (
    ASK,
    DESCRIBE,
    Sample,
    answer_line,
    description_sample,
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
    the text that it does not share with others of its kind."""

    text: str
    make: Callable[[], Sample]


class Samples(Dataset):
    """Planned samples as a trainer reads them."""

    def __init__(self, planned: Sequence[Planned]) -> None:
        self._planned = planned

    def __len__(self) -> int:
        return len(self._planned)

    def __getitem__(self, index: int) -> Sample:
        return self._planned[index].make()

    def longest(self, tokenizer: PreTrainedTokenizerBase) -> Sample:
        """The sample with the most tokens. Frames are alike in all of them, so the text tells."""
        encoded = tokenizer([p.text for p in self._planned], add_special_tokens=False).input_ids
        return self[max(range(len(self)), key=lambda k: len(encoded[k]))]


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
    items: list[SelectionItem], rationales: dict[str, Rationale], cfg: StudentConfig, frames: Frames
) -> dict[str, list[Planned]]:
    """Each item in reasoning mode, where it has a rationale, and in answer mode."""
    made: dict[str, list[Planned]] = {"reasoning": [], "answer": []}
    for item in items:
        if rationale := rationales.get(item.item_id):
            made["reasoning"].append(_asked(item, "reasoning", frames, cfg, rationale.text))
        made["answer"].append(_asked(item, "answer", frames, cfg, answer_line(item.letter)))
    return made


def _asked(
    item: SelectionItem, mode: str, frames: Frames, cfg: StudentConfig, response: str
) -> Planned:
    text = f"{item.question} {ASK[mode]} {response}"
    return Planned(text, partial(selection_sample, item, mode, frames, cfg, response))


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
            make = partial(description_sample, scene_id, start, stop, target, frames, cfg, text)
            made.append(Planned(text, make))
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
            made.append(_asked(asked, "answer", frames, cfg, text))
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
    training = supervised_items(
        [i for i in items if i.scene_id in others], by_item, cfg.student, frames
    )
    validation = supervised_items(kept, by_item, cfg.student, frames)
    # A CoT student learns both modes, so that it can be asked in either.
    return (
        Samples(training["reasoning"] + training["answer"]),
        {mode: Samples(planned) for mode, planned in validation.items() if planned},
    )


def corpus(store: Store, rationales: list[Rationale]) -> list[str]:
    """Texts for a tokenizer built from nothing: all that a student reads and writes."""
    questions = sorted({item.question for item in store.selection("train")})
    letters = [f"\nCandidate {x}: \n{answer_line(x)}" for x in LETTERS]
    # Every digit and the timestamps' frame, often enough to be worth merges.
    clock = [f"<{tenths / 10:.1f} seconds>" for tenths in range(52)]
    prompts = [*questions, *letters, *ASK.values(), DESCRIBE, "user", "assistant", "Later: "]
    return [*prompts * 20, *clock, *(r.text for r in rationales)]
