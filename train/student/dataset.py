"""The training and held-out datasets of a student."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

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
from train.common.held_out import check_not_empty, held_out_scenes, shuffled
from train.student.lazy_samples import LazySample, StudentDataset, seeded_rng
from train.tiny_base import questions

WITHOUT_RATIONALES = ("answer_only", "describe")
"""Regimes that train on no rationales."""


@dataclass(frozen=True)
class Supervised:
    """A selection item in one mode, with its rationale and match lines (empty in answer mode)."""

    item: SelectionItem
    mode: str
    regime: str
    rationale: str = ""
    matches: tuple[str, ...] = ()

    @property
    def response(self) -> str:
        return response(self.rationale, self.matches, self.item.letter, self.mode, self.regime)

    @property
    def text(self) -> str:
        return f"{self.item.question} {instruction(self.mode, self.regime)} {self.response}"

    def permuted(self, seed: int, epoch: int) -> Supervised:
        """Permute the candidates, and the letters in the texts with them, by seed and epoch."""
        order = seeded_rng(seed, epoch, self.item.item_id).permutation(len(LETTERS)).tolist()
        return replace(
            self,
            item=reorder_candidates(self.item, order),
            rationale=relabel_text(self.rationale, order),
            # One line per candidate, in the order of the letters.
            matches=tuple(sorted(relabel_text(line, order) for line in self.matches)),
        )


def supervised_items(
    store: Store, items: list[SelectionItem], rationales: dict[str, Rationale], regime: str
) -> dict[str, list[Supervised]]:
    """Return each item in answer mode and, if it has a rationale, in reasoning mode.

    A CoT student learns both modes, so that it can be prompted in either.
    """
    by_mode: dict[str, list[Supervised]] = {mode: [] for mode in MODES}
    for item in items:
        if rationale := rationales.get(item.item_id):
            lines = match_lines(store, item) if has_matches(regime) else ()
            by_mode["reasoning"].append(
                Supervised(item, "reasoning", regime, rationale.text, lines)
            )
        by_mode["answer"].append(Supervised(item, "answer", regime))
    return by_mode


def match_lines(store: Store, item: SelectionItem) -> tuple[str, ...]:
    """Return the match layout's line for each candidate of an item that has a rationale."""
    predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
    # An item whose prefix is too short for predicates has no rationale either.
    assert predicates is not None
    return write_match_lines(predicates, item)


def load_supervised(
    supervised: Supervised, frames: FrameReader, frame_count: int, seed: int | None, epoch: int
) -> Sample:
    """Render a sample, with its candidates permuted from epoch to epoch if there is a seed."""
    one = supervised if seed is None else supervised.permuted(seed, epoch)
    return selection_sample(one.item, one.mode, one.regime, frames, frame_count, one.response)


def build_datasets(
    store: Store,
    rationales: list[Rationale],
    frames: FrameReader,
    *,
    regime: str,
    frame_count: int,
    seed: int,
    validation_items: int,
    permute_candidates: bool = False,
) -> tuple[StudentDataset, dict[str, StudentDataset]]:
    """Return a regime's training dataset, and its held-out datasets by mode.

    Args:
        frame_count: Frames of a prefix that are visible.
        validation_items: Items of held-out training scenes, at most.
        permute_candidates: Whether the candidates' order changes from epoch to epoch in training.

    Raises:
        UserError: a dataset is empty.
    """
    if regime not in WITHOUT_RATIONALES:
        check_not_empty(len(rationales), "accepted rationales")
    held_out = held_out_scenes(store)
    others = set(store.scene_ids("train")) - held_out
    items = store.selection("train")
    # No frame of a held-out scene is visible in training, not even as a distractor.
    trained = [item for item in items if shows_only(item, others)]
    if regime == "describe":
        kept = [item for item in items if shows_only(item, held_out)]
        training, validation = (
            questions.build_questions(store, part, frame_count, frames, seed)
            for part in (trained, kept)
        )
        validation = {kind: shuffled(v, seed)[:validation_items] for kind, v in validation.items()}
    else:
        by_item = {r.item_id: r for r in rationales}
        # The items are sorted by family: a shuffled slice measures all of them.
        kept = shuffled([i for i in items if i.scene_id in held_out], seed)[:validation_items]

        def lazy(items: list[SelectionItem], seed: int | None) -> dict[str, list[LazySample]]:
            media = frame_count // 2 + len(LETTERS)
            return {
                mode: [
                    LazySample(
                        one.text,
                        media,
                        partial(load_supervised, one, frames, frame_count, seed),
                        one.item.family,
                    )
                    for one in supervised
                ]
                for mode, supervised in supervised_items(store, items, by_item, regime).items()
            }

        training, validation = lazy(trained, seed if permute_candidates else None), lazy(kept, None)
    samples = [sample for part in training.values() for sample in part]
    check_not_empty(len(samples), f"samples for train.regime={regime}")
    check_not_empty(sum(map(len, validation.values())), "items of held-out training scenes")
    return StudentDataset(samples), {m: StudentDataset(v) for m, v in validation.items() if v}


def shows_only(item: SelectionItem, scenes: set[str]) -> bool:
    """Whether all frames of an item belong to these scenes."""
    return {item.scene_id, *(c.scene_id for c in item.candidates)} <= scenes


def tokenizer_corpus(store: Store, rationales: list[Rationale]) -> list[str]:
    """Return texts to train a tokenizer on: everything that a student reads and writes."""
    item_questions = sorted({item.question for item in store.selection("train")})
    letters = [
        f"\nCandidate {x}: \nCandidate {x} matches: every object is where it should be.\n"
        f"Candidate {x} does not match: it shows other objects and lacks\n{answer_line(x)}"
        for x in LETTERS
    ]
    # Every digit and the timestamps' frame, often enough to be worth merges.
    clock = [f"<{tenths / 10:.1f} seconds>" for tenths in range(52)]
    instructions = [instruction(mode, "cot") for mode in MODES]
    roles = ["user", "assistant", "Later: "]
    prompts = [*item_questions, *letters, *instructions, *questions.QUESTIONS, *roles]
    return [*prompts * 20, *clock, *(r.text for r in rationales)]
