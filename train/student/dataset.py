"""What a regime trains on and is measured on: lists of samples that are made when asked for."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from conf.schema import SftCommand, SftTrainConfig, StudentConfig
from data.records import LETTERS, Rationale, SelectionItem
from data.render.frame_cache import FrameReader
from data.store import Store
from models.student.prompts import (
    MODES,
    Sample,
    answer_line,
    has_matches,
    instruction,
    response,
    selection_sample,
)
from teacher.candidate_letters import relabel_text, reorder_candidates
from teacher.narrator import write_match_lines
from teacher.predicates import extract_predicates
from train.student.lazy_samples import LazySample, Samples, seeded_rng
from train.tiny_base import questions

HELD_OUT = 0.1
"""Share of the training scenes whose items measure a run."""

Row = TypeVar("Row")


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
        rng = seeded_rng(self.seed, epoch, self.item.item_id)
        order = rng.permutation(len(LETTERS)).tolist()
        return replace(
            self,
            item=reorder_candidates(self.item, order),
            rationale=relabel_text(self.rationale, order),
            # The letters again stand in their own order.
            matches=tuple(sorted(relabel_text(line, order) for line in self.matches)),
        )

    def sample(self, frames: FrameReader, cfg: StudentConfig, epoch: int) -> Sample:
        shown = self.in_epoch(epoch)
        told = response(shown.rationale, shown.matches, shown.item.letter, self.mode, self.regime)
        return selection_sample(shown.item, self.mode, self.regime, frames, cfg, told)

    def planned(self, frames: FrameReader, cfg: StudentConfig) -> LazySample:
        media = cfg.frames // 2 + len(LETTERS)
        make = partial(self.sample, frames, cfg)
        return LazySample(self.text(), media, make, self.item.family)


def held_out_scenes(store: Store) -> set[str]:
    """A share of the training scenes, kept from training to measure it. Test scenes are never
    touched here.

    It goes by each scene's name alone, not by a run's seed or the store's other scenes: a base must
    not have been trained on what measures a student that is trained over it.
    """
    names = store.scene_ids("train")
    # A store of a few scenes may have none below the bound.
    return {name for name in names if lot(name) < HELD_OUT} or {min(names, key=lot)}


def lot(name: str) -> float:
    """A number in [0, 1) that follows from a name alone."""
    return int.from_bytes(hashlib.sha256(name.encode()).digest()[:8], "big") / 2**64


def shows_only(item: SelectionItem, scenes: set[str]) -> bool:
    """Whether all that an item shows is of these scenes."""
    return {item.scene_id, *(c.scene_id for c in item.candidates)} <= scenes


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
    predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
    # An item with too short a prefix has no rationale either.
    assert predicates is not None
    return write_match_lines(predicates, item)


def splits(
    store: Store, rationales: list[Rationale], cfg: SftCommand, frames: FrameReader
) -> tuple[Samples, dict[str, Samples]]:
    """Training samples of a regime, and what measures it on held-out training scenes, by mode."""
    held_out = held_out_scenes(store)
    others = set(store.scene_ids("train")) - held_out
    limit = cfg.train.validation_items
    items = store.selection("train")
    # A training item may show, among its candidates, no frame of what measures the run.
    trained = [item for item in items if shows_only(item, others)]
    if cfg.train.regime == "describe":
        kept = [item for item in items if shows_only(item, held_out)]
        told, measuring = (
            questions.build_questions(store, part, cfg.student, frames, cfg.seed)
            for part in (trained, kept)
        )
        return Samples([sample for made in told.values() for sample in made]), {
            kind: Samples(shuffled(made, cfg.seed)[:limit])
            for kind, made in measuring.items()
            if made
        }
    by_item = {r.item_id: r for r in rationales}
    # The items of every family stand together: a shuffled slice measures all of them.
    kept = shuffled([i for i in items if i.scene_id in held_out], cfg.seed)[:limit]
    seed = cfg.seed if cfg.train.permute_candidates else None
    training = supervised_items(store, trained, by_item, cfg.train, seed)
    validation = supervised_items(store, kept, by_item, cfg.train, None)

    def planned(supervised: list[Supervised]) -> list[LazySample]:
        return [s.planned(frames, cfg.student) for s in supervised]

    # A CoT student learns both modes, so that it can be asked in either.
    return (
        Samples([sample for mode in MODES for sample in planned(training[mode])]),
        {mode: Samples(planned(made)) for mode, made in validation.items() if made},
    )


def corpus(store: Store, rationales: list[Rationale]) -> list[str]:
    """Texts for a tokenizer built from nothing: all that a student reads and writes."""
    asked_questions = sorted({item.question for item in store.selection("train")})
    letters = [
        f"\nCandidate {x}: \nCandidate {x} matches: every object is where it should be.\n"
        f"Candidate {x} does not match: it shows other objects and lacks\n{answer_line(x)}"
        for x in LETTERS
    ]
    # Every digit and the timestamps' frame, often enough to be worth merges.
    clock = [f"<{tenths / 10:.1f} seconds>" for tenths in range(52)]
    asked = [instruction(mode, "cot") for mode in MODES]
    prompts = [
        *asked_questions,
        *letters,
        *asked,
        *questions.QUESTIONS,
        "user",
        "assistant",
        "Later: ",
    ]
    return [*prompts * 20, *clock, *(r.text for r in rationales)]
