"""Figures of a narration: acceptance, reasons for rejections, lengths, words, claims and cost.

`Summary.to_dict` is report.json and `Summary.text` is report.txt.
"""

from __future__ import annotations

import re
from collections import Counter, defaultdict
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import asdict, dataclass
from typing import Any

import numpy as np

from data.records import COLORS, MATERIALS, Rationale, SelectionItem
from teacher.progress import rejection_kinds
from teacher.validation.validator import WORD

EXAMPLES = 3
"""Rejected responses that are quoted for each reason."""
COMMON_WORDS = 20
"""Most frequent words that are listed."""
BIN_WIDTH = 10
"""Words per bar of the histogram of lengths."""
IDLE_SECONDS = 60.0
"""Time without a response after which the servers count as idle."""
OBJECT_NAME = re.compile(rf"\b(?:{'|'.join(COLORS)}) (?:{'|'.join(MATERIALS)}) \w+")


@dataclass(frozen=True)
class Summary:
    """Figures of all responses of one teacher under one configuration.

    `accepted` counts items; `fallback`, those of them that the built-in narrator wrote in the
    teacher's place; `set_aside`, items whose attempts were all rejected; `too_short`, items whose
    prefix is too short. `responses` and `accepted_responses` are the teacher's, by attempt.
    `rejected` counts responses by kind of reason, the most frequent first, and `examples` has items
    and details of some. `lengths` are words of each accepted rationale, `words` the most frequent
    ones. `same_text` counts accepted rationales that repeat another one's text, `same_but_names`
    those that do so up to the objects' names. `claims` are the supported, contradicted and unknown
    ones, by kind. `hours` is the time in which servers were in use; times their GPUs, it gives GPU
    hours.
    """

    items: int
    accepted: int
    fallback: int
    set_aside: int
    too_short: int
    responses: tuple[int, ...]
    accepted_responses: tuple[int, ...]
    rejected: dict[str, int]
    examples: dict[str, list[tuple[str, str]]]
    lengths: tuple[int, ...]
    words: dict[str, int]
    distinct_words: int
    same_text: int
    same_but_names: int
    claims: dict[str, tuple[int, ...]]
    requests: int
    prompt_tokens: int
    completion_tokens: int
    hours: float

    def to_dict(self) -> dict[str, Any]:
        """Plain values, ready for JSON."""
        return asdict(self)

    def text(self) -> str:
        """The figures as plain text."""
        total = sum(self.responses)
        counts = [
            ("training items", self.items),
            ("accepted", self.accepted),
            ("  of them by the built-in narrator (fallback)", self.fallback),
            ("set aside", self.set_aside),
            ("prefix too short", self.too_short),
        ]
        attempts = [
            (k + 1, count, accepted, f"{accepted / max(count, 1):.1%}")
            for k, (count, accepted) in enumerate(
                zip(self.responses, self.accepted_responses, strict=True)
            )
        ]
        rejected = [(kind, n, f"{n / total:.1%}") for kind, n in self.rejected.items()]
        examples = [
            f"    {kind}, {item}: {detail}"
            for kind, details in self.examples.items()
            for item, detail in details
            if detail
        ]
        claims = [
            (kind, sum(counts), *(f"{count / sum(counts):.1%}" for count in counts))
            for kind, counts in sorted(self.claims.items())
        ]
        parts = [
            format_table(counts),
            format_table(attempts, ("attempt", "responses", "accepted", "share")),
            format_table(rejected, ("rejected for", "responses", "share")),
            "\n".join(examples),
            self._format_words(),
            format_table(claims, ("claims", "total", "supported", "contradicted", "unknown")),
            self._format_cost(),
        ]
        return "\n\n".join(part for part in parts if part)

    def _format_words(self) -> str:
        if not self.lengths:
            return ""
        low, median, high = np.percentile(self.lengths, [5, 50, 95])
        bins = Counter(length // BIN_WIDTH * BIN_WIDTH for length in self.lengths)
        widest = max(bins.values())
        common = ", ".join(f"{word} {count:,}" for word, count in self.words.items())
        return "\n".join(
            [
                f"words per rationale: {min(self.lengths)} to {max(self.lengths)}, mean "
                f"{np.mean(self.lengths):.0f}, median {median:.0f}, 5% to 95% {low:.0f} to "
                f"{high:.0f}",
                *(
                    f"{start:>4} {'#' * round(50 * count / widest)} {count:,}"
                    for start, count in sorted(bins.items())
                ),
                f"vocabulary: {self.distinct_words:,} distinct words; most frequent: {common}",
                f"duplicates: {self.same_text:,} accepted rationales repeat another one's text, "
                f"{self.same_but_names:,} do so up to the objects' names",
            ]
        )

    def _format_cost(self) -> str:
        if not self.requests:
            return ""
        rate = self.completion_tokens / (3600 * self.hours) if self.hours else 0.0
        per_rationale = self.completion_tokens / max(self.accepted - self.fallback, 1)
        return (
            f"cost: {self.requests:,} requests, {self.prompt_tokens:,} prompt tokens, "
            f"{self.completion_tokens:,} completion tokens ({per_rationale:,.0f} per accepted "
            f"rationale), {self.hours:.2f} hours of the servers, {rate:,.0f} tokens/s"
        )


def format_table(rows: Iterable[Sequence[object]], header: Sequence[str] = ()) -> str:
    """Rows in aligned columns: the first column to the left, the others to the right."""
    cells = [[f"{c:,}" if isinstance(c, int) else str(c) for c in row] for row in rows]
    if not cells:
        return ""
    cells = [list(header), *cells] if header else cells
    first, *widths = (max(map(len, column)) for column in zip(*cells, strict=True))
    return "\n".join(
        name.ljust(first) + "".join(f"  {c:>{w}}" for c, w in zip(others, widths, strict=True))
        for name, *others in cells
    )


def summarize(
    items: Sequence[SelectionItem],
    responses: Mapping[str, Sequence[Rationale]],
    attempts: int,
    too_short: int,
) -> Summary:
    """The figures of `responses` by item, in the order of their attempts.

    `attempts` is the limit per item, `too_short` the number of items with too short a prefix.
    """
    every = [r for item in items for r in responses.get(item.item_id, ())]
    accepted = select_accepted(items, responses)
    settled = {r.item_id for r in accepted}
    by_attempt = Counter(r.attempt for r in every if not r.fallback)
    accepted_by_attempt = Counter(r.attempt for r in every if r.accepted and not r.fallback)
    attempted = range(max(by_attempt, default=-1) + 1)
    rejections = _collect_rejections(every)
    words = Counter(word for r in accepted for word in WORD.findall(r.text.lower()))
    gaps = np.diff(np.sort([r.finished for r in every if r.finished is not None]))
    return Summary(
        items=len(items),
        accepted=len(accepted),
        fallback=sum(r.fallback for r in accepted),
        set_aside=sum(
            len(responses.get(item.item_id, ())) >= attempts and item.item_id not in settled
            for item in items
        ),
        too_short=too_short,
        responses=tuple(by_attempt[k] for k in attempted),
        accepted_responses=tuple(accepted_by_attempt[k] for k in attempted),
        rejected={kind: len(details) for kind, details in rejections.items()},
        examples={kind: details[:EXAMPLES] for kind, details in rejections.items()},
        lengths=tuple(len(WORD.findall(r.text)) for r in accepted),
        words=dict(words.most_common(COMMON_WORDS)),
        distinct_words=len(words),
        same_text=_count_repeats(r.text for r in accepted),
        same_but_names=_count_repeats(OBJECT_NAME.sub("object", r.text) for r in accepted),
        claims=_sum_claims(every),
        requests=sum(r.prompt_tokens is not None for r in every),
        prompt_tokens=sum(r.prompt_tokens or 0 for r in every),
        completion_tokens=sum(r.completion_tokens or 0 for r in every),
        hours=float(gaps[gaps < IDLE_SECONDS].sum()) / 3600,
    )


def select_accepted(
    items: Sequence[SelectionItem], responses: Mapping[str, Sequence[Rationale]]
) -> list[Rationale]:
    """The first accepted rationale of each item that has one, in item order."""
    firsts = (
        next((r for r in responses.get(item.item_id, ()) if r.accepted), None) for item in items
    )
    return [r for r in firsts if r is not None]


def _collect_rejections(responses: Iterable[Rationale]) -> dict[str, list[tuple[str, str]]]:
    """Item and detail of each rejection by kind of reason, the most frequent kind first."""
    details: dict[str, list[tuple[str, str]]] = defaultdict(list)
    for response in responses:
        # A response with several numbers counts once under "number".
        for kind in rejection_kinds(response):
            detail = next(r for r in response.reasons if r.partition(":")[0] == kind)
            details[kind].append((response.item_id, detail.removeprefix(f"{kind}:").strip()))
    return dict(sorted(details.items(), key=lambda pair: (-len(pair[1]), pair[0])))


def _count_repeats(texts: Iterable[str]) -> int:
    return sum(count - 1 for count in Counter(texts).values())


def _sum_claims(responses: Iterable[Rationale]) -> dict[str, tuple[int, ...]]:
    counts: dict[str, list[list[int]]] = defaultdict(list)
    for response in responses:
        for kind, of_response in response.claims.items():
            counts[kind].append(of_response)
    return {kind: tuple(map(sum, zip(*rows, strict=True))) for kind, rows in counts.items()}
