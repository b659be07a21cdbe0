"""Write a rationale for every training item of the selection track.

Every response, accepted or rejected, is appended to rationales.jsonl in the benchmark's folder, so
that a killed run resumes. With the built-in narrator, a resumed run leaves the same bytes in this
file as an uninterrupted one.
"""

from __future__ import annotations

import asyncio
import logging
import time
from collections import Counter, defaultdict
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from conf.entry import Run, command
from conf.errors import UserError
from conf.schema import NarrateCommand, TeacherConfig
from data.records import Rationale, SelectionItem
from teacher.journal import ACCEPTED, Journal, save_accepted
from teacher.narrator import write_rationale
from teacher.report import (
    Figures,
    describe_sufficiency,
    rejection_reasons,
    select_accepted,
    summarize,
    write_report,
)
from teacher.servers.responses import Response
from teacher.validation.grader import RationaleGrader
from teacher.vocabulary import choose_vocabulary, describe_item, name_vocabulary

if TYPE_CHECKING:
    from data.store import Store

log = logging.getLogger(__name__)

JOURNAL_FILE = "rationales.jsonl"
LISTED_REASONS = 3
"""Number of reasons for rejection in the progress bar, which lists the most frequent ones."""


@dataclass(frozen=True)
class Narration:
    """The result of `narrate_store`.

    Attributes:
        rationales: One accepted rationale of each training item that has any, in item order.
        figures: Statistics of all responses; see `teacher.report.summarize`.
    """

    rationales: list[Rationale]
    figures: Figures

    def __str__(self) -> str:
        f = self.figures
        fallback = f" ({f['fallback']} by the built-in narrator)" if f["fallback"] else ""
        rejections = ", ".join(f"{n} {kind}" for kind, n in f["rejected"].items())
        return (
            f"rationales: {f['accepted']} accepted{fallback}, "
            f"{f['set_aside']} items set aside, {f['too_short']} items with too short a prefix; "
            f"rejections: {rejections or 'none'}; {describe_sufficiency(f)}"
        )


