"""What a teacher's answers amount to: acceptance, reasons, lengths, words, claims and cost.

The figures are those that a paper about the rationales states; `Summary.to_dict` is report.json and
`Summary.text` is report.txt.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Mapping, Sequence
from dataclasses import asdict, dataclass, field
from typing import Any

import numpy as np

from data.records import Rationale, SelectionItem
from teacher.progress import kinds
from teacher.validation.validator import WORD

EXAMPLES = 3
"""Answers that are quoted for each reason to reject."""
COMMON = 20
"""Words that are listed as the most used."""
BIN = 10
"""Words a bar of the histogram of lengths."""
PAUSE = 60.0
"""Seconds without an answer after which a server counts as not in use."""
NAMES = re.compile(r"\b(?:gray|red|blue|green|brown|cyan|purple|yellow) (?:metal|rubber) \w+")


@dataclass(frozen=True)
class Reason:
    """Why answers were rejected: how often, and an item with the detail for some of them."""

    count: int
    examples: tuple[tuple[str, str], ...]


@dataclass(frozen=True)
class Vocabulary:
    """Words of the accepted rationales, without regard to case."""

    words: int
    distinct: int
    common: tuple[tuple[str, int], ...]


@dataclass(frozen=True)
class Cost:
    """What servers read and wrote for all answers, and for how long they were in use (hours). A
    server's hours times the cards that it ran on are the hours of those cards."""

    requests: int
    prompt_tokens: int
    completion_tokens: int
    hours: float


