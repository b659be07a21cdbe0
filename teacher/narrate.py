"""Writes a rationale for every training item of the selection track: the command.

An answer goes into the store's rationales.jsonl as it comes, accepted or not. A run that was
killed goes on from there; the built-in narrator then ends with the very bytes of a whole run.
"""

from __future__ import annotations

import asyncio
import json
import logging
from collections import Counter, defaultdict
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import write_json, write_text
from conf.schema import NarrateCommand, TeacherConfig
from data.records import Rationale, SelectionItem
from teacher.narrator import write_rationale
from teacher.predicates import extract_predicates
from teacher.progress import Progress, kinds
from teacher.rationale_log import Journal, save_accepted
from teacher.report.summary import Summary, accepted_of, summarise
from teacher.servers.responses import Response
from teacher.validation.grader import RationaleGrader, signature

if TYPE_CHECKING:
    from data.store import Store
    from teacher.server_narrator import Job, Keep

log = logging.getLogger(__name__)

JOURNAL_FILE = "rationales.jsonl"
BATCH = 200
"""Lines of the built-in narrator between two waits for the disk."""


@dataclass(frozen=True)
class Narration:
    """A teacher's answers for a store: the accepted rationales in item order, all answers by item,
    and how many items have too short a prefix."""

    rationales: list[Rationale]
    items: list[SelectionItem]
    answers: dict[str, list[Rationale]]
    attempts: int
    seed: int
    too_short: int

    @cached_property
    def summary(self) -> Summary:
        """The figures of a report. They read every word, so they are worked out when asked for."""
        return summarise(self.items, self.answers, self.attempts, self.too_short)

    def __str__(self) -> str:
        rejected = Counter(
            kind for given in self.answers.values() for r in given for kind in kinds(r)
        )
        reasons = ", ".join(f"{count} {kind}" for kind, count in rejected.most_common())
        instead = sum(r.fallback for r in self.rationales)
        told = f" ({instead} by the built-in narrator instead)" if instead else ""
        aside = len(self.items) - self.too_short - len(self.rationales)
        return (
            f"rationales: {len(self.rationales)} accepted{told}, {aside} items set aside, "
            f"{self.too_short} with too short a prefix; answers were rejected for: "
            f"{reasons or 'nothing'}"
        )


