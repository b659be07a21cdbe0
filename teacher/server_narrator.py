"""Requests rationales from a model on servers."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from typing import TYPE_CHECKING

from dynapix.conf.schema import TeacherConfig
from dynapix.data.records import Rationale, SelectionItem
from dynapix.teacher.cited_rationales import (
    CitationError,
    cited_schema,
    compose_rationale,
    list_facts,
)
from dynapix.teacher.predicates.grounding import Grounding
from dynapix.teacher.predicates.vocabulary import choose_vocabulary, describe_item
from dynapix.teacher.prompts import build_messages
from dynapix.teacher.sections import GRAMMAR
from dynapix.teacher.servers.capabilities import RequestFields
from dynapix.teacher.servers.pool import NoResponseError, ServerPool, run_limited
from dynapix.teacher.servers.responses import Response
from dynapix.teacher.validation.grader import RationaleGrader

if TYPE_CHECKING:
    from dynapix.data.store import Store

Job = tuple[SelectionItem, int]
"""An item and the index of its next attempt."""


async def request_rationales(
    jobs: list[Job],
    store: Store,
    grader: RationaleGrader,
    record: Callable[[list[Rationale]], None],
    finish_item: Callable[[], None],
    show: Callable[[str], object],
) -> dict[str, str]:
    """Request rationales until every item has an accepted one or no attempt is left.

    `cfg.concurrency` items are in progress at a time. `record` saves the graded responses to a
    request; `finish_item` is called after the last request for each item, and `show` with a text
    about timeouts.

    Returns:
        Why the servers did not answer the last request for an item, by its id. Such a request is no
        attempt.
    """
    cfg = grader.cfg
    grounding = Grounding(store, cfg)
    unanswered: dict[str, str] = {}

    async def narrate(job: Job) -> None:
        item, attempt = job
        predicates = describe_item(item, store, cfg)
        facts = grounding.describe(item, predicates)
        # There are no predicates if the prefix is too short.
        while predicates and facts and attempt < cfg.attempts:
            # Most first responses are accepted, so several are requested only after a rejection.
            n = min(cfg.samples, cfg.attempts - attempt) if attempt else 1
            try:
                vocabulary = choose_vocabulary(facts, cfg)
                responses = await pool.complete(build_messages(vocabulary, item, cfg), n)
                if cfg.form == "cited":
                    slots = list_facts(vocabulary, item)
                    responses = [fill_slots(r, slots, item.letter) for r in responses]
            except NoResponseError as error:
                unanswered[item.item_id] = str(error)
                break
            rationales = [
                grader.grade(response, predicates, item, attempt + k)
                for k, response in enumerate(responses)
            ]
            record(rationales)
            if any(r.accepted for r in rationales):
                break
            attempt += len(rationales)
        finish_item()

    constraint = GRAMMAR if cfg.grammar else None
    if cfg.form == "cited":
        constraint = cited_schema()
    samples = min(cfg.samples, max(cfg.attempts - 1, 1))
    options = {"constraint": constraint, "samples": samples, "show": show}
    async with ServerPool(cfg, request_fields(cfg), **options) as pool:
        await run_limited(jobs, cfg.concurrency, narrate)
    return unanswered


def fill_slots(response: Response, facts: Mapping[str, str], answer: str) -> Response:
    """Return the response with the text of its cited rationale, or with the reason why it has none
    as its flaw."""
    if response.flaw is not None:
        return response
    try:
        return replace(response, text=compose_rationale(response.text, facts, answer))
    except CitationError as error:
        return replace(response, flaw=f"cited: {error}")


def request_fields(cfg: TeacherConfig) -> RequestFields:
    """Return the fields of every request for a rationale."""
    # There is no seed: with seeds, vLLM on a CPU crashed when 32 requests were in flight.
    extra = {"top_k": cfg.top_k, "chat_template_kwargs": {"enable_thinking": False}}
    return {
        "temperature": cfg.temperature,
        "top_p": cfg.top_p,
        "max_tokens": cfg.max_tokens,
        "extra_body": extra,
    }
