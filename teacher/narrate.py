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
from dataclasses import dataclass, replace
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np
from tqdm import tqdm

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import UserError
from dynapix.conf.schema import NarrateCommand, TeacherConfig
from dynapix.data.records import Rationale, SelectionItem
from dynapix.data.seeded_order import interleave
from dynapix.data.store import JOURNAL, RATIONALES
from dynapix.teacher.journal import Journal, save_accepted
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.grounding import Grounding
from dynapix.teacher.predicates.vocabulary import choose_vocabulary, describe_item, name_vocabulary
from dynapix.teacher.report import (
    Figures,
    describe_sufficiency,
    rejection_reasons,
    select_accepted,
    summarize,
    write_report,
)
from dynapix.teacher.servers.responses import Response
from dynapix.teacher.validation.grader import RationaleGrader

if TYPE_CHECKING:
    from dynapix.data.store import Store

log = logging.getLogger(__name__)

LISTED_REASONS = 3
"""Number of reasons for rejection in the progress bar, which lists the most frequent ones."""


@dataclass(frozen=True)
class Narration:
    """The result of `narrate_store`.

    Attributes:
        rationales: One accepted rationale of each narrated item that has any, in item order.
        responses: All responses to each narrated item, in the order of their attempts.
        figures: Statistics of all responses; see `teacher.report.summarize`.
    """

    rationales: list[Rationale]
    responses: dict[str, list[Rationale]]
    figures: Figures

    def __str__(self) -> str:
        f = self.figures
        fallback = f" ({f['fallback']} by the built-in narrator)" if f["fallback"] else ""
        rejections = ", ".join(f"{n} {kind}" for kind, n in f["rejected"].items())
        unanswered = f"{f['unanswered']} items without a response, " if f["unanswered"] else ""
        return (
            f"rationales: {f['accepted']} accepted{fallback}, {unanswered}"
            f"{f['set_aside']} items set aside, {f['too_short']} items with too short a prefix; "
            f"rejections: {rejections or 'none'}; {describe_sufficiency(f)}"
        )


@command("teacher.narrate", NarrateCommand)
def main(cfg: NarrateCommand, run: Run) -> dict[str, float]:
    from dynapix.data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)
    narration = narrate_store(store, cfg.teacher, cfg.limit)
    log.info(narration)
    figures = narration.figures
    page = write_report(store, narration.responses, figures, cfg.examples, cfg.teacher, run.folder)
    log.info("report: %s", page)
    metrics = {
        "accepted": float(figures["accepted"]),
        "responses": float(sum(figures["responses"])),
        "set_aside": float(figures["set_aside"]),
        "too_short": float(figures["too_short"]),
        "mean_words": float(np.mean(figures["lengths"] or [0])),
    }
    if "all" in figures["sufficiency"]:
        metrics["sufficiency"] = figures["sufficiency"]["all"][0]
    return metrics


def ensure_rationales(store: Store, cfg: TeacherConfig) -> list[Rationale]:
    """Write the missing rationales, and return the accepted ones in the order of their items.

    Raises:
        UserError: See `narrate_store`.
    """
    narration = narrate_store(store, cfg)
    log.info(narration)
    return narration.rationales


def narrate_store(store: Store, cfg: TeacherConfig, limit: int | None = None) -> Narration:
    """Write the missing rationales of training items to rationales.jsonl, and the accepted ones to
    rationales.parquet too if their facts are those of the oracle (`teacher.grounding`).

    Args:
        limit: Number of items to narrate, a random sample; None narrates all.

    Raises:
        UserError: rationales.jsonl is damaged or belongs to another benchmark, or the servers
            cannot be used.
    """
    every = store.training_items()
    items = sample_items(every, limit, cfg.seed)
    sample = None
    if len(items) < len(every):
        sample = f"{len(items)} of {len(every)} items, seed {cfg.seed}"
        log.info("narrating a sample: %s", sample)
    unanswered: dict[str, str] = {}
    grader, grounding = RationaleGrader(cfg), Grounding(store, cfg)
    with Journal(store.folder / JOURNAL) as journal:
        check_items(journal, every)
        report_other_vocabularies(journal, cfg)
        if cfg.grounding != "oracle":
            log.info(
                "teacher.grounding=%s: the facts of the rationales are not validated against the "
                "simulator's record",
                cfg.grounding,
            )
        responses = usable_responses(journal, grader)

        def is_settled(item: SelectionItem) -> bool:
            return any(r.accepted for r in responses[item.item_id])

        # Finished items are left out, so that every concurrent job has a request to send.
        jobs = [
            (item, attempts)
            for item in items
            if (attempts := len(responses[item.item_id])) < cfg.attempts and not is_settled(item)
        ]
        progress = Progress(len(items), len(items) - len(jobs), sum(map(is_settled, items)))

        def record(new: list[Rationale]) -> None:
            new = [replace(rationale, sample=sample) for rationale in new]
            journal.append(new)
            for rationale in new:
                responses[rationale.item_id].append(rationale)
            progress.add_responses(new)

        with progress.bar:
            if cfg.url is None:
                for item, attempt in jobs:
                    record(_write_rationales(item, store, grader, grounding, attempt))
                    progress.bar.update()
            elif jobs:
                from dynapix.teacher.server_narrator import request_rationales

                options = jobs, store, grader, record, progress.bar.update, progress.show_servers
                unanswered = asyncio.run(request_rationales(*options))
        if cfg.fallback:
            for item in items:
                if not is_settled(item) and len(responses[item.item_id]) >= cfg.attempts:
                    *_, last = _write_rationales(item, store, grader, grounding)
                    if last.accepted:
                        attempt = cfg.attempts + last.attempt
                        record([grader.mark_fallback(last, attempt)])
        # Readers of this table expect true facts.
        if cfg.grounding == "oracle":
            save_accepted(select_accepted(every, responses), store.folder / RATIONALES)
    if unanswered:
        name, reason = next(iter(unanswered.items()))
        log.warning(
            "%d items got no response, which spends no attempt: correct the cause and run the same "
            "command again. The server's answer for %s: %s",
            *(len(unanswered), name, reason),
        )
    narrated = {item.item_id: responses[item.item_id] for item in items}
    figures = summarize(items, narrated, unanswered, sample)
    return Narration(select_accepted(items, responses), narrated, figures)


