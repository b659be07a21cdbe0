"""Narration by a model on servers."""

from __future__ import annotations

import asyncio
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from typing import TYPE_CHECKING

from conf.schema import TeacherConfig
from data.records import Rationale, SelectionItem
from teacher.grammar import build_grammar
from teacher.predicates import Predicates, extract_predicates
from teacher.progress import Progress
from teacher.prompts import build_messages
from teacher.servers.concurrency import run_limited
from teacher.servers.pool import NoResponseError, ServerPool
from teacher.servers.responses import Response
from teacher.servers.server import RequestFields
from teacher.validation.grader import RationaleGrader

if TYPE_CHECKING:
    from data.store import Store

Job = tuple[SelectionItem, int]
"""An item and the number of its next attempt."""
SaveResponses = Callable[[list[Rationale]], None]


class ServerNarrator:
    """Requests rationales until every item has one or is set aside; `save` writes responses."""

    def __init__(
        self,
        store: Store,
        cfg: TeacherConfig,
        grader: RationaleGrader,
        save: SaveResponses,
        progress: Progress,
    ) -> None:
        self.store, self.cfg, self.grader = store, cfg, grader
        self.save, self.progress = save, progress
        self.too_short = 0

    async def run(self, jobs: list[Job]) -> int:
        """Keep `cfg.concurrency` requests in flight; returns the number of too short prefixes."""
        # One thread grades and waits for the disk, so that responses are written one after another
        # while the event loop sends requests.
        with ThreadPoolExecutor(1) as self.writer:
            async with ServerPool(self.cfg, request_fields(self.cfg)) as self.servers:
                await run_limited(jobs, self.cfg.concurrency, self._narrate)
        return self.too_short

    async def _narrate(self, job: Job) -> None:
        item, attempt = job
        predicates = extract_predicates(item, self.store.scene(item.scene_id), self.store.scene)
        if predicates is None:
            self.too_short += 1
        else:
            await self._request(item, predicates, attempt)
        self.progress.finish_item()

    async def _request(self, item: SelectionItem, predicates: Predicates, attempt: int) -> None:
        """Send requests until a response is accepted or no attempt is left."""
        messages = build_messages(predicates, item, self.cfg)
        while attempt < self.cfg.attempts:
            # Most first responses are accepted; only after a rejection several at once pay off.
            n = min(self.cfg.samples, self.cfg.attempts - attempt) if attempt else 1
            try:
                responses = await self.servers.complete(messages, n)
            except NoResponseError as error:
                responses = [Response("", f"unanswered: {error}")]
            rationales = await asyncio.get_running_loop().run_in_executor(
                self.writer, self._grade, responses, predicates, item, attempt
            )
            self.progress.add_responses(rationales)
            if any(r.accepted for r in rationales):
                return
            attempt += len(rationales)

    def _grade(
        self, responses: list[Response], predicates: Predicates, item: SelectionItem, attempt: int
    ) -> list[Rationale]:
        rationales = [
            self.grader.grade(response, predicates, item, attempt + k)
            for k, response in enumerate(responses)
        ]
        self.save(rationales)
        return rationales


def request_fields(cfg: TeacherConfig) -> RequestFields:
    """Fields of every request for a rationale."""
    # No seed: a seed per request crashed vLLM on a CPU with 32 requests in flight.
    extra = {"top_k": cfg.top_k, "chat_template_kwargs": {"enable_thinking": False}}
    if cfg.grammar:
        extra["structured_outputs"] = {"grammar": build_grammar(cfg)}
    return {
        "temperature": cfg.temperature,
        "top_p": cfg.top_p,
        "max_tokens": cfg.max_tokens,
        "extra_body": extra,
    }
