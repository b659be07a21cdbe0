"""Writes a rationale for every training item of the selection track: the command.

An answer goes into the store's rationales.jsonl as it comes, accepted or not. A run that was
killed goes on from there; the built-in narrator then ends with the very bytes of a whole run.
"""

from __future__ import annotations

import asyncio
import logging
from collections import Counter, defaultdict
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from conf.entry import Run, command
from conf.schema import NarrateCommand, TeacherConfig
from data.records import Rationale, SelectionItem
from teacher.journal import Journal, save_accepted
from teacher.judging import Judge, signature
from teacher.predicates import predicates_of
from teacher.progress import Progress
from teacher.replies import Reply
from teacher.template import narrate
from teacher.validate import word_count

if TYPE_CHECKING:
    from data.store import Store
    from teacher.asking import Job, Keep

log = logging.getLogger(__name__)

BATCH = 200
"""Lines of the built-in narrator between two waits for the disk."""


@dataclass(frozen=True)
class Report:
    """What a teacher's answers amount to: `rationales` are the accepted ones in item order,
    `rejected` counts answers by reason."""

    rationales: list[Rationale]
    rejected: Counter[str]
    set_aside: int
    too_short: int

    @property
    def mean_words(self) -> float:
        words = [word_count(r.text) for r in self.rationales]
        return sum(words) / max(1, len(words))

    def __str__(self) -> str:
        reasons = ", ".join(f"{n} {reason}" for reason, n in self.rejected.most_common())
        words = f" ({self.mean_words:.0f} words on average)" if self.rationales else ""
        return (
            f"rationales: {len(self.rationales)} accepted{words}, {self.set_aside} items set "
            f"aside, {self.too_short} with too short a prefix; answers were rejected for: "
            f"{reasons or 'nothing'}"
        )


@command("teacher.narrate", NarrateCommand)
def main(cfg: NarrateCommand, run: Run) -> dict[str, float]:
    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    report = narrate_store(store, cfg.teacher)
    log.info(report)
    return {
        "accepted": float(len(report.rationales)),
        "reasons_to_reject": float(report.rejected.total()),
        "set_aside": float(report.set_aside),
        "too_short": float(report.too_short),
        "mean_words": report.mean_words,
    }


def ensure_rationales(store: Store, cfg: TeacherConfig) -> list[Rationale]:
    """The accepted rationale of each training item that has one, in item order; asks for those
    that are still to come."""
    report = narrate_store(store, cfg)
    log.info(report)
    return report.rationales


def narrate_store(store: Store, cfg: TeacherConfig) -> Report:
    """Ask a teacher for what is missing, and report on all of its answers. The accepted ones are
    put into the store's rationales.parquet too.

    Raises:
        UserError: rationales.jsonl is damaged or in use, or the servers fail for good.
    """
    items = store.selection("train")
    judge = Judge(cfg)
    with Journal(store.folder / "rationales.jsonl") as journal:
        answers = defaultdict(list)
        for rationale in journal.rationales:
            if signature(rationale) == judge.signature:
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
                from teacher.asking import Asking

                too_short = asyncio.run(Asking(store, cfg, judge, keep, progress).run(jobs))
        report = _report(items, answers, cfg, too_short)
        save_accepted(report.rationales, store.folder / "rationales.parquet")
    return report


def _report(
    items: list[SelectionItem],
    answers: dict[str, list[Rationale]],
    cfg: TeacherConfig,
    too_short: int,
) -> Report:
    told = [answers[item.item_id] for item in items]
    accepted = [r for given in told for r in [r for r in given if r.accepted][:1]]
    reasons = Counter(reason.split(":")[0] for r in chain(*told) for reason in r.reasons)
    set_aside = sum(
        len(given) >= cfg.attempts and not any(r.accepted for r in given) for given in told
    )
    return Report(accepted, reasons, set_aside, too_short)


def _open(given: list[Rationale], cfg: TeacherConfig) -> bool:
    return len(given) < cfg.attempts and not any(r.accepted for r in given)


def _narrate_all(
    jobs: list[Job], store: Store, judge: Judge, keep: Keep, progress: Progress
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


def _narrate_one(job: Job, store: Store, judge: Judge) -> list[Rationale]:
    """An item's answers up to the accepted one or the last attempt; none for a short prefix."""
    item, first = job
    predicates = predicates_of(item, store.scene(item.scene_id), store.scene)
    given: list[Rationale] = []
    if predicates is None:
        return given
    for attempt in range(first, judge.cfg.attempts):
        reply = Reply(narrate(predicates, item, judge.cfg.seed, attempt))
        given.append(judge.judge(reply, predicates, item, attempt))
        if given[-1].accepted:
            break
    return given


if __name__ == "__main__":
    main()
