"""The training dataset and the validation datasets of a student."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from functools import partial

from dynapix.conf.schema import SftCommand, TeacherConfig
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import LETTERS, Rationale, SelectionItem, original_scene_id
from dynapix.data.store import Store
from dynapix.models.student.prompts import (
    MODES,
    Sample,
    answer_line,
    build_response,
    choose_instruction,
    facts_sample,
    has_matches,
    list_timestamps,
    selection_sample,
)
from dynapix.teacher.candidate_letters import relabel_text, reorder_candidates
from dynapix.teacher.narrator import write_facts, write_match_lines
from dynapix.teacher.predicates.grounding import Grounding
from dynapix.teacher.predicates.vocabulary import choose_vocabulary
from dynapix.train.common.held_out import check_not_empty, held_out_scenes, shuffled
from dynapix.train.student.samples import LazySample, StudentDataset, seeded_rng


@dataclass(frozen=True)
class SupervisedItem:
    """A selection item, and what a student's response to it in one mode is made of.

    `rationale` is the teacher's full text, and each of `matches` says whether a candidate matches.
    Both are empty in answer mode, and `matches` also in regimes without the match layout. `facts`
    are the facts of the item as text if they replace its frames, otherwise empty.
    """

    item: SelectionItem
    mode: str
    regime: str
    rationale: str = ""
    matches: tuple[str, ...] = ()
    facts: str = ""

    @property
    def response(self) -> str:
        return build_response(
            self.rationale, self.matches, self.item.letter, self.mode, self.regime
        )

    @property
    def text(self) -> str:
        parts = (
            self.item.question,
            self.facts,
            choose_instruction(self.mode, self.regime),
            self.response,
        )
        return " ".join(filter(None, parts))

    def lazy_sample(
        self,
        frames: FrameReader,
        frame_count: int,
        order_seed: int | None = None,
        repetition: int = 0,
    ) -> LazySample:
        """Return a sample that shows `frame_count` frames of the prefix.

        Args:
            order_seed: Seed with which the candidates are permuted in every epoch; None leaves
                their order.
            repetition: Number of the sample among those of the item in this mode. Each has another
                order, so that only the first shares its prompt with the item's other mode.
        """
        render = partial(self._render_in_epoch, frames, frame_count, order_seed, repetition)
        pairs = -(-frame_count // 2)
        picture_count = 0 if self.facts else pairs + len(LETTERS)
        name = self._name(repetition)
        return LazySample(self.text, picture_count, name, render, self.item.family)

    def _name(self, repetition: int) -> str:
        return f"{self.item.item_id}/{repetition}" if repetition else self.item.item_id

    def render(self, frames: FrameReader, frame_count: int) -> Sample:
        if self.facts:
            return facts_sample(self.item, self.mode, self.regime, self.facts, self.response)
        return selection_sample(
            self.item, self.mode, self.regime, frames, frame_count, self.response
        )

    def _render_in_epoch(
        self,
        frames: FrameReader,
        frame_count: int,
        order_seed: int | None,
        repetition: int,
        epoch: int,
    ) -> Sample:
        item = self if order_seed is None else self.permuted(order_seed, epoch, repetition)
        return item.render(frames, frame_count)

    def permuted(self, seed: int, epoch: int, repetition: int = 0) -> SupervisedItem:
        """Return a copy with permuted candidates, and with their new letters in its texts."""
        order = seeded_rng(seed, epoch, self._name(repetition)).permutation(len(LETTERS)).tolist()
        return replace(
            self,
            item=reorder_candidates(self.item, order),
            rationale=relabel_text(self.rationale, order),
            facts=relabel_text(self.facts, order),
            # One line per candidate, in the order of the letters.
            matches=tuple(sorted(relabel_text(line, order) for line in self.matches)),
        )


def supervised_items(
    store: Store,
    items: list[SelectionItem],
    rationales: dict[str, Rationale],
    regime: str,
    teacher: TeacherConfig,
    with_facts: bool = False,
) -> dict[str, list[SupervisedItem]]:
    """Return, by mode, every item in answer mode, and in reasoning mode if `rationales` has its id.

    A student that is trained on rationales learns both modes, so that it can be prompted in either.

    Args:
        teacher: Settings of the rationales; the lines about matches and the facts have their
            vocabulary.
        with_facts: Whether the facts of an item replace its frames. Items without a rationale are
            then left out.
    """
    by_mode: dict[str, list[SupervisedItem]] = {mode: [] for mode in MODES}
    grounding = Grounding(store, teacher)
    for item in items:
        rationale, facts, lines = rationales.get(item.item_id), "", ()
        if rationale and (with_facts or has_matches(regime)):
            # An item that has a rationale has predicates.
            predicates = choose_vocabulary(grounding.describe(item), teacher)
            facts = write_facts(predicates, item) if with_facts else ""
            lines = write_match_lines(predicates, item) if has_matches(regime) else ()
        if rationale:
            by_mode["reasoning"].append(
                SupervisedItem(item, "reasoning", regime, rationale.text, lines, facts)
            )
        if facts or not with_facts:
            by_mode["answer"].append(SupervisedItem(item, "answer", regime, facts=facts))
    return by_mode


def split_items(
    store: Store, validation_items: int, seed: int, hold_out: bool = True
) -> tuple[list[SelectionItem], list[SelectionItem]]:
    """Return the training items, and a sample of the items of held-out training scenes. No frame of
    a held-out scene is visible in training, not even as a distractor.

    Without `hold_out`, return all items of the training split, and a sample of them.
    """
    items = store.training_items()
    if not hold_out:
        return items, shuffled(items, seed)[:validation_items]
    held_out = held_out_scenes(store)
    training_scenes = set(store.scene_ids("train")) - held_out
    training = [item for item in items if uses_only(item, training_scenes)]
    # The items are sorted by family; a part of them has all families only if they are shuffled.
    validation = shuffled([i for i in items if i.scene_id in held_out], seed)
    return training, validation[:validation_items]


def load_datasets(
    cfg: SftCommand, store: Store, rationales: list[Rationale]
) -> tuple[StudentDataset, dict[str, StudentDataset]]:
    """Return the training dataset, and the validation datasets by mode.

    Raises:
        UserError: a dataset is empty.
    """
    train, frame_count = cfg.train, cfg.student.frames
    frames = FrameReader(store, cfg.student.image_size)
    if train.regime != "answer_only":
        check_not_empty(len(rationales), "accepted rationales", "teacher.narrate")
    training_items, validation_items = split_items(
        store, train.validation_items, cfg.seed, train.hold_out
    )
    by_item = {r.item_id: r for r in rationales}

    def samples_of(
        items: list[SelectionItem], order_seed: int | None = None, answers: int = 1
    ) -> dict[str, list[LazySample]]:
        by_mode = supervised_items(store, items, by_item, train.regime, cfg.teacher, train.facts)
        return {
            mode: [
                s.lazy_sample(frames, frame_count, order_seed, repetition)
                for repetition in range(answers if mode == "answer" else 1)
                for s in supervised
            ]
            for mode, supervised in by_mode.items()
        }

    order_seed = cfg.seed if train.permute_candidates else None
    training = samples_of(training_items, order_seed, train.answers)
    validation = samples_of(validation_items)
    samples = [sample for part in training.values() for sample in part]
    # With facts, items without rationale are left out.
    source = "teacher.narrate" if train.facts else "data.build"
    check_not_empty(len(samples), f"samples for train.regime={train.regime}", source)
    check_not_empty(sum(map(len, validation.values())), "items of held-out training scenes")
    return StudentDataset(samples), {m: StudentDataset(v) for m, v in validation.items() if v}


def uses_only(item: SelectionItem, scenes: set[str]) -> bool:
    """Return whether the prefix and all candidates of an item are frames of these scenes or of
    their alternative futures."""
    shown = (item.scene_id, *(c.scene_id for c in item.candidates))
    return {original_scene_id(scene) for scene in shown} <= scenes


def tokenizer_corpus(store: Store, rationales: list[Rationale]) -> list[str]:
    """Return texts to train a tokenizer on: everything that a student reads and writes."""
    return prompt_corpus(store.training_items()) + [r.text for r in rationales]


def prompt_corpus(items: Sequence[SelectionItem], others: Sequence[str] = ()) -> list[str]:
    """Return the texts of prompts about items and of answers, and `others`, for a tokenizer."""
    item_questions = sorted({item.question for item in items})
    letters = [
        f"\nCandidate {x}: \nCandidate {x} matches: every object is where it should be.\n"
        f"Candidate {x} does not match: it shows other objects and lacks\n{answer_line(x)}"
        for x in LETTERS
    ]
    instructions = [choose_instruction(mode, "cot") for mode in MODES]
    roles = ["user", "assistant"]
    prompts = [*item_questions, *letters, *instructions, *others, *roles]
    return [*prompts * 20, *list_timestamps()]
