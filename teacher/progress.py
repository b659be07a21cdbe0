"""Progress bar of a narration."""

from __future__ import annotations

import time
from collections import Counter

from tqdm import tqdm

from data.records import Rationale

LISTED_REASONS = 3
"""Most frequent reasons for rejections that the bar lists."""


class Progress:
    """A bar with accepted and rejected responses, tokens per second and the remaining time."""

    def __init__(self, total: int, done: int) -> None:
        self.bar = tqdm(total=total, initial=done, desc="narrating", unit="item", mininterval=1.0)
        self.accepted = self.tokens = 0
        self.rejected: Counter[str] = Counter()
        self.started = time.monotonic()

    def add_responses(self, responses: list[Rationale]) -> None:
        self.accepted += sum(r.accepted for r in responses)
        self.tokens += sum(r.completion_tokens or 0 for r in responses)
        self.rejected.update(kind for r in responses for kind in rejection_kinds(r))
        words = [f"{self.accepted} accepted"]
        words += [f"{n} {kind}" for kind, n in self.rejected.most_common(LISTED_REASONS)]
        if self.tokens:
            words.append(f"{self.tokens / (time.monotonic() - self.started):,.0f} tokens/s")
        self.bar.set_postfix_str(", ".join(words), refresh=False)

    def finish_item(self) -> None:
        self.bar.update()


def rejection_kinds(rationale: Rationale) -> set[str]:
    """The kinds of reasons for which a response was rejected, without their details."""
    return {reason.partition(":")[0] for reason in rationale.reasons}
