"""Validate the teacher's responses, and record each with its result and its settings."""

from __future__ import annotations

import hashlib
import json
from collections import Counter
from dataclasses import replace

from dynapix.conf.schema import TeacherConfig
from dynapix.data.records import Rationale, SelectionItem
from dynapix.teacher.cited_rationales import CITED_VERSION
from dynapix.teacher.narrator import NARRATOR_VERSION
from dynapix.teacher.predicates.facts import RelationalPredicates
from dynapix.teacher.predicates.relations import BOUNDS
from dynapix.teacher.predicates.statement_choice import choose_statements
from dynapix.teacher.predicates.vocabulary import choose_vocabulary, name_vocabulary
from dynapix.teacher.prompts import PROMPT_VERSION
from dynapix.teacher.reading.claims import VERDICTS
from dynapix.teacher.sections import GRAMMAR_VERSION
from dynapix.teacher.servers.responses import Response
from dynapix.teacher.validation.sufficiency import measure_sufficiency
from dynapix.teacher.validation.validator import VALIDATOR_VERSION, Validation, validate_rationale

MAX_CHARACTERS = 20_000
"""Maximum length of a response. A longer one is rejected, and the record has its beginning only."""
NARRATOR_ORIGIN = {"prompt_version": NARRATOR_VERSION}
"""Fields of records of texts by the built-in narrator."""


class RationaleGrader:
    """Validates responses and converts them to `Rationale` records, for given settings."""

    def __init__(self, cfg: TeacherConfig) -> None:
        self.cfg = cfg
        self.constraint = GRAMMAR_VERSION if cfg.grammar else None
        if cfg.form == "cited":
            self.constraint = f"cited {CITED_VERSION}"
        self.origin = {
            "teacher": cfg.name,
            "prompt_version": PROMPT_VERSION,
            "validator_version": VALIDATOR_VERSION,
            "settings": self._hash_settings(),
            "seed": cfg.seed,
            "predicates": name_vocabulary(cfg),
        }
        """Fields that every new record of the teacher has; those of a fallback differ by
        `NARRATOR_ORIGIN`. An earlier record with another value in one of them is ignored, and a new
        response is requested."""
        if cfg.url is None:
            self.origin |= NARRATOR_ORIGIN

    def grade(
        self,
        response: Response,
        predicates: RelationalPredicates,
        item: SelectionItem,
        attempt: int,
    ) -> Rationale:
        """Validate a response, and return its record; it has the reasons if it is rejected.

        Args:
            predicates: All predicates of the item. The response is validated with those of
                `cfg.predicates`, and its sufficiency is measured with all.
        """
        if len(response.text) > MAX_CHARACTERS:
            result = Validation(("too long",))
        elif response.flaw is not None:
            result = Validation((response.flaw,))
        else:
            vocabulary = choose_vocabulary(predicates, self.cfg)
            result = validate_rationale(response.text, vocabulary, item, self.cfg)
        undecided = bool(choose_statements(predicates).rivals)
        sufficiency = None
        if result.sections:
            sufficiency = measure_sufficiency(response.text, result.claims, predicates)
            if self.cfg.sufficient and sufficiency < 1:
                result = result.rejected("undecided" if undecided else "insufficient")
        counts = Counter((claim.kind, claim.verdict) for claim in result.claims)
        return Rationale(
            item_id=item.item_id,
            attempt=attempt,
            accepted=result.accepted,
            text=response.text[:MAX_CHARACTERS],
            answer=result.answer,
            reasons=result.reasons,
            sections=result.sections,
            prompt_tokens=response.prompt_tokens,
            completion_tokens=response.completion_tokens,
            grammar=self.constraint if response.constrained else None,
            finished=response.finished,
            claims={
                kind: [counts[kind, name] for name in VERDICTS]
                for kind in sorted({kind for kind, _ in counts})
            },
            sufficiency=sufficiency,
            undecided=undecided,
            **self.origin,
        )

    def is_current(self, rationale: Rationale) -> bool:
        """Return whether a rationale was recorded with the current versions, settings and seed."""
        origin = {**self.origin, **NARRATOR_ORIGIN} if rationale.fallback else self.origin
        return all(getattr(rationale, name) == value for name, value in origin.items())

    def mark_fallback(self, rationale: Rationale, attempt: int) -> Rationale:
        """Return the record of a rationale that the built-in narrator wrote instead of a server."""
        return replace(rationale, fallback=True, attempt=attempt, grammar=None, **NARRATOR_ORIGIN)

    def _hash_settings(self) -> str:
        """Return a short hash of the settings that affect a response or its validation."""
        cfg = self.cfg
        settings = [cfg.min_words, cfg.max_words]
        if cfg.predicates == "relational" or cfg.sufficient:
            settings += [cfg.sufficient, *BOUNDS]
        if not cfg.strict:
            settings.append("lenient")
        if cfg.url is not None:
            settings += [cfg.model, cfg.temperature, cfg.top_p, cfg.top_k, cfg.max_tokens]
        if cfg.grammar:
            settings.append(GRAMMAR_VERSION)
        if cfg.form == "cited":
            settings += ["cited", CITED_VERSION]
        return hashlib.sha256(json.dumps(settings).encode()).hexdigest()[:8]
