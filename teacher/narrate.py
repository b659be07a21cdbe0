"""Writes a rationale for every training item of the selection track: the command.

An answer goes into the store's rationales.jsonl as it comes, accepted or not. A run that was
killed goes on from there; the built-in narrator then ends with the very bytes of a whole run.
"""

from __future__ import annotations

import asyncio
import hashlib
import json
import logging
from collections import Counter, defaultdict
from collections.abc import Callable
from dataclasses import dataclass
from itertools import chain
from pathlib import Path
from typing import TYPE_CHECKING

from tqdm import tqdm

from conf.entry import Run, command
from conf.schema import NarrateCommand, TeacherConfig
from data.records import Rationale, SelectionItem
from teacher.journal import Journal
from teacher.predicates import Predicates, predicates_of
from teacher.prompts import PROMPT_VERSION, messages
from teacher.template import NARRATOR_VERSION, narrate
from teacher.validate import VALIDATOR_VERSION, validate, word_count

if TYPE_CHECKING:
    from data.store import Store

log = logging.getLogger(__name__)

BATCH = 200
"""Lines of the built-in narrator between two waits for the disk."""

Job = tuple[SelectionItem, int]
"""An item and the number of its next attempt."""


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
    """Ask a teacher for what is missing, and report on all of its answers.

    Raises:
        UserError: rationales.jsonl is damaged or in use, or the server fails for good.
    """
    items = store.selection("train")
    with Journal(store.folder / "rationales.jsonl") as journal:
        answers = defaultdict(list)
        for rationale in journal.rationales:
            if _signature(rationale) == _signature_of(cfg):
                answers[rationale.item_id].append(rationale)
        # Settled items are left out here, so that none takes a place among the requests in flight.
        jobs = [(i, len(answers[i.item_id])) for i in items if _open(answers[i.item_id], cfg)]
        done = len(items) - len(jobs)
        with tqdm(
            total=len(items), initial=done, desc="narrating", unit="item", mininterval=1.0
        ) as bar:

            def keep(new: list[Rationale]) -> None:
                journal.append(new)
                for rationale in new:
                    answers[rationale.item_id].append(rationale)

            if cfg.url is None:
                too_short = _narrate_all(jobs, store, cfg, keep, bar)
            else:
                too_short = asyncio.run(_ask_all(jobs, store, cfg, keep, bar))
    return _report(items, answers, cfg, too_short)


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


def _version(cfg: TeacherConfig) -> str:
    return NARRATOR_VERSION if cfg.url is None else PROMPT_VERSION


def _settings(cfg: TeacherConfig) -> str:
    shaping = [cfg.min_words, cfg.max_words]
    if cfg.url is not None:
        shaping += [cfg.model, cfg.temperature, cfg.top_p, cfg.top_k, cfg.max_tokens]
    return hashlib.sha256(json.dumps(shaping).encode()).hexdigest()[:8]


def _signature_of(cfg: TeacherConfig) -> tuple[str, str, str, str, int]:
    return (cfg.name, _version(cfg), VALIDATOR_VERSION, _settings(cfg), cfg.seed)


def _signature(r: Rationale) -> tuple[str, str, str, str, int]:
    return (r.teacher, r.prompt_version, r.validator_version, r.settings, r.seed)


def _open(given: list[Rationale], cfg: TeacherConfig) -> bool:
    return len(given) < cfg.attempts and not any(r.accepted for r in given)


def _judged(
    text: str,
    predicates: Predicates,
    item: SelectionItem,
    attempt: int,
    cfg: TeacherConfig,
    cut_off: bool = False,
) -> Rationale:
    verdict = validate(text, predicates, item, cfg)
    return Rationale(
        item_id=item.item_id,
        attempt=attempt,
        accepted=verdict.accepted and not cut_off,
        text=text,
        answer=verdict.answer,
        teacher=cfg.name,
        prompt_version=_version(cfg),
        validator_version=VALIDATOR_VERSION,
        settings=_settings(cfg),
        seed=cfg.seed,
        reasons=("cut off",) if cut_off else verdict.reasons,
        sections=verdict.sections,
    )


def _narrate_all(
    jobs: list[Job],
    store: Store,
    cfg: TeacherConfig,
    keep: Callable[[list[Rationale]], None],
    bar: tqdm,
) -> int:
    """Narrate in item order without a server; gives the count of too short prefixes."""
    too_short, batch = 0, []
    for job in jobs:
        given = _narrate_one(job, store, cfg)
        too_short += not given
        batch += given
        if len(batch) >= BATCH:
            keep(batch)
            batch = []
        bar.update()
    keep(batch)
    return too_short


def _narrate_one(job: Job, store: Store, cfg: TeacherConfig) -> list[Rationale]:
    """An item's answers up to the accepted one or the last attempt; none for a short prefix."""
    item, first = job
    predicates = predicates_of(item, store.scene(item.scene_id), store.scene)
    given: list[Rationale] = []
    if predicates is None:
        return given
    for attempt in range(first, cfg.attempts):
        text = narrate(predicates, item, cfg.seed, attempt)
        given.append(_judged(text, predicates, item, attempt, cfg))
        if given[-1].accepted:
            break
    return given


async def _ask_all(
    jobs: list[Job],
    store: Store,
    cfg: TeacherConfig,
    keep: Callable[[list[Rationale]], None],
    bar: tqdm,
) -> int:
    """Keep `cfg.concurrency` requests in flight; gives the count of too short prefixes."""
    from teacher.server import Server

    server, waiting, too_short = Server(cfg), iter(jobs), 0

    async def ask_in_turn() -> None:
        nonlocal too_short
        for item, first in waiting:
            predicates = predicates_of(item, store.scene(item.scene_id), store.scene)
            too_short += predicates is None
            for attempt in range(first, cfg.attempts if predicates else first):
                reply = await server.ask(messages(predicates, item, cfg))
                answer = _judged(reply.text, predicates, item, attempt, cfg, reply.cut_off)
                keep([answer])
                if answer.accepted:
                    break
            bar.update()

    if jobs:
        await server.wait()
    tasks = [asyncio.create_task(ask_in_turn()) for _ in range(min(cfg.concurrency, len(jobs)))]
    try:
        await asyncio.gather(*tasks)
    finally:
        for task in tasks:
            task.cancel()
        await asyncio.gather(*tasks, return_exceptions=True)
    return too_short


if __name__ == "__main__":
    main()
