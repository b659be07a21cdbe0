"""Cited rationales: sentences of a server's teacher with slots that code fills with facts.

The teacher gets the facts as clauses with ids, such as `s1`: "the red metal cube rests near the
left". It returns JSON: for each section, sentences such as

    {"text": "Since {}, it is clear that {}", "facts": ["s1", "s3"]}

Code fills the slots in order, so that the stated facts hold by construction. Around the slots, only
a few connecting words are allowed (`CONNECTIVES`), so that a sentence states nothing else.
"""

from __future__ import annotations

import json
import re
from collections.abc import Mapping
from typing import Any

from jsonschema import Draft202012Validator

from dynapix.data.records import LETTERS, SelectionItem
from dynapix.teacher.narrator import list_clauses
from dynapix.teacher.predicates.facts import Predicates
from dynapix.teacher.sections import SECTIONS

CITED_VERSION = "4"
"""Changes with the form of cited rationales and the rules for the words around slots."""
SLOT = "{}"
ANALYSIS = "Candidate analysis"
PREFIXES = {"Scene parse": "s", "Motion analysis": "m", "Prediction": "p", "Outcome": "r"}
"""First letter of the ids of the facts of each section; the id of a candidate's fact is its letter,
in the candidate analysis."""
MAX_SENTENCES, MAX_FACTS, MAX_CHARACTERS = 8, 3, 40
"""Maximum numbers of sentences in a section, of facts in a sentence, and of the characters before,
between and after its slots."""
LITERAL = f"[^{{}}]{{0,{MAX_CHARACTERS}}}"
TEXT = rf"^{LITERAL}(\{{\}}{LITERAL}){{1,{MAX_FACTS}}}$"
"""Pattern of a sentence with at least one slot. It also limits the length: servers that constrain
decoding by a pattern may ignore `maxLength`."""
CONNECTIVES = {
    *("and", "so", "because", "since", "as", "while", "whereas", "when", "then", "thus", "hence"),
    *("therefore", "thereby", "accordingly", "consequently", "also", "moreover", "furthermore"),
    *("finally", "next", "now", "meanwhile", "here", "indeed", "likewise", "similarly"),
    *("it", "its", "the", "this", "that", "these", "those", "they", "their", "which", "what", "we"),
    *("is", "are", "be", "means", "follows", "implies", "suggests", "indicates", "explains"),
    *("know", "known", "given", "clear", "clearly", "evident", "evidently"),
    *("result", "reason", "consequence", "conclusion", "fact", "facts", "evidence", "case"),
    *("to", "for", "from", "of", "in", "by", "turn", "way"),
}
"""The words that may stand around slots. None of them states a fact or denies one."""


class CitationError(ValueError):
    """A response does not have the form of a cited rationale; the message is the reason."""


def cited_schema() -> dict[str, Any]:
    """Return the JSON schema of a cited rationale. It is the same for every item, so that a server
    compiles it once."""

    def sentence(pattern: str) -> dict[str, Any]:
        fact = {"type": "string", "pattern": f"^{pattern}$"}
        facts = {"type": "array", "items": fact, "minItems": 1, "maxItems": MAX_FACTS}
        text = {"type": "string", "pattern": TEXT}
        return _object({"text": text, "facts": facts})

    def sentences(pattern: str, least: int = 1, most: int = MAX_SENTENCES) -> dict[str, Any]:
        return {
            "type": "array", "items": sentence(pattern), "minItems": least, "maxItems": most
        }  # fmt: skip

    sections = {
        name: sentences(f"{PREFIXES[name]}[1-9][0-9]?")
        if name != ANALYSIS
        else sentences(f"[{LETTERS}]", len(LETTERS), len(LETTERS))
        for name in SECTIONS
    }
    return _object(sections)


def _object(properties: dict[str, Any]) -> dict[str, Any]:
    return {
        "type": "object", "properties": properties, "required": [*properties],
        "additionalProperties": False,
    }  # fmt: skip


def list_facts(predicates: Predicates, item: SelectionItem) -> dict[str, str]:
    """Return the facts of an item as clauses, by id."""
    facts: dict[str, str] = {}
    for name, clauses in list_clauses(predicates, item).items():
        if name == ANALYSIS:
            facts |= dict(zip(LETTERS, clauses, strict=True))
        else:
            facts |= {f"{PREFIXES[name]}{k}": clause for k, clause in enumerate(clauses, 1)}
    return facts


def compose_rationale(response: str, facts: Mapping[str, str], answer: str) -> str:
    """Return the text of a cited rationale, with its slots filled.

    Raises:
        CitationError: The response does not follow the schema, cites an unknown fact, has another
            number of slots than of facts, or has other words than `CONNECTIVES` around its slots.
    """
    try:
        cited = json.loads(response)
    except ValueError as error:
        raise CitationError("not JSON") from error
    problem = next(iter(Draft202012Validator(cited_schema()).iter_errors(cited)), None)
    if problem is not None:
        raise CitationError(f"not a cited rationale: {problem.message[:80]}")
    lines = []
    for name in SECTIONS:
        sentences = [_fill(sentence, facts) for sentence in cited[name]]
        if name == ANALYSIS and [s["facts"][:1] for s in cited[name]] != [[x] for x in LETTERS]:
            raise CitationError("candidates out of order")
        lines.append(f"{name}: {' '.join(s[0].upper() + s[1:] + '.' for s in sentences)}")
    return "\n".join([*lines, f"Answer: {answer}"])


def _fill(sentence: Mapping[str, Any], facts: Mapping[str, str]) -> str:
    """Return a sentence with its slots filled."""
    text, cited = sentence["text"].strip().rstrip("."), sentence["facts"]
    unknown = [fact for fact in cited if fact not in facts]
    if unknown:
        raise CitationError(f"unknown fact: {unknown[0]}")
    literals = text.split(SLOT)
    if len(literals) != len(cited) + 1:
        raise CitationError(f"{len(literals) - 1} slots for {len(cited)} facts")
    for literal in literals:
        words = (w for w in re.findall(r"\w+", literal) if w.lower() not in CONNECTIVES)
        if stated := [*words, *re.findall(r"[^\w ,;:-]", literal)]:
            raise CitationError(f"only connecting words may stand outside slots: {stated[0]!r}")
    return text.format(*(facts[fact] for fact in cited))
