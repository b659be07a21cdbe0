"""Prompts for a teacher on a server.

The instructions come first and are the same for every item, so that the server can cache them.
"""

from __future__ import annotations

import hashlib
import json
from collections.abc import Sequence
from dataclasses import asdict
from importlib.resources import files
from typing import Any

from dynapix.conf.schema import TeacherConfig
from dynapix.data.records import SelectionItem
from dynapix.teacher.cited_rationales import CONNECTIVES, list_facts
from dynapix.teacher.predicates.facts import Predicates, Relation, RelationalPredicates
from dynapix.teacher.predicates.relations import find_topic
from dynapix.teacher.predicates.statement_choice import choose_statements
from dynapix.teacher.sections import SECTIONS

TEMPLATES = files("dynapix.teacher") / "templates"
SYSTEM = (TEMPLATES / "system_prompt.txt").read_text().rstrip()
CITED = (TEMPLATES / "cited_prompt.txt").read_text().rstrip()
RELATIONAL = (TEMPLATES / "relational_prompt.txt").read_text().rstrip() + "\n"
"""The part of the instructions that explains relational predicates."""
_TEXTS = "\0".join([SYSTEM, CITED, RELATIONAL])
PROMPT_VERSION = f"3-{hashlib.sha256(_TEXTS.encode()).hexdigest()[:8]}"
"""Version of the prompts: a number, which changes with the code of this module, and a hash of the
templates. Responses to prompts of another version are not reused."""


def build_messages(
    predicates: Predicates, item: SelectionItem, cfg: TeacherConfig
) -> list[dict[str, str]]:
    """Return the chat messages that request an item's rationale."""
    if cfg.form == "cited":
        system = CITED
        clauses = list_facts(predicates, item).items()
        facts = "\n" + "\n".join(f"{key}: {clause}" for key, clause in clauses)
    else:
        system = SYSTEM
        facts = " " + json.dumps(format_facts(predicates), separators=(",", ":"))
    system = system.format(
        sections=", ".join(SECTIONS),
        low=cfg.min_words,
        high=cfg.max_words,
        relations=RELATIONAL if isinstance(predicates, RelationalPredicates) else "",
        connectives=", ".join(sorted(CONNECTIVES)),
    )
    user = f"Question: {item.question}\nFacts:{facts}\nAnswer to reach: {item.letter}"
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]


def format_facts(predicates: Predicates) -> dict[str, Any]:
    """Return predicates as a teacher on a server reads them.

    Of relational predicates, they have the statements that decide the item, with their values now
    and in each candidate, and the other relations at the target between the same objects.
    """
    is_relational = isinstance(predicates, RelationalPredicates)
    facts = asdict(predicates.without_relations() if is_relational else predicates)
    if not facts.pop("records_contacts"):
        # Empty lists would say that there are none.
        for unknown in ("courses", "contacts", "close"):
            del facts[unknown]
    if heavier := facts.pop("heavier"):
        facts["weights"] = [f"{one}: heavier than {other}" for one, other in heavier]
    if not is_relational:
        return facts
    decision = choose_statements(predicates)
    named = {name for statement in decision.statements for name in statement.objects}
    facts["deciding"] = [
        {
            "statement": format_statement(statement),
            "now": _format_topic(statement, predicates.observed),
            "candidates": {
                view.letter: statement in view.statements
                or _format_topic(statement, view.relations)
                or False
                for view in predicates.views
            },
        }
        for statement in decision.statements
    ]
    facts["relations"] = [
        format_statement(relation)
        for relation in predicates.target.relations
        if set(relation.objects) <= named
    ]
    return facts


def format_statement(statement: Relation) -> str:
    """Return a statement in words, such as "red metal cube: left of blue rubber sphere"."""
    subject, *others = statement.objects
    joint = {"nearer to": " than to ", "as near to": " as to "}.get(statement.value, " and ")
    return f"{subject}: {' '.join(filter(None, (statement.value, joint.join(others))))}"


def _format_topic(statement: Relation, relations: Sequence[Relation]) -> str | None:
    found = find_topic(statement, relations)
    return None if found is None else format_statement(found)
