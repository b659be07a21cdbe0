"""What becomes of an answer: validated, and stamped with everything that shaped it."""

from __future__ import annotations

import hashlib
import json
from collections.abc import Iterable

from conf.schema import TeacherConfig
from data.records import Rationale, SelectionItem
from teacher.narrator import NARRATOR_VERSION
from teacher.predicates import Predicates
from teacher.prompts import PROMPT_VERSION
from teacher.reading.grounding import VERDICTS, Claim
from teacher.servers.responses import Response
from teacher.validation.validator import VALIDATOR_VERSION, validate_rationale

LONGEST = 20_000
"""Characters of an answer that are read and kept; no rationale has as many."""

Signature = tuple[str, str, str, str, int]


class RationaleGrader:
    """Judges answers under one configuration."""

    def __init__(self, cfg: TeacherConfig) -> None:
        self.cfg = cfg
        self.grammar = _grammar_version() if cfg.grammar else None
        self.version = NARRATOR_VERSION if cfg.url is None else PROMPT_VERSION
        self.settings = self._settings()

    @property
    def signature(self) -> Signature:
        """What two answers that may stand for one another have in common."""
        return (self.cfg.name, self.version, VALIDATOR_VERSION, self.settings, self.cfg.seed)

    def judge(
        self, reply: Response, predicates: Predicates, item: SelectionItem, attempt: int
    ) -> Rationale:
        reasons, sections, answer, claims = (reply.flaw,), {}, None, ()
        if len(reply.text) > LONGEST:
            reasons = ("too long",)
        elif reply.flaw is None:
            verdict = validate_rationale(reply.text, predicates, item, self.cfg)
            reasons, sections, answer = verdict.reasons, verdict.sections, verdict.answer
            claims = verdict.claims
        return Rationale(
            item_id=item.item_id,
            attempt=attempt,
            accepted=not reasons,
            text=reply.text[:LONGEST],
            answer=answer,
            teacher=self.cfg.name,
            prompt_version=self.version,
            validator_version=VALIDATOR_VERSION,
            settings=self.settings,
            seed=self.cfg.seed,
            reasons=reasons,
            sections=sections,
            prompt_tokens=reply.prompt_tokens,
            completion_tokens=reply.completion_tokens,
            grammar=self.grammar,
            finished=reply.finished,
            claims=tally(claims),
        )

    def _settings(self) -> str:
        cfg = self.cfg
        shaping = [cfg.min_words, cfg.max_words]
        if cfg.url is not None:
            shaping += [cfg.model, cfg.temperature, cfg.top_p, cfg.top_k, cfg.max_tokens]
        if self.grammar is not None:
            shaping.append(self.grammar)
        return hashlib.sha256(json.dumps(shaping).encode()).hexdigest()[:8]


def tally(claims: Iterable[Claim]) -> dict[str, list[int]]:
    """How many claims are supported, contradicted and unknown, by kind."""
    counts: dict[str, list[int]] = {}
    for claim in claims:
        counts.setdefault(claim.kind, [0] * len(VERDICTS))[VERDICTS.index(claim.verdict)] += 1
    return dict(sorted(counts.items()))


def signature(r: Rationale) -> Signature:
    return (r.teacher, r.prompt_version, r.validator_version, r.settings, r.seed)


def _grammar_version() -> str:
    from teacher.grammar import GRAMMAR_VERSION

    return GRAMMAR_VERSION