@dataclass(frozen=True)
class Summary:
    """All answers of one teacher under one configuration.

    `asked` and `accepted_at` count the teacher's answers by attempt; `lengths` are the accepted
    rationales' words; `claims` are supported, contradicted and unknown claims of all answers by
    kind.
    """

    items: int
    accepted: int
    fallback: int
    set_aside: int
    too_short: int
    asked: tuple[int, ...]
    accepted_at: tuple[int, ...]
    reasons: dict[str, Reason]
    lengths: tuple[int, ...]
    vocabulary: Vocabulary
    same_text: int
    same_but_names: int
    claims: dict[str, tuple[int, int, int]] = field(default_factory=dict)
    cost: Cost | None = None

    @property
    def rejected(self) -> dict[str, int]:
        """Rejected answers by the kind of reason."""
        return {kind: reason.count for kind, reason in self.reasons.items()}

    def to_dict(self) -> dict[str, Any]:
        """Ready for JSON."""
        return asdict(self)

    def text(self) -> str:
        """The page of a paper's appendix, in plain text."""
        return "\n\n".join(
            part
            for part in (
                self._counts(),
                self._attempts(),
                self._reasons(),
                self._lengths(),
                self._words(),
                self._claims(),
                self._cost(),
            )
            if part
        )

    def _counts(self) -> str:
        rows = [
            ("training items", self.items),
            ("accepted", self.accepted),
            ("  of them told by the built-in narrator instead", self.fallback),
            ("set aside", self.set_aside),
            ("too short a prefix", self.too_short),
        ]
        return "\n".join(f"{name:<50}{count:>8,}" for name, count in rows)

    def _attempts(self) -> str:
        rows = [
            f"{k + 1:>7}{asked:>10,}{accepted:>10,}{accepted / max(asked, 1):>9.1%}"
            for k, (asked, accepted) in enumerate(zip(self.asked, self.accepted_at, strict=True))
        ]
        return "\n".join(["attempt   answers  accepted    share", *rows]) if rows else ""

    def _reasons(self) -> str:
        answers = sum(self.asked)
        rows = []
        for name, reason in self.reasons.items():
            rows.append(f"{name:<40}{reason.count:>8,}{reason.count / answers:>8.1%}")
            rows += [f"    {item}: {detail}" for item, detail in reason.examples if detail]
        return "\n".join(["reasons to reject (of all answers)", *(rows or ["none"])])

    def _lengths(self) -> str:
        if not self.lengths:
            return ""
        low, middle, high = np.percentile(self.lengths, [5, 50, 95])
        least, most = min(self.lengths), max(self.lengths)
        bars = Counter(length // BIN * BIN for length in self.lengths)
        widest = max(bars.values())
        return "\n".join(
            [
                f"words a rationale: {least} to {most}, mean {np.mean(self.lengths):.0f}, median "
                f"{middle:.0f}, 5% to 95% {low:.0f} to {high:.0f}",
                *(
                    f"{start:>4} {'#' * round(50 * count / widest)} {count:,}"
                    for start, count in sorted(bars.items())
                ),
            ]
        )

    def _words(self) -> str:
        told = self.vocabulary
        if not told.words:
            return ""
        common = ", ".join(f"{word} {count:,}" for word, count in told.common)
        return "\n".join(
            [
                f"vocabulary: {told.distinct:,} words in {told.words:,}; most used: {common}",
                f"duplicates: {self.same_text:,} accepted rationales repeat another's text, "
                f"{self.same_but_names:,} do but for the objects they name",
            ]
        )

    def _claims(self) -> str:
        if not self.claims:
            return ""
        rows = [
            f"{kind:<24}{sum(counts):>9,}" + "".join(f"{c / sum(counts):>14.1%}" for c in counts)
            for kind, counts in sorted(self.claims.items())
        ]
        head = f"{'claims':<24}{'read':>9}{'supported':>14}{'contradicted':>14}{'unknown':>14}"
        return "\n".join([head, *rows])

    def _cost(self) -> str:
        if self.cost is None:
            return ""
        cost = self.cost
        rate = cost.completion_tokens / (3600 * cost.hours) if cost.hours else 0.0
        accepted = max(self.accepted - self.fallback, 1)
        return (
            f"cost: {cost.requests:,} requests, {cost.prompt_tokens:,} tokens read, "
            f"{cost.completion_tokens:,} written ({cost.completion_tokens / accepted:,.0f} for an "
            f"accepted rationale), {cost.hours:.2f} hours of the servers, {rate:,.0f} tokens a "
            "second"
        )


def summarise(
    items: Sequence[SelectionItem],
    answers: Mapping[str, Sequence[Rationale]],
    attempts: int,
    too_short: int,
) -> Summary:
    """The summary of `answers` (by item, in the order of their attempts), of which an item may have
    `attempts` at most."""
    told = [r for item in items for r in answers.get(item.item_id, ())]
    asked = Counter(r.attempt for r in told if not r.fallback)
    right = Counter(r.attempt for r in told if r.accepted and not r.fallback)
    kept = accepted_of(items, answers)
    tried = range(max(asked, default=-1) + 1)
    settled = {r.item_id for r in kept}
    return Summary(
        items=len(items),
        accepted=len(kept),
        fallback=sum(r.fallback for r in kept),
        set_aside=sum(
            len(answers.get(item.item_id, ())) >= attempts and item.item_id not in settled
            for item in items
        ),
        too_short=too_short,
        asked=tuple(asked[k] for k in tried),
        accepted_at=tuple(right[k] for k in tried),
        reasons=_reasons(told),
        lengths=tuple(len(WORD.findall(r.text)) for r in kept),
        vocabulary=_vocabulary(kept),
        same_text=_repeats(r.text for r in kept),
        same_but_names=_repeats(NAMES.sub("object", r.text) for r in kept),
        claims=_claims(told),
        cost=_cost(told),
    )


def accepted_of(
    items: Sequence[SelectionItem], answers: Mapping[str, Sequence[Rationale]]
) -> list[Rationale]:
    """The accepted rationale of each item that has one, in item order."""
    given = (answers.get(item.item_id, ()) for item in items)
    return [r for of_item in given for r in [r for r in of_item if r.accepted][:1]]


def _reasons(told: Sequence[Rationale]) -> dict[str, Reason]:
    found: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for answer in told:
        # An answer with several numbers was rejected for numbers once.
        for kind in kinds(answer):
            detail = next(r for r in answer.reasons if r.partition(":")[0] == kind)
            found[kind].append((answer.item_id, detail.removeprefix(f"{kind}:").strip()))
    ranked = sorted(found.items(), key=lambda pair: (-len(pair[1]), pair[0]))
    return {kind: Reason(len(every), tuple(every[:EXAMPLES])) for kind, every in ranked}


def _vocabulary(kept: Sequence[Rationale]) -> Vocabulary:
    words = Counter(word for r in kept for word in WORD.findall(r.text.lower()))
    return Vocabulary(words.total(), len(words), tuple(words.most_common(COMMON)))


def _repeats(texts: Any) -> int:
    return sum(count - 1 for count in Counter(texts).values())


def _claims(told: Sequence[Rationale]) -> dict[str, tuple[int, int, int]]:
    total: dict[str, list[int]] = defaultdict(lambda: [0, 0, 0])
    for answer in told:
        for kind, counts in answer.claims.items():
            total[kind] = [a + b for a, b in zip(total[kind], counts, strict=True)]
    return {kind: (a, b, c) for kind, (a, b, c) in total.items()}


def _cost(told: Sequence[Rationale]) -> Cost | None:
    served = [r for r in told if r.finished is not None]
    if not served:
        return None
    times = np.sort([r.finished for r in served])
    gaps = np.diff(times)
    return Cost(
        requests=sum(r.prompt_tokens is not None for r in served),
        prompt_tokens=sum(r.prompt_tokens or 0 for r in served),
        completion_tokens=sum(r.completion_tokens or 0 for r in served),
        hours=float(gaps[gaps < PAUSE].sum()) / 3600,
    )
