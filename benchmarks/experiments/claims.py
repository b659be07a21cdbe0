"""How well the validator distinguishes false statements from true ones, by mutation.

    python -m benchmarks.experiments.claims store/small [--prose tests/teacher/prose.jsonl]

The built-in narrator narrates every training item of a built benchmark. The rationale and a
paraphrase of it must be accepted. Then one fact of each kind is flipped, the item is narrated from
the false facts and validated against the true ones: the falsehood must be caught. A flipped fact
that the text does not state is counted as unstated. With `--prose`, every word of each kind is
replaced in the rationales of a language model. Prints shares with their counts, the claims by kind
and verdict, and the milliseconds per rationale.
"""

from __future__ import annotations

import argparse
import json
import time
from collections import Counter
from pathlib import Path
from random import Random

from benchmarks.experiments.mutations import KINDS, falsehoods, predicates_from
from benchmarks.experiments.paraphrases import paraphrase
from benchmarks.experiments.prose import EDITS
from data.store import open_store
from teacher.narrator import write_rationale
from teacher.predicates import Predicates, extract_predicates
from teacher.validation.claim_extraction import extract_claims

MISSES_SHOWN = 6


def is_contradicted(text: str, predicates: Predicates) -> bool:
    return any(c.verdict == "contradicted" for c in extract_claims(text, predicates))


class Tally:
    """Counts of correct verdicts by name, with the texts of some wrong ones."""

    def __init__(self) -> None:
        self.caught: Counter[str] = Counter()
        self.total: Counter[str] = Counter()
        self.unstated: Counter[str] = Counter()
        self.wrong: dict[str, list[str]] = {}

    def add(self, name: str, good: bool, text: str) -> None:
        self.total[name] += 1
        self.caught[name] += good
        if not good:
            self.wrong.setdefault(name, []).append(text)

    def show(self, verb: str) -> None:
        for name, total in self.total.items():
            unstated = f", {self.unstated[name]} unstated" if self.unstated[name] else ""
            share = self.caught[name] / total
            print(f"  {name:12} {share:8.2%} {verb} ({self.caught[name]} of {total}{unstated})")
            for text in self.wrong.get(name, [])[:MISSES_SHOWN]:
                print(f"      {text}")


def measure_narrator(folder: Path, limit: int | None) -> None:
    store = open_store(folder)
    passed, caught, claims = Tally(), Tally(), Counter()
    seconds, narrated = 0.0, 0
    for item in store.selection("train")[:limit]:
        predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
        if predicates is None:
            continue
        rng = Random(item.item_id)
        text = write_rationale(predicates, item, 0)
        begun = time.process_time()
        found = extract_claims(text, predicates)
        seconds += time.process_time() - begun
        narrated += 1
        claims.update((c.kind, c.verdict) for c in found)
        false = [str(c) for c in found if c.verdict == "contradicted"]
        passed.add("untouched", not false, f"{item.item_id}: {false}")
        paraphrased = paraphrase(text, rng)
        false = [
            f"{c} <- {sentence(paraphrased, c.span)}"
            for c in extract_claims(paraphrased, predicates)
            if c.verdict == "contradicted"
        ]
        passed.add("paraphrased", not false, f"{item.item_id}: {false}")
        for kind in KINDS:
            for false_text, mutation in falsehoods(predicates, item, kind, rng):
                good = is_contradicted(false_text, predicates)
                caught.add(kind, good, f"{item.item_id}: {mutation.patterns}")
                paraphrased = paraphrase(false_text, rng)
                good = is_contradicted(paraphrased, predicates)
                caught.add(
                    f"{kind}, par.", good, f"{item.item_id}: {mutation.patterns}\n{paraphrased}"
                )
                break
            else:
                caught.unstated[kind] += 1
    print(f"{folder}: {narrated} rationales, {seconds / narrated * 1e3:.2f} ms each")
    passed.show("let through")
    caught.show("caught")
    _show_claims(claims)


def sentence(text: str, span: tuple[int, int]) -> str:
    """The sentence that contains a span of the text."""
    stop = text.find(".", span[1])
    return text[text.rfind(".", 0, span[0]) + 1 : stop if stop >= 0 else len(text)].strip()


def _show_claims(claims: Counter[tuple[str, str]]) -> None:
    verdicts = ("supported", "contradicted", "unknown")
    print(f"  {'claims':14}" + "".join(f"{v:>14}" for v in verdicts))
    for kind in sorted({kind for kind, _ in claims}):
        print(f"  {kind:14}" + "".join(f"{claims[kind, v]:14}" for v in verdicts))


def measure_prose(path: Path) -> None:
    passed, caught, claims = Tally(), Tally(), Counter()
    for line in path.read_text().splitlines():
        record = json.loads(line)
        predicates, text = predicates_from(record["predicates"]), record["text"]
        found = extract_claims(text, predicates)
        claims.update((c.kind, c.verdict) for c in found)
        false = [f"{c} <- {sentence(text, c.span)}" for c in found if c.verdict == "contradicted"]
        passed.add("untouched", not false, f"{record['item_id']}: {false}")
        rng = Random(record["item_id"])
        for kind, edit in EDITS.items():
            for false_text, at in edit(text, predicates, rng):
                good = is_contradicted(false_text, predicates)
                caught.add(kind, good, f"{record['item_id']}: {sentence(false_text, at)}")
    print(f"{path}: {passed.total['untouched']} rationales")
    passed.show("let through")
    caught.show("caught")
    _show_claims(claims)


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.splitlines()[0])
    parser.add_argument("store", nargs="?", type=Path, help="a built benchmark")
    parser.add_argument("--prose", type=Path, help="rationales of a language model, JSON lines")
    parser.add_argument("--limit", type=int, help="the number of items to take")
    args = parser.parse_args()
    if args.store:
        measure_narrator(args.store, args.limit)
    if args.prose:
        measure_prose(args.prose)


if __name__ == "__main__":
    main()
