"""The verdict on a rationale: its sections, its length, the absence of numbers, the truth of its
claims, and its answer."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from conf.schema import TeacherConfig
from data.records import LETTERS, SelectionItem
from teacher.candidate_letters import letters
from teacher.numbers import find_numbers
from teacher.predicates import Predicates
from teacher.reading.grounding import Claim
from teacher.sections import SECTIONS, opening, split_sections
from teacher.validation.claim_extraction import extract_claims

VALIDATOR_VERSION = "4"
SMALL_LETTER = re.compile(r"\b[Cc]andidates? [a-d]\b")
WORD = re.compile(r"[^\W_]+(?:['’-][^\W_]+)*")


@dataclass(frozen=True)
class Verdict:
    """Whether a rationale may be trained on, why not, and its parts by heading. A reason is
    "kind" or "kind: detail"."""

    accepted: bool
    reasons: tuple[str, ...]
    sections: dict[str, str] = field(default_factory=dict)
    answer: str | None = None
    claims: tuple[Claim, ...] = ()
    """What the rationale claims, each with the predicates' verdict on it."""


def validate_rationale(
    text: str, predicates: Predicates, item: SelectionItem, cfg: TeacherConfig
) -> Verdict:
    """Reads a rationale and lists everything that is wrong with it."""
    reasons = [f"number: {text[start:stop]!r}" for start, stop in find_numbers(text)]
    words = word_count(text)
    if words < cfg.min_words:
        reasons.append("too short")
    if words > cfg.max_words:
        reasons.append("too long")
    sections, answer, problems = _parse(text)
    reasons += problems
    reasons += _not_analysed(sections.get("Candidate analysis", ""))
    if answer is not None and answer != item.letter:
        reasons.append(f"wrong answer: {answer}")
    claims = extract_claims(text, predicates)
    reasons += dict.fromkeys(f"contradicts: {c}" for c in claims if c.verdict == "contradicted")
    return Verdict(not reasons, tuple(reasons), sections, answer, claims)


def _not_analysed(analysis: str) -> list[str]:
    if not analysis:
        return []
    named = {analysis[start:stop] for start, stop in letters(analysis)}
    reasons = [f"candidate not analysed: {letter}" for letter in LETTERS if letter not in named]
    # For another order such a letter could not be told from an article, and would stay.
    return reasons + [f"small letter: {m[0]}" for m in SMALL_LETTER.finditer(analysis)]


def word_count(text: str) -> int:
    """Words of a text; "top-left" is one."""
    return len(WORD.findall(text))


def _parse(text: str) -> tuple[dict[str, str], str | None, list[str]]:
    bounds = split_sections(text)
    told = [(name, text[start:stop].strip()) for name, start, stop in bounds]
    sections = {name: body for name, body in told if name != "Answer"}
    answers = [body for name, body in told if name == "Answer"]
    problems = [f"missing section: {name}" for name in SECTIONS if name not in sections]
    problems += [f"empty section: {name}" for name, body in sections.items() if not body]
    names = [name for name, _ in told]
    if len(set(names)) < len(names):
        problems.append("repeated section")
    if names != sorted(names, key=[*SECTIONS, "Answer"].index):
        problems.append("sections out of order")
    if opening(text).strip():
        problems.append("text before the sections")
    if not answers:
        return sections, None, [*problems, "no answer"]
    answer = answers[-1]
    # The letter is trained on and read as the token that follows this very line.
    if answer not in tuple(LETTERS) or not text.rstrip().endswith(f"\nAnswer: {answer}"):
        return sections, None, [*problems, "unclear answer"]
    return sections, answer, problems
