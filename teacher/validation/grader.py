"""Validate the teacher's responses, and record each with its verdict and its settings."""

from __future__ import annotations

import hashlib
import json
from collections import Counter

from conf.schema import TeacherConfig
from data.records import Rationale, SelectionItem
from teacher.narrator import NARRATOR_VERSION
from teacher.predicates import Predicates
from teacher.prompts import PROMPT_VERSION
from teacher.reading.grounding import VERDICTS
from teacher.sections import GRAMMAR_VERSION
from teacher.servers.responses import Response
from teacher.validation.validator import VALIDATOR_VERSION, Verdict, validate_rationale

MAX_CHARACTERS = 20_000
"""Maximum length of a response. A longer one is rejected, and its text is recorded up to here."""


class RationaleGrader:
    """Converts responses to `Rationale` records, for one configuration of the teacher."""

    def __init__(self, cfg: TeacherConfig) -> None:
        self.cfg = cfg
        self.grammar_version = GRAMMAR_VERSION if cfg.grammar else None
        self.origin = {
            "teacher": cfg.name,
            "prompt_version": NARRATOR_VERSION if cfg.url is None else PROMPT_VERSION,
            "validator_version": VALIDATOR_VERSION,
            "settings": self._hash_settings(),
            "seed": cfg.seed,
        }
        """Fields of a record. If one has another value in an earlier record, a new response is
        requested."""

    def grade(
        self, response: Response, predicates: Predicates, item: SelectionItem, attempt: int
    ) -> Rationale:
        """Validate a response, and return its record with the reasons for any rejection."""
        if len(response.text) > MAX_CHARACTERS:
            verdict = Verdict(("too long",))
        elif response.flaw is not None:
            verdict = Verdict((response.flaw,))
        else:
            verdict = validate_rationale(response.text, predicates, item, self.cfg)
        counts = Counter((claim.kind, claim.verdict) for claim in verdict.claims)
        return Rationale(
            item_id=item.item_id,
            attempt=attempt,
            accepted=verdict.accepted,
            text=response.text[:MAX_CHARACTERS],
            answer=verdict.answer,
            reasons=verdict.reasons,
            sections=verdict.sections,
            prompt_tokens=response.prompt_tokens,
            completion_tokens=response.completion_tokens,
            grammar=self.grammar_version,
            finished=response.finished,
            claims={
                kind: [counts[kind, name] for name in VERDICTS]
                for kind in sorted({kind for kind, _ in counts})
            },
            **self.origin,
        )

    def is_current(self, rationale: Rationale) -> bool:
        """Whether a rationale was recorded with the current teacher, versions and settings."""
        return all(getattr(rationale, name) == value for name, value in self.origin.items())

    def _hash_settings(self) -> str:
        """A short hash of the settings that affect a response or its verdict."""
        cfg = self.cfg
        settings = [cfg.min_words, cfg.max_words]
        if cfg.url is not None:
            settings += [cfg.model, cfg.temperature, cfg.top_p, cfg.top_k, cfg.max_tokens]
        if self.grammar_version is not None:
            settings.append(self.grammar_version)
        return hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:8]
