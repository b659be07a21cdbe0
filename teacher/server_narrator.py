"""Requests rationales from a model on servers."""

from __future__ import annotations

from collections.abc import Callable
from typing import TYPE_CHECKING

from conf.schema import TeacherConfig
from data.records import Rationale, SelectionItem
from teacher.prompts import build_messages
from teacher.sections import GRAMMAR
from teacher.servers.pool import NoResponseError, ServerPool, run_limited
from teacher.servers.responses import Response
from teacher.servers.server import RequestFields
from teacher.validation.grader import RationaleGrader
from teacher.vocabulary import choose_vocabulary, describe_item

if TYPE_CHECKING:
    from data.store import Store

Job = tuple[SelectionItem, int]
"""An item and the index of its next attempt."""


async def request_rationales(
    jobs: list[Job],
    store: Store,
    grader: RationaleGrader,
    record: Callable[[list[Rationale]], None],
    finish_item: Callable[[], None],
) -> None:
    """Request rationales until every item has an accepted one or no attempt is left.

    `cfg.concurrency` items are in progress at a time. `record` saves the graded responses to a
    request; `finish_item` is called after the last request for each item.
    """
    cfg = grader.cfg

    async def narrate(job: Job) -> None:
        item, attempt = job
        predicates = describe_item(item, store, cfg)
        # There are no predicates if the prefix is too short.
        while predicates and attempt < cfg.attempts:
            # Most first responses are accepted, so several are requested only after a rejection.
            n = min(cfg.samples, cfg.attempts - attempt) if attempt else 1
            try:
                messages = build_messages(choose_vocabulary(predicates, cfg), item, cfg)
                responses = await pool.complete(messages, n)
            except NoResponseError as error:
                responses = [Response("", f"unanswered: {error}")]
            rationales = [
                grader.grade(response, predicates, item, attempt + k)
                for k, response in enumerate(responses)
            ]
            record(rationales)
            if any(r.accepted for r in rationales):
                break
            attempt += len(rationales)
        finish_item()

    async with ServerPool(cfg, request_fields(cfg)) as pool:
        await run_limited(jobs, cfg.concurrency, narrate)


def request_fields(cfg: TeacherConfig) -> RequestFields:
    """Return the fields of every request for a rationale."""
    # There is no seed: with seeds, vLLM on a CPU crashed when 32 requests were in flight.
    extra = {"top_k": cfg.top_k, "chat_template_kwargs": {"enable_thinking": False}}
    if cfg.grammar:
        extra["structured_outputs"] = {"grammar": GRAMMAR}
    return {
        "temperature": cfg.temperature,
        "top_p": cfg.top_p,
        "max_tokens": cfg.max_tokens,
        "extra_body": extra,
    }
