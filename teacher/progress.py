"""The line that tells how narrating goes."""

from __future__ import annotations

import time
from collections import Counter

from tqdm import tqdm

from data.records import Rationale

SHOWN = 3
"""Reasons for rejections that the progress line names."""


class Progress:
    """The progress line: accepted, rejected by reason, tokens a second, time left."""

    def __init__(self, total: int, done: int) -> None:
        self.bar = tqdm(total=total, initial=done, desc="narrating", unit="item", mininterval=1.0)
        self.accepted = 0
        self.tokens = 0
        self.rejected: Counter[str] = Counter()
        self.since = time.monotonic()

    def add(self, answers: list[Rationale]) -> None:
        self.accepted += sum(r.accepted for r in answers)
        self.tokens += sum(r.completion_tokens or 0 for r in answers)
        self.rejected.update(kind for r in answers for kind in kinds(r))
        self.bar.set_postfix_str(str(self), refresh=False)

    def settle(self) -> None:
        """An item is done with."""
        self.bar.update()

    def __str__(self) -> str:
        words = [f"{self.accepted} accepted"]
        words += [f"{n} {kind}" for kind, n in self.rejected.most_common(SHOWN)]
        if self.tokens:
            words.append(f"{self.tokens / (time.monotonic() - self.since):,.0f} tokens/s")
        return ", ".join(words)


def kinds(rationale: Rationale) -> set[str]:
    """The kinds of reasons that an answer was rejected for, without their details."""
    return {reason.partition(":")[0] for reason in rationale.reasons}
