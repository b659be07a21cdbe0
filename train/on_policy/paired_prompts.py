"""The prompts of student and teacher in on-policy distillation, about the same items."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from dynapix.conf.schema import DistillCommand, SftCommand
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import Rationale
from dynapix.data.store import Store
from dynapix.models.student.prompts import Sample
from dynapix.train.common.held_out import check_not_empty
from dynapix.train.student.dataset import SupervisedItem, split_items, supervised_items
from dynapix.train.student.samples import LazySample, StudentDataset, seeded_rng


@dataclass(frozen=True)
class PairedPrompts:
    """The prompts of student and teacher about one item, without responses.

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
    item: SupervisedItem, frames: FrameReader, frame_count: int, seed: int, permute: bool
) -> LazySample:
    """Return a sample that renders `PairedPrompts` of an item: with its frames for the student, and
    with its facts for the teacher.

    Args:
        item: The item with its facts.
        seed: Seed of the responses and, if `permute` is true, of the order of the candidates.
    """
    student = replace(item, facts="").lazy_sample(frames, frame_count)
    return replace(student, render=partial(_render, item, frames, frame_count, seed, permute))


def _render(
    item: SupervisedItem,
    frames: FrameReader,
    frame_count: int,
    seed: int,
    permute: bool,
    epoch: int,
) -> PairedPrompts:
    shown = item.permuted(seed, epoch) if permute else item
    student = replace(shown, facts="").render(frames, frame_count)
    teacher = shown.render(frames, frame_count)
    rng = seeded_rng("response", seed, epoch, item.item.item_id)
    return PairedPrompts(
        replace(student, response=None),
        replace(teacher, response=None),
        shown.item.letter,
        int(rng.integers(2**31)),
    )


def load_datasets(
    cfg: DistillCommand, trained: SftCommand, store: Store, rationales: Sequence[Rationale]
) -> tuple[StudentDataset, dict[str, StudentDataset]]:
    """Return the training dataset, whose samples are `PairedPrompts`, and the validation datasets
    by mode, with the narrator's rationales as responses.

    Args:
        trained: Settings of the student.

    Raises:
        UserError: a dataset is empty.
    """
    frames, frame_count = FrameReader(store, trained.student.image_size), trained.student.frames
    by_item = {r.item_id: r for r in rationales}
    training, validation = split_items(
        store, cfg.train.validation_items, cfg.seed, cfg.train.hold_out
    )
    shared = (by_item, trained.train.regime, trained.teacher)
    permute = cfg.train.permute_candidates
    samples = [
        pair_prompts(item, frames, frame_count, cfg.seed, permute)
        for item in supervised_items(store, training, *shared, True)["reasoning"]
    ]
    held_out = {
        mode: StudentDataset([item.lazy_sample(frames, frame_count) for item in items])
        for mode, items in supervised_items(store, validation, *shared).items()
    }
    check_not_empty(len(samples), "training items with accepted rationales", "teacher.narrate")
    check_not_empty(
        len(held_out["reasoning"]), "held-out items with accepted rationales", "teacher.narrate"
    )
    return StudentDataset(samples), held_out
