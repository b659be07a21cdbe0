"""Command: writes a rationale for every training item of the selection track.

Every response is appended to the store's rationales.jsonl, accepted or not, so that a killed run
resumes. The built-in narrator then writes the same bytes as an uninterrupted run.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter, defaultdict
from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import write_json, write_text
from conf.schema import NarrateCommand, TeacherConfig
from data.records import Rationale, SelectionItem
from teacher.narrator import write_rationale
from teacher.predicates import extract_predicates
from teacher.progress import Progress, rejection_kinds
from teacher.rationale_log import Journal, save_accepted
from teacher.report.summary import Summary, select_accepted, summarize
from teacher.servers.responses import Response
from teacher.validation.grader import RationaleGrader

if TYPE_CHECKING:
    from data.store import Store
    from teacher.server_narrator import Job, SaveResponses

log = logging.getLogger(__name__)

JOURNAL_FILE = "rationales.jsonl"
BATCH_SIZE = 200
"""Responses of the built-in narrator per write to the disk."""


@dataclass(frozen=True)
class Narration:
    """A teacher's responses to the training items of a store.

    Attributes:
        rationales: The accepted rationale of each item that has one, in item order.
        items: The training items.
        responses: All responses by item.
        attempts: The most attempts that an item has.
        seed: The teacher's seed.
        too_short: Number of items whose prefix is too short.
    """

    rationales: list[Rationale]
    items: list[SelectionItem]
    responses: dict[str, list[Rationale]]
    attempts: int
    seed: int
    too_short: int

    @cached_property
    def summary(self) -> Summary:
        """The figures of a report; lazy, because they count every word."""
        return summarize(self.items, self.responses, self.attempts, self.too_short)

    def __str__(self) -> str:
        every = [r for responses in self.responses.values() for r in responses]
        rejected = Counter(kind for r in every for kind in rejection_kinds(r)).most_common()
        fallback = sum(r.fallback for r in self.rationales)
        set_aside = len(self.items) - self.too_short - len(self.rationales)
        return (
            f"rationales: {len(self.rationales)} accepted"
            f"{f' ({fallback} by the built-in narrator)' if fallback else ''}, "
            f"{set_aside} items set aside, {self.too_short} items with too short a prefix; "
            f"rejections: {', '.join(f'{n} {kind}' for kind, n in rejected) or 'none'}"
        )


@command("teacher.narrate", NarrateCommand)
def main(cfg: NarrateCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    narration = narrate_store(store, cfg.teacher)
    log.info(narration)
    write_report(store, narration, cfg.examples, run.folder)
    summary = narration.summary
    return {
        "accepted": float(summary.accepted),
        "answers": float(sum(summary.responses)),
        "set_aside": float(summary.set_aside),
        "too_short": float(summary.too_short),
        "mean_words": float(np.mean(summary.lengths or [0])),
    }


def write_report(store: Store, narration: Narration, examples: int, folder: Path) -> None:
    """Write report.json, report.txt and report.html, the last with some rationales."""
    from teacher.report.page import write_page

    figures = narration.summary.text()
    write_json(folder / "report.json", narration.summary.to_dict())
    write_text(folder / "report.txt", figures + "\n")
    page = write_page(store, narration.rationales, figures, examples, narration.seed, folder)
    log.info("report: %s", page)


def ensure_rationales(store: Store, cfg: TeacherConfig) -> list[Rationale]:
    """The accepted rationales of the training items in item order; missing ones are requested.

    Raises:
        UserError: See `narrate_store`.
    """
    narration = narrate_store(store, cfg)
    log.info(narration)
    return narration.rationales


def narrate_store(store: Store, cfg: TeacherConfig) -> Narration:
    """Request the missing rationales, and save the accepted ones to rationales.parquet too.

    Raises:
        UserError: rationales.jsonl is damaged or belongs to another benchmark, or the servers fail
            for good.
    """
    items = store.selection("train")
    grader = RationaleGrader(cfg)
    with Journal(store.folder / JOURNAL_FILE) as journal:
        check_items(journal, items)
        responses: dict[str, list[Rationale]] = defaultdict(list)
        for rationale in journal.rationales:
            if grader.is_current(rationale) and (cfg.fallback or not rationale.fallback):
                responses[rationale.item_id].append(rationale)

        def is_settled(item: SelectionItem) -> bool:
            return any(r.accepted for r in responses[item.item_id])

        def save(new: list[Rationale]) -> None:
            journal.append(new)
            for rationale in new:
                responses[rationale.item_id].append(rationale)

        # Finished items are left out, so that none occupies a slot of the requests in flight.
        jobs = [
            (item, attempts)
            for item in items
            if (attempts := len(responses[item.item_id])) < cfg.attempts and not is_settled(item)
        ]
        progress, too_short = Progress(len(items), len(items) - len(jobs)), 0
        with progress.bar:
            if cfg.url is None:
                too_short = _narrate_by_template(jobs, store, grader, save, progress)
            elif jobs:
                from teacher.server_narrator import ServerNarrator

                narrator = ServerNarrator(store, cfg, grader, save, progress)
                too_short = asyncio.run(narrator.run(jobs))
        if cfg.fallback:
            set_aside = (
                i for i in items if not is_settled(i) and len(responses[i.item_id]) >= cfg.attempts
            )
            save([r for item in set_aside for r in _write_fallback(item, store, grader)])
        rationales = select_accepted(items, responses)
        save_accepted(rationales, store.folder / "rationales.parquet")
    return Narration(rationales, items, dict(responses), cfg.attempts, cfg.seed, too_short)


def check_items(journal: Journal, items: list[SelectionItem]) -> None:
    """Raises UserError if a journal has responses to items that are not among `items`."""
    unknown = {r.item_id for r in journal.rationales} - {item.item_id for item in items}
    if unknown:
        raise UserError(
            f"{journal.path} has rationales for {len(unknown)} items that the training split does "
            f"not have, such as {min(unknown)}, so it belongs to another benchmark. Replace it by "
            "the file of this benchmark, or delete it to narrate again",
            code="other-data",
        )


def _narrate_by_template(
    jobs: list[Job],
    store: Store,
    grader: RationaleGrader,
    save: SaveResponses,
    progress: Progress,
) -> int:
    """Narrate in item order without a server; returns the number of too short prefixes."""
    too_short = 0
    batch: list[Rationale] = []
    for item, first in jobs:
        responses = []
        for rationale in _write_rationales(item, store, grader, first):
            responses.append(rationale)
            if rationale.accepted:
                break
        too_short += not responses
        batch += responses
        if len(batch) >= BATCH_SIZE:
            save(batch)
            batch = []
        progress.add_responses(responses)
        progress.finish_item()
    save(batch)
    return too_short


def _write_fallback(item: SelectionItem, store: Store, grader: RationaleGrader) -> list[Rationale]:
    """The built-in narrator's first accepted rationale for an item that was set aside, if any."""
    attempts = _write_rationales(item, store, grader)
    return [
        replace(r, fallback=True, attempt=grader.cfg.attempts + r.attempt)
        for r in attempts
        if r.accepted
    ][:1]


def _write_rationales(
    item: SelectionItem, store: Store, grader: RationaleGrader, first: int = 0
) -> Iterator[Rationale]:
    """The built-in narrator's rationales from attempt `first` on; none for a too short prefix."""
    predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
    if predicates is not None:
        for attempt in range(first, grader.cfg.attempts):
            text = write_rationale(predicates, item, grader.cfg.seed, attempt)
            yield grader.grade(Response(text), predicates, item, attempt)


if __name__ == "__main__":
    main()
