"""The training and held-out datasets of a student."""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import partial

from conf.schema import SftCommand
from conf.schema.training import WITHOUT_RATIONALES
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


@dataclass(frozen=True)
class SupervisedItem:
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

    def lazy(self, frames: FrameReader, frame_count: int, seed: int | None) -> LazySample:
        """Return a sample with `frame_count` frames of the prefix. With a seed, each epoch permutes
        the candidates."""
        render = partial(self.render, frames, frame_count, seed)
        return LazySample(self.text, frame_count // 2 + len(LETTERS), render, self.item.family)

    def render(self, frames: FrameReader, frame_count: int, seed: int | None, epoch: int) -> Sample:
        one = self if seed is None else self.permuted(seed, epoch)
        return selection_sample(one.item, one.mode, one.regime, frames, frame_count, one.response)

    def permuted(self, seed: int, epoch: int) -> SupervisedItem:
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
) -> dict[str, list[SupervisedItem]]:
    """Return each item in answer mode and, if it has a rationale, in reasoning mode.

    A CoT student learns both modes, so that it can be prompted in either.
    """
    by_mode: dict[str, list[SupervisedItem]] = {mode: [] for mode in MODES}
    for item in items:
        if rationale := rationales.get(item.item_id):
            lines: tuple[str, ...] = ()
            if has_matches(regime):
                # An item that has a rationale has predicates.
                predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
                lines = write_match_lines(predicates, item)
            by_mode["reasoning"].append(
                SupervisedItem(item, "reasoning", regime, rationale.text, lines)
            )
        by_mode["answer"].append(SupervisedItem(item, "answer", regime))
    return by_mode


def load_datasets(
    cfg: SftCommand, store: Store, rationales: list[Rationale]
) -> tuple[StudentDataset, dict[str, StudentDataset]]:
    """Return the training dataset of a regime, and the held-out datasets by mode.

    Raises:
        UserError: a dataset is empty.
    """
    train, frame_count, seed = cfg.train, cfg.student.frames, cfg.seed
    frames = FrameReader(store, cfg.student.image_size)
    if train.regime not in WITHOUT_RATIONALES:
        check_not_empty(len(rationales), "accepted rationales")
    held_out = held_out_scenes(store)
    others = set(store.scene_ids("train")) - held_out
    items = store.selection("train")
    # No frame of a held-out scene is visible in training, not even as a distractor.
    trained = [item for item in items if uses_only(item, others)]
    if train.regime == "describe":
        measured = [item for item in items if uses_only(item, held_out)]
        training, validation = (
            questions.build_questions(store, part, frame_count, frames, seed)
            for part in (trained, measured)
        )
        validation = {
            kind: shuffled(samples, seed)[: train.validation_items]
            for kind, samples in validation.items()
        }
    else:
        by_item = {r.item_id: r for r in rationales}
        # The items are sorted by family: a part of them has all families only if they are shuffled.
        measured = shuffled([i for i in items if i.scene_id in held_out], seed)

        def lazy(items: list[SelectionItem], seed: int | None) -> dict[str, list[LazySample]]:
            by_mode = supervised_items(store, items, by_item, train.regime)
            return {m: [s.lazy(frames, frame_count, seed) for s in by_mode[m]] for m in by_mode}

        training = lazy(trained, seed if train.permute_candidates else None)
        validation = lazy(measured[: train.validation_items], None)
    samples = [sample for part in training.values() for sample in part]
    check_not_empty(len(samples), f"samples for train.regime={train.regime}")
    check_not_empty(sum(map(len, validation.values())), "items of held-out training scenes")
    return StudentDataset(samples), {m: StudentDataset(v) for m, v in validation.items() if v}


def uses_only(item: SelectionItem, scenes: set[str]) -> bool:
    """Whether the prefix and all candidates of an item are of these scenes."""
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