@command("teacher.narrate", NarrateCommand)
def main(cfg: NarrateCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    narration = narrate_store(store, cfg.teacher)
    log.info(narration)
    report = ensure_report(store, narration, cfg.examples, run.folder)
    return {
        "accepted": float(report["accepted"]),
        "answers": float(sum(report["asked"])),
        "set_aside": float(report["set_aside"]),
        "too_short": float(report["too_short"]),
        "mean_words": float(np.mean(report["lengths"] or [0])),
    }


def ensure_report(store: Store, narration: Narration, shown: int, folder: Path) -> dict[str, Any]:
    """The figures of a folder's report.json, with `shown` rationales on report.html. Both are
    written anew where they are older than the last answer."""
    figures, page = folder / "report.json", folder / "report.html"
    answered = (store.folder / JOURNAL_FILE).stat().st_mtime
    if not page.exists() or page.stat().st_mtime < answered:
        from teacher.report.page import write_page

        told = narration.summary.text()
        write_json(figures, narration.summary.to_dict())
        write_text(folder / "report.txt", told + "\n")
        write_page(store, narration.rationales, told, shown, narration.seed, folder)
    log.info("report: %s", page)
    return json.loads(figures.read_bytes())


def ensure_rationales(store: Store, cfg: TeacherConfig) -> list[Rationale]:
    """The accepted rationale of each training item that has one, in item order; asks for those
    that are still to come."""
    narration = narrate_store(store, cfg)
    log.info(narration)
    return narration.rationales


def narrate_store(store: Store, cfg: TeacherConfig) -> Narration:
    """Ask a teacher for what is missing, and sum up all of its answers. The accepted ones are put
    into the store's rationales.parquet too.

    Raises:
        UserError: rationales.jsonl is damaged or of another benchmark, or the servers fail
            for good.
    """
    items = store.selection("train")
    judge = RationaleGrader(cfg)
    with Journal(store.folder / JOURNAL_FILE) as journal:
        check_items(journal, items)
        answers = defaultdict(list)
        for rationale in journal.rationales:
            wanted = cfg.fallback or not rationale.fallback
            if wanted and signature(rationale) == judge.signature:
                answers[rationale.item_id].append(rationale)
        # Settled items are left out here, so that none takes a place among the requests in flight.
        jobs = [(i, len(answers[i.item_id])) for i in items if _open(answers[i.item_id], cfg)]

        def keep(new: list[Rationale]) -> None:
            journal.append(new)
            for rationale in new:
                answers[rationale.item_id].append(rationale)

        progress, too_short = Progress(len(items), len(items) - len(jobs)), 0
        with progress.bar:
            if cfg.url is None:
                too_short = _narrate_all(jobs, store, judge, keep, progress)
            elif jobs:
                from teacher.server_narrator import ServerNarrator

                too_short = asyncio.run(ServerNarrator(store, cfg, judge, keep, progress).run(jobs))
        if cfg.fallback:
            aside = [item for item in items if _set_aside(answers[item.item_id], cfg)]
            keep([r for item in aside for r in _stand_in(item, store, judge)])
        rationales = accepted_of(items, answers)
        save_accepted(rationales, store.folder / "rationales.parquet")
    return Narration(rationales, items, dict(answers), cfg.attempts, cfg.seed, too_short)


def check_items(journal: Journal, items: list[SelectionItem]) -> None:
    """Raises UserError where a journal has answers to items that are not among these: it was
    narrated for another benchmark, and no answer is passed over in silence."""
    strangers = {r.item_id for r in journal.rationales} - {item.item_id for item in items}
    if strangers:
        raise UserError(
            f"{journal.path} has rationales for {len(strangers)} items that the training split "
            f"there does not hold, such as {min(strangers)}: it is of another benchmark. Put the "
            "file there that was narrated for this one, or delete it to narrate anew"
        )


def _open(given: list[Rationale], cfg: TeacherConfig) -> bool:
    return len(given) < cfg.attempts and not any(r.accepted for r in given)


def _set_aside(given: list[Rationale], cfg: TeacherConfig) -> bool:
    return len(given) >= cfg.attempts and not any(r.accepted for r in given)


def _stand_in(item: SelectionItem, store: Store, judge: RationaleGrader) -> list[Rationale]:
    """The built-in narrator's rationale for an item that was set aside, marked as such; none where
    it does not stand before the validator either."""
    predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
    cfg = judge.cfg
    if predicates is None:
        return []
    for attempt in range(cfg.attempts):
        reply = Response(write_rationale(predicates, item, cfg.seed, attempt))
        rationale = judge.judge(reply, predicates, item, cfg.attempts + attempt)
        if rationale.accepted:
            return [replace(rationale, fallback=True)]
    return []


def _narrate_all(
    jobs: list[Job], store: Store, judge: RationaleGrader, keep: Keep, progress: Progress
) -> int:
    """Narrate in item order without a server; gives the count of too short prefixes."""
    too_short, batch = 0, []
    for job in jobs:
        given = _narrate_one(job, store, judge)
        too_short += not given
        batch += given
        if len(batch) >= BATCH:
            keep(batch)
            batch = []
        progress.add(given)
        progress.settle()
    keep(batch)
    return too_short


def _narrate_one(job: Job, store: Store, judge: RationaleGrader) -> list[Rationale]:
    """An item's answers up to the accepted one or the last attempt; none for a short prefix."""
    item, first = job
    predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
    given: list[Rationale] = []
    if predicates is None:
        return given
    for attempt in range(first, judge.cfg.attempts):
        reply = Response(write_rationale(predicates, item, judge.cfg.seed, attempt))
        given.append(judge.judge(reply, predicates, item, attempt))
        if given[-1].accepted:
            break
    return given


if __name__ == "__main__":
    main()
