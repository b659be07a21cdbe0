"""The verdict on a rationale: its sections, its length, the absence of numbers, and its answer."""

from __future__ import annotations

import re
from dataclasses import dataclass, field

from conf.schema import TeacherConfig
from data.records import LETTERS, SelectionItem
from teacher.numbers import find_numbers
from teacher.predicates import Predicates

VALIDATOR_VERSION = "2"
SECTIONS = ("Scene parse", "Motion analysis", "Prediction", "Candidate analysis", "Outcome")
"""Headings of a rationale in order; the line "Answer: X" ends it."""
HEADING = re.compile(rf"^({'|'.join(SECTIONS)}|Answer):[ \t]*", re.MULTILINE)
WORD = re.compile(r"[^\W_]+(?:['’-][^\W_]+)*")


@dataclass(frozen=True)
class Verdict:
    """Whether a rationale may be trained on, why not, and its parts by heading. A reason is
    "kind" or "kind: detail"."""

    accepted: bool
    reasons: tuple[str, ...]
    sections: dict[str, str] = field(default_factory=dict)
    answer: str | None = None


def validate(text: str, predicates: Predicates, item: SelectionItem, cfg: TeacherConfig) -> Verdict:
    """Reads a rationale and lists everything that is wrong with it."""
    reasons = [f"number: {text[start:stop]!r}" for start, stop in find_numbers(text)]
    words = word_count(text)
    if words < cfg.min_words:
        reasons.append("too short")
    if words > cfg.max_words:
        reasons.append("too long")
    sections, answer, problems = _parse(text)
    reasons += problems
    analysis = sections.get("Candidate analysis", "")
    for candidate in predicates.candidates:
        # In a sentence about candidates, for "A" is also an article.
        if analysis and not re.search(rf"[Cc]andidates?\b[^.]*\b{candidate.letter}\b", analysis):
            reasons.append(f"candidate not analysed: {candidate.letter}")
    if answer is not None and answer != item.letter:
        reasons.append(f"wrong answer: {answer}")
    return Verdict(not reasons, tuple(reasons), sections, answer)


def word_count(text: str) -> int:
    """Words of a text; "top-left" is one."""
    return len(WORD.findall(text))


def _parse(text: str) -> tuple[dict[str, str], str | None, list[str]]:
    headings = list(HEADING.finditer(text))
    bounds = [*(m.start() for m in headings), len(text)]
    parts = [(m[1], text[m.end() : bounds[k + 1]].strip()) for k, m in enumerate(headings)]
    sections = {name: body for name, body in parts if name != "Answer"}
    answers = [body for name, body in parts if name == "Answer"]
    problems = [f"missing section: {name}" for name in SECTIONS if name not in sections]
    problems += [f"empty section: {name}" for name, body in sections.items() if not body]
    names = [name for name, _ in parts]
    if len(set(names)) < len(names):
        problems.append("repeated section")
    if names != sorted(names, key=[*SECTIONS, "Answer"].index):
        problems.append("sections out of order")
    if text[: headings[0].start() if headings else 0].strip():
        problems.append("text before the sections")
    if not answers:
        return sections, None, [*problems, "no answer"]
    answer = answers[-1]
    # The letter is trained on and read as the token that follows this very line.
    if answer not in tuple(LETTERS) or not text.rstrip().endswith(f"\nAnswer: {answer}"):
        return sections, None, [*problems, "unclear answer"]
    return sections, answer, problems
