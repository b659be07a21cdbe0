"""The prompts of student and teacher in on-policy distillation, about the same items."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

from conf.schema import DistillCommand, SftCommand
from data.records import Rationale, SelectionItem
from data.render.frame_cache import FrameReader
from data.store import Store
from models.student.prompts import Sample
from train.common.held_out import check_not_empty
from train.student.dataset import SupervisedItem, split_items, supervised_items
from train.student.lazy_samples import LazySample, StudentDataset, seeded_rng


@dataclass(frozen=True)
class PairedPrompts:
    """The prompts of student and teacher about one item.

    Attributes:
        letter: The letter of the target.
        seed: Seed of the student's response.
        supervised: Whether the item is trained on; if not, it only fills a batch.
    """

    student: Sample
    teacher: Sample
    letter: str
    seed: int
    supervised: bool = True


def pair_prompts(
    seen: LazySample, facts: SupervisedItem, teacher: LazySample, seed: int, permute: bool
) -> LazySample:
    """Return the prompts about an item with its frames (`seen`) and with its facts (`teacher`).

    Args:
        facts: The item with its facts.
        seed: Seed of the responses and, if `permute` is true, of the order of the candidates.
    """

    def render(epoch: int) -> PairedPrompts:
        shown = facts.permuted(seed, epoch) if permute else facts
        rng = seeded_rng("response", seed, epoch, facts.item.item_id)
        return PairedPrompts(
            replace(seen.render(epoch), response=None),
            replace(teacher.render(epoch), response=None),
            shown.item.letter,
            int(rng.integers(2**31)),
        )

    return replace(seen, render=render)


def load_datasets(
    cfg: DistillCommand, trained: SftCommand, store: Store, rationales: Sequence[Rationale]
) -> tuple[StudentDataset, dict[str, StudentDataset]]:
    """Return the training dataset, whose samples are `PairedPrompts`s, and the validation
    dataset in reasoning mode, which has the narrator's rationales.

    Args:
        trained: Settings of the student.

    Raises:
        UserError: a dataset is empty.
    """
    frames = FrameReader(store, trained.student.image_size)
    by_item = {r.item_id: r for r in rationales}
    permute = cfg.train.permute_candidates
    training, validation = split_items(store, cfg.train.validation_items, cfg.seed)

    def supervise(items: list[SelectionItem], with_facts: bool) -> list[SupervisedItem]:
        regime = trained.train.regime
        by_mode = supervised_items(store, items, by_item, regime, trained.teacher, with_facts)
        return by_mode["reasoning"]

    def lazy(supervised: SupervisedItem, permute: bool) -> LazySample:
        seed = cfg.seed if permute else None
        return supervised.lazy_sample(frames, trained.student.frames, seed)

    samples = [
        pair_prompts(lazy(seen, permute), facts, lazy(facts, permute), cfg.seed, permute)
        for seen, facts in zip(supervise(training, False), supervise(training, True), strict=True)
    ]
    held_out = [lazy(seen, False) for seen in supervise(validation, False)]
    check_not_empty(len(samples), "training items with accepted rationales")
    check_not_empty(len(held_out), "items of held-out training scenes with accepted rationales")
    return StudentDataset(samples), {"reasoning": StudentDataset(held_out)}
