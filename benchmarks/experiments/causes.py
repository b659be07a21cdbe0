"""Measures which part of a student's rationale costs its accuracy: the student continues the true
rationale of each test item from different places.

    python -m benchmarks.experiments.causes checkpoints/sft/exp-cot

Each row gives the student a longer part of the true rationale:

    nothing               the student writes everything
    scene                 what can be seen at the end of the prefix: perception
    motion                how the objects move until the target, too: a part of foresight
    prediction            what will be true at the target, too: foresight
    candidate analysis    what each candidate shows, too: the student has to compare it with the
                          prediction or, in the paper's vocabulary, to copy the letter of the
                          candidate that agrees (a section that students of the regime
                          cot_no_candidate_analysis have not seen)

The true rationale states what decides the item, so every part also reveals which objects matter.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Sequence
from pathlib import Path

from tqdm import tqdm

from benchmarks.arguments import positive_int
from benchmarks.experiments.experiment import compose_benchmark, open_benchmark
from conf.failures import report_failures
from conf.schema import SftCommand, TeacherConfig
from data.frames.frame_cache import FrameReader
from data.parallel import batched
from data.records import FAMILIES, SelectionItem
from data.store import Store
from evaluation.select import limit_items
from models import loading
from models.precision import resolve_precision
from models.resolved_settings import check_base
from models.student.answer_parser import parse_choice
from models.student.collator import Collator
from models.student.generation import generate
from models.student.prompts import Sample, selection_sample
from models.trained_runs import check_modes, check_unseen, product_folder, read_trained_settings
from teacher.narrator import write_rationale
from teacher.predicates.vocabulary import choose_vocabulary, describe_item
from teacher.sections import split_sections

GIVEN = {
    "nothing": None,
    "scene": "Scene parse",
    "motion": "Motion analysis",
    "prediction": "Prediction",
    "candidate analysis": "Candidate analysis",
}
"""The last given section of the true rationale, by row of the table."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("student", type=Path, help="folder of a run of train.sft")
    parser.add_argument("--benchmark", default="tiny")
    parser.add_argument("--store", type=Path, default=Path("store"))
    parser.add_argument("--items", type=positive_int, default=300, help="number of test items")
    parser.add_argument("--batch", type=positive_int, default=32)
    args = parser.parse_args()
    trained = read_trained_settings(args.student, SftCommand, "student")
    check_base(args.student, trained.student)
    check_modes(args.student, trained.train.regime, ["reasoning"])
    check_unseen(str(args.student), trained.benchmark, compose_benchmark(args.benchmark))
    store = open_benchmark(args.store, args.benchmark)
    items = limit_items(store.selection("test"), args.items, seed=0)
    truth = {item.item_id: true_rationale(item, store, trained.teacher) for item in items}
    items = [item for item in items if truth[item.item_id]]
    student = Student(trained, args.student, store)
    print("| given | " + " | ".join(FAMILIES) + " | macro |\n|---|---|---|---|---|", flush=True)
    for name, section in GIVEN.items():
        right: dict[str, list[bool]] = {family: [] for family in FAMILIES}
        for batch in tqdm([*batched(items, args.batch)], desc=name, unit="batch", leave=False):
            given = [end_after(truth[item.item_id], section) for item in batch]
            for item, letter in zip(batch, student.choose(batch, given), strict=True):
                right[item.family].append(letter == item.letter)
        shares = [100 * sum(values) / len(values) if values else None for values in right.values()]
        macro = None if None in shares else sum(shares) / len(shares)
        cells = ["-" if share is None else f"{share:.1f}" for share in (*shares, macro)]
        print(f"| {name} | " + " | ".join(cells) + " |", flush=True)


def true_rationale(item: SelectionItem, store: Store, teacher: TeacherConfig) -> str:
    """Return the built-in narrator's rationale of an item; empty if its prefix is too short."""
    predicates = describe_item(item, store, teacher)
    if predicates is None:
        return ""
    return write_rationale(choose_vocabulary(predicates, teacher), item, teacher.seed)


def end_after(rationale: str, section: str | None) -> str:
    """Return a rationale up to the end of a section; nothing if `section` is None."""
    if section is None:
        return ""
    ends = {heading: stop for heading, _, stop in split_sections(rationale)}
    return rationale[: ends[section]].rstrip() + "\n"


class Student:
    """A trained student that continues responses."""

    def __init__(self, trained: SftCommand, folder: Path, store: Store) -> None:
        self._settings, self._frames = trained, FrameReader(store, trained.student.image_size)
        self._precision = resolve_precision(trained.train.precision)
        weights = product_folder(folder, "student")
        self._model, self._processor = loading.load_trained(
            trained.student, self._precision, weights
        )
        self._collate = Collator(self._processor, trained.student.max_length)

    def choose(self, items: Sequence[SelectionItem], given: Sequence[str]) -> Iterator[str | None]:
        """Let the student continue a given start of its response to each item, and yield the
        letters that it chooses."""
        samples = [self._sample(item, text) for item, text in zip(items, given, strict=True)]
        inputs = self._collate(samples)
        if samples[0].response is not None:
            # Rows are padded on the left: the last token of each ends its turn.
            for name in ("input_ids", "attention_mask", "mm_token_type_ids"):
                inputs[name] = inputs[name][:, :-1]
            del inputs["logits_to_keep"]
        limit = self._settings.student.max_new_tokens
        texts = generate(self._model, self._processor, inputs, limit, self._precision)
        for start, text in zip(given, texts, strict=True):
            yield parse_choice(start + text.text, truncated=text.truncated).letter

    def _sample(self, item: SelectionItem, given: str) -> Sample:
        regime, frame_count = self._settings.train.regime, self._settings.student.frames
        return selection_sample(
            item, "reasoning", regime, self._frames, frame_count, response=given or None
        )


if __name__ == "__main__":
    with report_failures():
        main()
