"""Validates a rationale: its sections, length, claims and answer, and that it has no numbers."""

from __future__ import annotations

import re
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING

from dynapix.data.records import LETTERS, SelectionItem
from dynapix.teacher.candidate_letters import find_letters
from dynapix.teacher.numbers.detection import find_numbers
from dynapix.teacher.predicates.facts import Predicates
from dynapix.teacher.reading.claims import Claim
from dynapix.teacher.sections import HEADING, SECTIONS, split_sections
from dynapix.teacher.validation.claim_extraction import extract_claims

if TYPE_CHECKING:
    from dynapix.conf.schema import TeacherConfig

VALIDATOR_VERSION = "12"
MAX_QUOTED = 80
"""Maximum number of characters of a sentence in a reason."""
SMALL_LETTER = re.compile(r"\b[Cc]andidates? [a-d]\b")
WORD = re.compile(r"[^\W_]+(?:['’-][^\W_]+)*")
"""A word; hyphens and apostrophes join words, so "top-left" counts as one."""


@dataclass(frozen=True)
class Validation:
    """The result of `validate_rationale`.

    Attributes:
        reasons: Why the rationale is rejected, each "kind" or "kind: detail"; empty if accepted.
        sections: The text of each section, by heading.
        answer: The letter of the chosen candidate; None if the answer is missing or unclear.
        claims: The claims of the rationale, each with its verdict.
    """

    reasons: tuple[str, ...]
    sections: dict[str, str] = field(default_factory=dict)
    answer: str | None = None
    claims: tuple[Claim, ...] = ()

    @property
    def accepted(self) -> bool:
        return not self.reasons

    def rejected(self, reason: str) -> Validation:
        """Return the same result with one more reason for rejection."""
        return replace(self, reasons=(*self.reasons, reason))


def validate_rationale(
    text: str, predicates: Predicates, item: SelectionItem, cfg: TeacherConfig
) -> Validation:
    """Check a rationale against its item, and collect every reason to reject it.

    Only the form and the answer of an ungrounded rationale are checked (`teacher.grounding`).
    """
    numbers = [*find_numbers(text)]
    reasons = [f"number: {text[start:stop]!r}" for start, stop in numbers]
    words = len(WORD.findall(text))
    if words < cfg.min_words:
        reasons.append("too short")
    if words > cfg.max_words:
        reasons.append("too long")
    sections, answer, problems = _parse_sections(text)
    reasons += problems
    reasons += _check_candidate_analysis(sections.get("Candidate analysis", ""))
    if answer is not None and answer != item.letter:
        reasons.append(f"wrong answer: {answer}")
    claims = extract_claims(text, predicates)
    grounded = cfg.grounding == "oracle"
    if grounded:
        reasons += dict.fromkeys(f"contradicts: {c}" for c in claims if c.verdict == "contradicted")
    if grounded and cfg.strict:
        for start, stop in (c.span for c in claims if c.kind == "unreadable"):
            # A number has a reason of its own.
            if not any(start <= number < stop for number, _ in numbers):
                reasons.append(f"unreadable: {text[start : min(stop, start + MAX_QUOTED)]!r}")
    return Validation(tuple(reasons), sections, answer, claims)


def _check_candidate_analysis(analysis: str) -> list[str]:
    if not analysis:
        return []
    named = {analysis[start:stop] for start, stop in find_letters(analysis)}
    reasons = [f"candidate not analysed: {letter}" for letter in LETTERS if letter not in named]
    # `relabel_text` does not change small letters, which may be the article "a".
    return reasons + [f"small letter: {m[0]}" for m in SMALL_LETTER.finditer(analysis)]


def _parse_sections(text: str) -> tuple[dict[str, str], str | None, list[str]]:
    """Return the text of each section, the answer if it is clear, and the errors of the form."""
    bodies = [(name, text[start:stop].strip()) for name, start, stop in split_sections(text)]
    sections = {name: body for name, body in bodies if name != "Answer"}
    answers = [body for name, body in bodies if name == "Answer"]
    problems = [f"missing section: {name}" for name in SECTIONS if name not in sections]
    problems += [f"empty section: {name}" for name, body in sections.items() if not body]
    names = [name for name, _ in bodies]
    if len(set(names)) < len(names):
        problems.append("repeated section")
    if names != sorted(names, key=[*SECTIONS, "Answer"].index):
        problems.append("sections out of order")
    if names and HEADING.split(text, maxsplit=1)[0].strip():
        problems.append("text before the sections")
    if not answers:
        return sections, None, [*problems, "no answer"]
    answer = answers[-1]
    # Students are trained to end their text with exactly this line.
    if answer not in tuple(LETTERS) or not text.rstrip().endswith(f"\nAnswer: {answer}"):
        return sections, None, [*problems, "unclear answer"]
    return sections, answer, problems