@command("teacher.narrate", NarrateCommand)
def main(cfg: NarrateCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    narration = narrate_store(store, cfg.teacher)
    log.info(narration)
    figures = narration.figures
    page = write_report(store, narration.rationales, figures, cfg.examples, cfg.teacher, run.folder)
    log.info("report: %s", page)
    return {
        "accepted": float(figures["accepted"]),
        "responses": float(sum(figures["responses"])),
        "set_aside": float(figures["set_aside"]),
        "too_short": float(figures["too_short"]),
        "mean_words": float(np.mean(figures["lengths"] or [0])),
        "sufficiency": figures["sufficiency"].get("all", [0.0])[0],
    }


def ensure_rationales(store: Store, cfg: TeacherConfig) -> list[Rationale]:
    """Write the missing rationales, and return the accepted ones in the order of their items.

    Raises:
        UserError: See `narrate_store`.
    """
    narration = narrate_store(store, cfg)
    log.info(narration)
    return narration.rationales


def narrate_store(store: Store, cfg: TeacherConfig) -> Narration:
    """Write the missing rationales of training items, and save the accepted ones as parquet too.

    Raises:
        UserError: rationales.jsonl is damaged or belongs to another benchmark, or the servers
            cannot be used.
    """
    items = store.training_items()
    grader = RationaleGrader(cfg)
    with Journal(store.folder / JOURNAL_FILE) as journal:
        check_items(journal, items)
        report_other_vocabularies(journal, cfg)
        responses: dict[str, list[Rationale]] = defaultdict(list)
        for rationale in journal.rationales:
            if grader.is_current(rationale) and (cfg.fallback or not rationale.fallback):
                responses[rationale.item_id].append(rationale)
        for records in responses.values():
            own = [r for r in records if not r.fallback]
            if len(own) < cfg.attempts:
                # The server has attempts left, for example because its responses are out of date.
                records[:] = own

        def is_settled(item: SelectionItem) -> bool:
            return any(r.accepted for r in responses[item.item_id])

        # Finished items are left out, so that every concurrent job has a request to send.
        jobs = [
            (item, attempts)
            for item in items
            if (attempts := len(responses[item.item_id])) < cfg.attempts and not is_settled(item)
        ]
        progress = Progress(len(items), len(items) - len(jobs))

        def record(new: list[Rationale]) -> None:
            journal.append(new)
            for rationale in new:
                responses[rationale.item_id].append(rationale)
            progress.add_responses(new)

        with progress.bar:
            if cfg.url is None:
                for item, attempt in jobs:
                    record(_write_rationales(item, store, grader, attempt))
                    progress.bar.update()
            elif jobs:
                from teacher.server_narrator import request_rationales

                asyncio.run(request_rationales(jobs, store, grader, record, progress.bar.update))
        if cfg.fallback:
            for item in items:
                if not is_settled(item) and len(responses[item.item_id]) >= cfg.attempts:
                    *_, last = _write_rationales(item, store, grader)
                    if last.accepted:
                        attempt = cfg.attempts + last.attempt
                        record([grader.mark_fallback(last, attempt)])
        rationales = select_accepted(items, responses)
        save_accepted(rationales, store.folder / ACCEPTED)
    return Narration(rationales, summarize(items, responses))


class Progress:
    """A progress bar with the numbers of accepted and rejected responses, and tokens per second."""

    def __init__(self, total: int, done: int) -> None:
        self.bar = tqdm(total=total, initial=done, desc="narrating", unit="item", mininterval=1.0)
        self.accepted = self.tokens = 0
        self.rejected: Counter[str] = Counter()
        self.started = time.monotonic()

    def add_responses(self, responses: list[Rationale]) -> None:
        self.accepted += sum(r.accepted for r in responses)
        self.tokens += sum(r.completion_tokens or 0 for r in responses)
        self.rejected.update(kind for r in responses for kind in rejection_reasons(r))
        words = [f"{self.accepted} accepted"]
        words += [f"{n} {kind}" for kind, n in self.rejected.most_common(LISTED_REASONS)]
        if self.tokens:
            words.append(f"{self.tokens / (time.monotonic() - self.started):,.0f} tokens/s")
        self.bar.set_postfix_str(", ".join(words), refresh=False)


def check_items(journal: Journal, items: list[SelectionItem]) -> None:
    """Raises UserError if a journal has responses for items that are not in `items`."""
    unknown = {r.item_id for r in journal.rationales} - {item.item_id for item in items}
    if unknown:
        raise UserError(
            f"{journal.path} has rationales for {len(unknown)} items that the training split does "
            f"not have, such as {min(unknown)}, so it belongs to another benchmark. Replace it "
            "with the file of this benchmark, or delete it to narrate again",
            code="other-data",
        )


def report_other_vocabularies(journal: Journal, cfg: TeacherConfig) -> None:
    """Log which rationales of a journal use another vocabulary, or another version of it.
    They stay in the file, and are not used."""
    current = name_vocabulary(cfg)
    others = Counter(r.predicates for r in journal.rationales if r.predicates != current)
    for name, count in sorted(others.items()):
        log.info(
            "%s has %d responses of the vocabulary %s; they are not used, because "
            "teacher.predicates=%s asks for %s",
            *(journal.path, count, name, cfg.predicates, current),
        )


def _write_rationales(
    item: SelectionItem, store: Store, grader: RationaleGrader, first: int = 0
) -> list[Rationale]:
    """Write rationales of an item with the built-in narrator, from attempt `first` until one is
    accepted or no attempt is left. An item whose prefix is too short gets none."""
    predicates = describe_item(item, store, grader.cfg)
    if predicates is None:
        return []
    vocabulary = choose_vocabulary(predicates, grader.cfg)
    rationales: list[Rationale] = []
    for attempt in range(first, grader.cfg.attempts):
        text = write_rationale(vocabulary, item, grader.cfg.seed, attempt)
        rationales.append(grader.grade(Response(text), predicates, item, attempt))
        if rationales[-1].accepted:
            break
    return rationales


if __name__ == "__main__":
    main()
