"""Keeps a teacher's servers full until every item has a rationale or is set aside."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from conf.schema import TeacherConfig
from data.records import Rationale, SelectionItem
from teacher.predicates import Predicates, extract_predicates
from teacher.progress import Progress
from teacher.prompts import messages
from teacher.servers.concurrency import run_limited
from teacher.servers.pool import NoResponseError, ServerPool
from teacher.servers.responses import Response
from teacher.servers.server import RequestFields
from teacher.validation.grader import RationaleGrader

if TYPE_CHECKING:
    from data.store import Store

Job = tuple[SelectionItem, int]
"""An item and the number of its next attempt."""
Keep = Callable[[list[Rationale]], None]


class ServerNarrator:
    """One run over items: `jobs` are those that are open, `keep` puts answers on the disk."""

    def __init__(
        self,
        store: Store,
        cfg: TeacherConfig,
        judge: RationaleGrader,
        keep: Keep,
        progress: Progress,
    ) -> None:
        self.store, self.cfg, self.judge = store, cfg, judge
        self.keep, self.progress = keep, progress
        self.too_short = 0

    async def run(self, jobs: list[Job]) -> int:
        """Keep `cfg.concurrency` requests in flight; gives the count of too short prefixes."""
        # One thread judges and waits for the disk, so that answers are written one after another
        # while the loop goes on asking.
        with ThreadPoolExecutor(1) as self.desk:
            async with ServerPool(self.cfg, request_fields(self.cfg)) as self.client:
                await run_limited(jobs, self.cfg.concurrency, self._ask)
        return self.too_short

    async def _ask(self, job: Job) -> None:
        item, first = job
        predicates = extract_predicates(item, self.store.scene(item.scene_id), self.store.scene)
        if predicates is None:
            self.too_short += 1
        else:
            await self._settle(item, predicates, first)
        self.progress.settle()

    async def _settle(self, item: SelectionItem, predicates: Predicates, attempt: int) -> None:
        """Ask for an item until an answer is accepted or no attempt is left."""
        chat = messages(predicates, item, self.cfg)
        while attempt < self.cfg.attempts:
            # Most items are accepted at once: more than one answer is worth it after a failure.
            n = min(self.cfg.samples, self.cfg.attempts - attempt) if attempt else 1
            try:
                replies = await self.client.complete(chat, n)
            except NoResponseError as fault:
                replies = [Response("", f"unanswered: {fault}")]
            answers = await asyncio.get_running_loop().run_in_executor(
                self.desk, self._take, replies, predicates, item, attempt
            )
            self.progress.add(answers)
            if any(r.accepted for r in answers):
                return
            attempt += len(answers)

    def _take(
        self, replies: list[Response], predicates: Predicates, item: SelectionItem, attempt: int
    ) -> list[Rationale]:
        answers = [
            self.judge.judge(reply, predicates, item, attempt + k)
            for k, reply in enumerate(replies)
        ]
        self.keep(answers)
        return answers


def request_fields(cfg: TeacherConfig) -> RequestFields:
    """What goes with every chat with a teacher."""
    # No seed: one a request crashed vLLM on a CPU at 32 in flight.
    extra = {"top_k": cfg.top_k, "chat_template_kwargs": {"enable_thinking": False}}
    if cfg.grammar:
        from teacher.grammar import grammar

        extra["structured_outputs"] = {"grammar": grammar(cfg)}
    return {
        "temperature": cfg.temperature,
        "top_p": cfg.top_p,
        "max_tokens": cfg.max_tokens,
        "extra_body": extra,
    }
