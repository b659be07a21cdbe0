"""Measures how long the steps from the oracle to a graded rationale take, in both vocabularies.

    python -m benchmarks.speed.rationales store/small

For every training item of a built benchmark, the predicates are extracted, the deciding statements
chosen, a rationale written and read, and its sufficiency measured. The table has the CPU seconds
for 10,000 items, by step, in one process.
"""

from __future__ import annotations

import argparse
import time
from collections import defaultdict
from collections.abc import Callable
from pathlib import Path
from typing import TypeVar

import pandas as pd

from dynapix.conf.failures import report_failures
from dynapix.conf.schema import TeacherConfig
from dynapix.data.store import open_store
from dynapix.teacher.narrator import write_rationale
from dynapix.teacher.predicates.statement_choice import choose_statements
from dynapix.teacher.predicates.vocabulary import choose_vocabulary, describe_item
from dynapix.teacher.validation.sufficiency import measure_sufficiency
from dynapix.teacher.validation.validator import validate_rationale

ITEMS = 10_000
T = TypeVar("T")


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("store", type=Path, help="a built benchmark")
    args = parser.parse_args()
    store = open_store(args.store)
    table = {}
    for vocabulary in ("paper", "relational"):
        cfg = TeacherConfig(name="template", predicates=vocabulary)
        seconds: dict[str, float] = defaultdict(float)
        count = 0

        def timed(step: str, function: Callable[..., T], *args: object) -> T:
            start = time.process_time()
            result = function(*args)
            seconds[step] += time.process_time() - start  # noqa: B023
            return result

        for item in store.selection("train"):
            for scene_id in {item.scene_id, *(c.scene_id for c in item.candidates)}:
                timed("loading scenes", store.scene, scene_id)
            predicates = timed("predicates", describe_item, item, store, cfg)
            if predicates is None:
                continue
            count += 1
            timed("deciding statements", choose_statements, predicates)
            facts = choose_vocabulary(predicates, cfg)
            text = timed("rationale", write_rationale, facts, item, 0)
            result = timed("reading and validation", validate_rationale, text, facts, item, cfg)
            timed("sufficiency", measure_sufficiency, text, result.claims, predicates)
        per_item = pd.Series(seconds) * ITEMS / count
        table[vocabulary] = pd.concat([per_item, pd.Series({"sum": per_item.sum()})])
    print(f"CPU seconds for {ITEMS:,} items\n{pd.DataFrame(table).round(1).to_string()}")


if __name__ == "__main__":
    with report_failures():
        main()
