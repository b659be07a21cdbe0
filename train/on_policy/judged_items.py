"""The items whose responses are judged, and the order in which TRL's trainer reads them."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial
from typing import Any

from datasets import Dataset
from trl.trainer.utils import RepeatSampler

from dynapix.conf.schema import ReinforceTrainConfig, SftCommand
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import SelectionItem
from dynapix.data.store import Store
from dynapix.models.student.prompts import Sample, selection_sample
from dynapix.teacher.predicates.facts import RelationalPredicates
from dynapix.teacher.predicates.vocabulary import describe_item
from dynapix.train.common.held_out import check_not_empty
from dynapix.train.on_policy.sampling import EncodedPrompt
from dynapix.train.student.dataset import split_items

PROMPT = "encoded"
"""Key of the encoded prompt in a row of the dataset."""


@dataclass(frozen=True)
class ItemToJudge:
    """An item whose responses are judged, its predicates, and its prompt without response."""

    item: SelectionItem
    predicates: RelationalPredicates
    render: Callable[[], Sample]


def load_items(
    cfg: ReinforceTrainConfig, trained: SftCommand, store: Store, seed: int
) -> tuple[list[ItemToJudge], list[ItemToJudge]]:
    """Return the training items, and held-out items, that have predicates.

    Raises:
        UserError: there are none.
    """
    frames = FrameReader(store, trained.student.image_size)
    regime, count = trained.train.regime, trained.student.frames

    def with_predicates(items: Sequence[SelectionItem]) -> list[ItemToJudge]:
        found = []
        for item in items:
            predicates = describe_item(item, store, trained.teacher)
            if predicates is not None:
                prompt = partial(selection_sample, item, "reasoning", regime, frames, count)
                found.append(ItemToJudge(item, predicates, prompt))
        return found

    split = split_items(store, cfg.validation_items, seed, cfg.hold_out)
    training, validation = map(with_predicates, split)
    check_not_empty(len(training), "training items with predicates", "teacher.narrate")
    check_not_empty(len(validation), "held-out items with predicates", "teacher.narrate")
    return training, validation


class PromptRows(Dataset):
    """TRL's dataset: a row per item of a split, whose prompt is rendered and encoded when it is
    read. Rows of an item that are read together share its prompt.

    The index ~k, which is negative, returns row k without its prompt: TRL reads the rows of a step
    for each of its micro-batches, but uses them once.

    Args:
        name: Name of the split.
        encode: Encodes a prompt.
    """

    def __init__(
        self,
        name: str,
        items: Sequence[ItemToJudge],
        encode: Callable[[Sample], EncodedPrompt],
    ) -> None:
        # TRL needs a text as the prompt.
        super().__init__(Dataset.from_dict({"prompt": [e.item.item_id for e in items]}).data)
        self._name, self._items, self._encode = name, items, encode

    def __getitems__(self, indices: list[int]) -> list[dict[str, Any]]:
        read = [k for k in dict.fromkeys(indices) if k >= 0]
        prompts = {k: self._encode(self._items[k].render()) for k in read}
        rows = [{"split": self._name, "index": max(k, ~k), PROMPT: prompts.get(k)} for k in indices]
        return [{"prompt": self._items[row["index"]].item.item_id, **row} for row in rows]


class EpochSampler(RepeatSampler):
    """TRL's sampler with an order of its own in each epoch. TRL's continues one order of random
    numbers, which a resumed run would begin again.

    Where it repeats the indices k of a step, it returns ~k.
    """

    def __iter__(self) -> Iterator[int]:
        step = self.batch_size * self.mini_repeat_count
        for position, index in enumerate(super().__iter__()):
            yield index if position // step % self.repeat_count == 0 else ~index

    def set_epoch(self, epoch: int) -> None:
        self.generator.manual_seed(self.seed + epoch)