def sample_items(items: list[SelectionItem], limit: int | None, seed: int) -> list[SelectionItem]:
    """Return a random sample of `limit` items in their order, spread evenly over the families; all
    items if `limit` is None. A smaller sample with the same seed is a part of it."""
    order = np.random.default_rng(seed).permutation(len(items))
    shuffled = interleave((items[k] for k in order), lambda item: item.family)
    chosen = {item.item_id for item in shuffled[:limit]}
    return [item for item in items if item.item_id in chosen]


class Progress:
    """A progress bar with the numbers of accepted and rejected responses, and tokens per second."""

    def __init__(self, total: int, done: int, accepted: int) -> None:
        self.bar = tqdm(total=total, initial=done, desc="narrating", unit="item", mininterval=1.0)
        self.accepted, self.tokens = accepted, 0
        self.rejected: Counter[str] = Counter()
        self.servers = ""
        self.started = time.monotonic()

    def add_responses(self, responses: list[Rationale]) -> None:
        self.accepted += sum(r.accepted for r in responses)
        self.tokens += sum(r.completion_tokens or 0 for r in responses)
        self.rejected.update(kind for r in responses for kind in rejection_reasons(r))
        self._show()

    def show_servers(self, state: str) -> None:
        """Show a text about the servers, such as the number of timeouts, at once."""
        self.servers = state
        self._show()
        self.bar.refresh()

    def _show(self) -> None:
        words = [f"{self.accepted} accepted"]
        words += [f"{n} {kind}" for kind, n in self.rejected.most_common(LISTED_REASONS)]
        if self.tokens:
            words.append(f"{self.tokens / (time.monotonic() - self.started):,.0f} tokens/s")
        self.bar.set_postfix_str(", ".join(filter(None, [*words, self.servers])), refresh=False)


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


def usable_responses(journal: Journal, grader: RationaleGrader) -> dict[str, list[Rationale]]:
    """Return the responses of a journal that need not be requested again, by item id. They follow
    the settings of the grader, such as the vocabulary."""
    cfg, responses = grader.cfg, defaultdict(list)
    for rationale in journal.rationales:
        if grader.is_current(rationale) and (cfg.fallback or not rationale.fallback):
            responses[rationale.item_id].append(rationale)
    for records in responses.values():
        own = [r for r in records if not r.fallback]
        if len(own) < cfg.attempts:
            # The server has attempts left, for example because its responses are out of date.
            records[:] = own
    return responses


def _write_rationales(
    item: SelectionItem,
    store: Store,
    grader: RationaleGrader,
    grounding: Grounding,
    first: int = 0,
) -> list[Rationale]:
    """Write rationales of an item with the built-in narrator, from attempt `first` until one is
    accepted or no attempt is left. An item whose prefix is too short gets none."""
    predicates = describe_item(item, store, grader.cfg)
    facts = grounding.describe(item, predicates)
    if predicates is None or facts is None:
        return []
    vocabulary = choose_vocabulary(facts, grader.cfg)
    rationales: list[Rationale] = []
    for attempt in range(first, grader.cfg.attempts):
        text = write_rationale(vocabulary, item, grader.cfg.seed, attempt)
        rationales.append(grader.grade(Response(text), predicates, item, attempt))
        if rationales[-1].accepted:
            break
    return rationales


if __name__ == "__main__":
    main()
