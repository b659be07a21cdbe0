"""The built-in narrator: writes rationales from predicates with templates, without a model.

Each statement has a few phrasings (templates/phrases.yaml). Their vocabulary is small, so that a
small student can learn it.
"""

from __future__ import annotations

from typing import Any

from dynapix.conf.schema.servers import NARRATOR_WORDS
from dynapix.data.records import SelectionItem
from dynapix.teacher.predicates.facts import Predicates, RelationalPredicates
from dynapix.teacher.predicates.statement_choice import Decision, choose_statements
from dynapix.teacher.writers.paper import Detail, Writer, join_sentences
from dynapix.teacher.writers.relational import RelationalWriter

NARRATOR_VERSION = "16"
SHORT, LONG, RELATIONAL_LONG = 110, NARRATOR_WORDS[1], 235
"""A rationale with more than LONG words, or RELATIONAL_LONG in the relational vocabulary, is
written again with less detail, one of fewer than SHORT words with more. RELATIONAL_LONG keeps
relational rationales shorter on average than those of the paper's vocabulary. SHORT is well above
the minimum, 80 words (paper, Rationale construction)."""
BRIEF, SPARSE, FULL = Detail(3, 1, 1, 1), Detail(4, 1, 2, 1), Detail(6, 4, 6, 2)
RELATIONAL_SPARSE, RELATIONAL_BRIEF = Detail(3, 2, 1, 1), Detail(1, 1, 0, 1, 0)
RELATIONAL_BRIEFEST = tuple(RELATIONAL_BRIEF._replace(compared=k) for k in (1, 0))
"""Relational rationales state fewer facts besides those that decide the item. The briefest ones
state less of each candidate."""


def write_rationale(
    predicates: Predicates, item: SelectionItem, seed: int, attempt: int = 0
) -> str:
    """Return a rationale of 80 to 250 words.

    The same arguments give the same text. Another `attempt` chooses other phrasings.
    """
    keys = (seed, item.item_id, attempt)
    decision = _decide(predicates)
    details, longest = (SPARSE, BRIEF), LONG
    if decision is not None:
        details = RELATIONAL_SPARSE, RELATIONAL_BRIEF, *RELATIONAL_BRIEFEST
        longest = RELATIONAL_LONG
    for detail in details:
        text = _make_writer(predicates, decision, detail, *keys).text()
        if len(text.split()) <= longest:
            break
    if len(text.split()) < SHORT:
        text = _make_writer(predicates, decision, FULL, *keys, padded=True).text()
    return text


def list_clauses(predicates: Predicates, item: SelectionItem) -> dict[str, list[str]]:
    """Return the clauses from which a rationale can be made, by section, in full detail."""
    writer = _make_writer(predicates, _decide(predicates), FULL, item.item_id, "clauses")
    return writer.sections()


def write_facts(predicates: Predicates, item: SelectionItem) -> str:
    """Return all clauses of `list_clauses` as sentences, in the form of a rationale."""
    sections = list_clauses(predicates, item)
    return "\n".join(f"{name}: {join_sentences(parts)}" for name, parts in sections.items())


def write_match_lines(predicates: Predicates, item: SelectionItem) -> tuple[str, ...]:
    """Return a line for each candidate: whether it matches the prediction and, in the paper's
    vocabulary, why not.

    The same arguments give the same lines.
    """
    writer = _make_writer(predicates, _decide(predicates), SPARSE, item.item_id, "matches")
    return tuple(writer.match(c) for c in predicates.candidates)


def _decide(predicates: Predicates) -> Decision | None:
    """Return the statements on which all relational texts of an item rest; None for the paper's
    vocabulary."""
    return choose_statements(predicates) if isinstance(predicates, RelationalPredicates) else None


def _make_writer(
    predicates: Predicates, decision: Decision | None, *args: Any, padded: bool = False
) -> Writer:
    """Return a writer for the vocabulary of predicates."""
    if decision is not None:
        return RelationalWriter(predicates, decision, *args, padded=padded)
    return Writer(predicates, *args, padded=padded)
