"""Measures which false words in rationales the validator detects, and which true claims it rejects.

    python -m research.experiments.mutations store/small
    python -m research.experiments.mutations store/small --predicates relational
    python -m research.experiments.mutations tests/teacher/prose.jsonl

The built-in narrator writes rationales for the training items of a built benchmark, or they are
read from a JSON lines file with the fields item_id, text and predicates. For each kind of word,
such as speed, one word of each rationale is replaced by a false word, which is detected if the
validator finds a contradicted claim in the changed text. Rationales with a contradicted claim are
left unchanged and counted. The script prints the detected share of each kind, some of the
undetected words, and the claims of the unchanged rationales by kind and verdict.
"""

from __future__ import annotations

import argparse
import json
from collections import Counter, defaultdict
from collections.abc import Iterator
from pathlib import Path
from random import Random
from typing import Any

from pydantic import TypeAdapter

from benchmarks.arguments import positive_int
from dynapix.conf.failures import report_failures
from dynapix.data.store import open_store
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.extraction import extract_predicates
from dynapix.teacher.predicates.facts import Predicates
from dynapix.teacher.validation.claim_extraction import extract_claims
from dynapix.teacher.validation.mutations import MUTATIONS, RELATION_MUTATIONS

MISSES_PRINTED = 6


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("source", type=Path, help="a built benchmark or a file of rationales")
    parser.add_argument(
        "--predicates", choices=("paper", "relational"), default="paper", help="of the narrator"
    )
    parser.add_argument("--limit", type=positive_int, help="maximum number of rationales")
    args = parser.parse_args()
    results: dict[str, list[bool]] = defaultdict(list)
    misses: dict[str, list[str]] = defaultdict(list)
    claims: Counter[tuple[str, str]] = Counter()
    rejected = 0
    relational = args.predicates == "relational"
    for number, (item_id, text, predicates) in enumerate(read_rationales(args.source, relational)):
        if number == args.limit:
            break
        claims.update((claim.kind, claim.verdict) for claim in extract_claims(text, predicates))
        if is_contradicted(text, predicates):
            rejected += 1
            continue
        rng = Random(item_id)
        for kind, mutate in {**MUTATIONS, **RELATION_MUTATIONS}.items():
            options = list(mutate(text, predicates, rng))
            if not options:
                continue
            false_text, (start, stop) = rng.choice(options)
            results[kind].append(is_contradicted(false_text, predicates))
            if not results[kind][-1]:
                context = false_text[max(0, start - 60) : stop + 60].replace("\n", " ")
                misses[kind].append(f"{item_id}: {context}")
    for kind, detected in results.items():
        share = sum(detected) / len(detected)
        print(f"{kind:10} {share:7.2%} detected ({sum(detected)} of {len(detected)})")
        for miss in misses[kind][:MISSES_PRINTED]:
            print(f"    {miss}")
    print(f"rationales with a contradicted claim: {rejected}")
    verdicts = ("supported", "contradicted", "unknown")
    print(f"{'claims':14}" + "".join(f"{verdict:>14}" for verdict in verdicts))
    for kind in sorted({kind for kind, _ in claims}):
        print(f"{kind:14}" + "".join(f"{claims[kind, verdict]:14}" for verdict in verdicts))


def read_rationales(
    source: Path, relational: bool = False
) -> Iterator[tuple[str, str, Predicates]]:
    """Yield the item id, text and predicates of each rationale. The narrator of a
    benchmark's rationales uses relations if `relational` is true."""
    if source.is_file():
        for line in source.read_text().splitlines():
            record = json.loads(line)
            yield record["item_id"], record["text"], parse_predicates(record["predicates"])
        return
    store = open_store(source)
    for item in store.selection("train"):
        predicates = extract_predicates(item, store.scene(item.scene_id), store.scene)
        if predicates is not None:
            found = predicates if relational else predicates.without_relations()
            yield item.item_id, write_rationale(found, item, 0), found


def is_contradicted(text: str, predicates: Predicates) -> bool:
    return any(claim.verdict == "contradicted" for claim in extract_claims(text, predicates))


def parse_predicates(record: dict[str, Any]) -> Predicates:
    """Rebuild predicates from their JSON form."""
    return TypeAdapter(Predicates).validate_python(record)


if __name__ == "__main__":
    with report_failures():
        main()
