"""Rationales whose claims were marked by hand, and the items that they are about.

python -m tests.teacher.marked      # prints the reader's verdicts on true and on false claims
"""

from __future__ import annotations

import json
from collections import Counter
from collections.abc import Iterator
from functools import cache
from pathlib import Path
from typing import Any

from dynapix.data.records import Scene, SelectionItem
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.facts import RelationalPredicates
from dynapix.teacher.validation.claim_extraction import extract_claims
from tests.data.simulated import simulate_scene
from tests.teacher import synthetic

FILE = Path(__file__).parent / "sentences" / "marked.jsonl"
"""One rationale a line: its item, its text, and its claims with their quotes and their truth."""
SCENES = 20
STOPS = (24, 40, 56)
"""Last frames of the prefixes; each scene has an item for each."""


@cache
def marked_scene(index: int) -> Scene:
    return simulate_scene(0, index)


def marked_items() -> Iterator[tuple[SelectionItem, RelationalPredicates]]:
    """Yield items of simulated scenes: the target 20 frames after the prefix, and distractors
    before and after it."""
    for index in range(SCENES):
        for k, stop in enumerate(STOPS):
            answer = (index + k) % 4
            frames = [stop + 6, stop + 34, stop + 48]
            frames.insert(answer, stop + 20)
            item = synthetic.item(
                tuple(frames),
                start=stop - 20,
                stop=stop,
                answer=answer,
                item_id=f"marked-{index}-{k}",
                scene_id=f"marked-{index}",
                framing=(None, "future", "contact")[k],
            )
            scene = marked_scene(index)
            predicates = extract_predicates(item, scene, lambda _, scene=scene: scene)
            if predicates is not None:
                yield item, predicates


def read_marked() -> list[dict[str, Any]]:
    """Return the rationales, each with `item`, `text` and `claims`. A claim has the words that
    state it (`quote`), what it is about (`part`), and whether it is true (`truth`)."""
    return [json.loads(line) for line in FILE.read_text(encoding="utf-8").splitlines()]


@cache
def verdicts_by_truth() -> dict[bool, Counter[str]]:
    """The verdicts of the reader on the marked claims that are true, and on those that are false.
    A claim is "missed" if the reader finds no claim in its words."""
    items = {item.item_id: predicates for item, predicates in marked_items()}
    counts = {True: Counter(), False: Counter()}
    for rationale in read_marked():
        claims = extract_claims(rationale["text"], items[rationale["item"]])
        for marked in rationale["claims"]:
            start = rationale["text"].index(marked["quote"])
            stop = start + len(marked["quote"])
            inside = {
                c.verdict
                for c in claims
                if start <= c.span[0] < stop and c.kind not in ("mention", "agrees")
            }
            worst = next((v for v in ("contradicted", "unknown", "supported") if v in inside), None)
            counts[marked["truth"]][worst or "missed"] += 1
    return counts


if __name__ == "__main__":
    for truth, verdicts in verdicts_by_truth().items():
        found = ", ".join(f"{verdict} {count}" for verdict, count in verdicts.most_common())
        print(f"{verdicts.total()} {'true' if truth else 'false'} claims: {found}")
