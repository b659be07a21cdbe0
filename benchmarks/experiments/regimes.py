"""The paper's comparison at tiny scale: zero-shot, answer-only, CoT, and CoT without each of its
parts, each over three seeds, on a test split of over a thousand items.

    python -m benchmarks.experiments.regimes

Trains and measures what is missing, each by the project's own commands and in runs of their own, so
that it may be stopped and started again, and prints one table. A figure is the mean over the seeds
with its 95% interval when whole scenes are drawn again; so is a difference, of the same items.
Runs are in checkpoints/, and the letters that each student gave are kept in benchmarks/letters/,
both by the hash of the base that it was trained over: a run whose letters are kept is not made
again, and `--table` reads no more than them.
"""

from __future__ import annotations

import argparse
import csv
import json
from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path

import numpy as np

from benchmarks.experiments.jobs import run, run_all
from conf.compose import compose
from conf.runs import write_text
from conf.schema import SelectCommand, SftCommand
from data.records import FAMILIES
from data.store import open_store
from evaluation.metrics.accuracy import macro_by_scene
from models.checks import weights_digest

REGIMES = ("answer_only", "cot", "cot_no_candidate_analysis", "cot_no_match_layout")
MODES = {"answer_only": ["answer"]}
BOTH = ["reasoning", "answer"]
SEEDS = (0, 1, 2)
PAIRS = (
    (("cot", "reasoning"), ("answer_only", "answer")),
    (("cot", "answer"), ("answer_only", "answer")),
    (("cot", "reasoning"), ("cot", "answer")),
    (("cot", "reasoning"), ("cot_no_candidate_analysis", "reasoning")),
    (("cot", "reasoning"), ("cot_no_match_layout", "reasoning")),
    (("cot", "reasoning"), ("zero-shot", "reasoning")),
)


LETTERS = Path(__file__).parent / "letters"
UNREAD = "-"
"""Stands for an answer in which no letter could be read."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--benchmark", default="comparison")
    parser.add_argument("--student", default="tiny")
    parser.add_argument("--store", default="store")
    parser.add_argument("--checkpoints", default="checkpoints")
    parser.add_argument("--letters", type=Path, default=LETTERS, help="where answers are kept")
    parser.add_argument("--jobs", type=int, default=1, help="runs at once, each with a thread")
    parser.add_argument("--seeds", type=int, default=len(SEEDS))
    parser.add_argument("--table", action="store_true", help="of the answers that are kept")
    args = parser.parse_args()
    base = compose("train.sft", SftCommand, [f"student={args.student}"]).student.model
    known_by = weights_digest(base)
    folders = Path(args.checkpoints) / known_by, args.letters / known_by
    plan = Plan(args.benchmark, args.student, args.store, *folders)
    seeds = SEEDS[: args.seeds]
    if not args.table:
        run(plan.built())
        # Seed by seed, so that a comparison of fewer is there early.
        wanted = [("zero-shot", 0), *((regime, seed) for seed in seeds for regime in REGIMES)]
        run_all(partial(make, plan), [w for w in wanted if not plan.kept(*w).exists()], args.jobs)
    print_table(plan, seeds)


@dataclass(frozen=True)
class Plan:
    """What is compared, and where it lies."""

    benchmark: str
    student: str
    store: str
    checkpoints: Path
    letters: Path

    def built(self) -> list[str]:
        return ["data.build", f"benchmark={self.benchmark}", f"store={self.store}"]

    def trained(self, regime: str, seed: int) -> list[str]:
        return ["train.sft", f"+exp={regime}", f"seed={seed}", *self._common(regime, seed)]

    def measured(self, regime: str, seed: int) -> list[str]:
        folder = self.checkpoints / "sft" / self.name(regime, seed)
        # A base would be asked for the record, which it never saw.
        base = regime == "zero-shot"
        student = ["modes=[reasoning,answer]"] if base else [f"model={folder}"]
        return ["evaluation.select", *student, "batch=64", *self._common(regime, seed)]

    def kept(self, regime: str, seed: int) -> Path:
        return self.letters / f"{self.name(regime, seed)}.csv"

    def name(self, regime: str, seed: int) -> str:
        return f"{self.benchmark}-{regime}-{seed}"

    def _common(self, regime: str, seed: int) -> list[str]:
        return [
            f"student={self.student}", f"benchmark={self.benchmark}", f"store={self.store}",
            f"checkpoints={self.checkpoints}", f"run={self.name(regime, seed)}",
        ]  # fmt: skip


def make(plan: Plan, wanted: tuple[str, int], threads: int) -> None:
    """Train and measure one student, and keep its answers."""
    regime, seed = wanted
    if regime != "zero-shot":
        run(plan.trained(regime, seed), threads)
    measured = plan.checkpoints / "select" / plan.name(regime, seed)
    if not (measured / "metrics.json").exists():
        run(plan.measured(regime, seed), threads)
    keep(plan, regime, measured / "answers.jsonl", plan.kept(regime, seed))


def keep(plan: Plan, regime: str, answers: Path, path: Path) -> None:
    """Write what a student answered to every test item, in a column a mode."""
    cfg = compose("evaluation.select", SelectCommand, [f"benchmark={plan.benchmark}"])
    rows = [json.loads(line) for line in answers.read_text().splitlines()]
    told = [row for row in rows if "item_id" in row]
    letters = {(row["item_id"], row["mode"]): row["letter"] or UNREAD for row in told}
    modes = MODES.get(regime, BOTH)
    lines = [",".join(["item_id", "family", "scene_id", "right", *modes])]
    for item in open_store(Path(plan.store) / cfg.benchmark.name).selection("test"):
        given = [letters[item.item_id, mode] for mode in modes]
        lines.append(",".join([item.item_id, item.family, item.scene_id, item.letter, *given]))
    path.parent.mkdir(parents=True, exist_ok=True)
    write_text(path, "\n".join(lines) + "\n")


Row = dict[str, str]
"""An item and what a student answered, by the names of the columns."""


def kept_rows(plan: Plan, regime: str, seed: int) -> list[Row]:
    """
    Raises:
        SystemExit: the run has not been made.
    """
    path = plan.kept(regime, seed)
    if not path.exists():
        raise SystemExit(f"error: {path} is not there: run without --table, or with fewer --seeds")
    with path.open(newline="") as file:
        return list(csv.DictReader(file))


Group = tuple[str, str]
"""A regime, and a mode in which its students are asked."""


def print_table(plan: Plan, seeds: Sequence[int]) -> None:
    items = kept_rows(plan, "zero-shot", 0)
    right: dict[Group, np.ndarray] = {}
    for regime, used in [("zero-shot", (0,)), *((regime, seeds) for regime in REGIMES)]:
        runs = [kept_rows(plan, regime, seed) for seed in used]
        for mode in MODES.get(regime, BOTH):
            right[regime, mode] = np.stack([answered(rows, mode) for rows in runs], axis=1)
    print(f"\n{len(items)} test items, {len(seeds)} seeds")
    print("| | asked for | " + " | ".join([*FAMILIES, "macro", "parsed"]) + " |")
    print("|---" * (len(FAMILIES) + 4) + "|")
    for (regime, mode), values in right.items():
        cells = [figure(values[..., 0], items, [family]) for family in FAMILIES]
        cells += [figure(values[..., 0], items, FAMILIES), f"{100 * values[..., 1].mean():.1f}"]
        print(f"| {regime} | {mode} | " + " | ".join(cells) + " |", flush=True)
    print("\n| difference | " + " | ".join([*FAMILIES, "macro"]) + " |")
    print("|---" * (len(FAMILIES) + 2) + "|")
    for one, two in PAIRS:
        apart = right[one][..., 0].mean(axis=1) - right[two][..., 0].mean(axis=1)
        cells = [figure(apart[:, None], items, [f], "+") for f in FAMILIES]
        cells.append(figure(apart[:, None], items, FAMILIES, "+"))
        print(f"| {' '.join(one)} less {' '.join(two)} | " + " | ".join(cells) + " |", flush=True)


def answered(rows: Sequence[Row], mode: str) -> np.ndarray:
    """(items, 2) whether a student's answers are right, and whether they can be read."""
    return np.array([(row[mode] == row["right"], row[mode] != UNREAD) for row in rows], float)


def figure(
    values: np.ndarray, items: Sequence[Row], families: Sequence[str], sign: str = ""
) -> str:
    """The mean of families' means over items and seeds (items, seeds), with its interval, in
    percent."""
    kept = [k for k, item in enumerate(items) if item["family"] in families]
    of = [(items[k]["family"], items[k]["scene_id"]) for k in kept]
    found = macro_by_scene(values[kept].mean(axis=1), *zip(*of, strict=True), seed=0)
    shares = (found.value, found.low, found.high)
    mean, low, high = (f"{100 * share:{sign}.1f}" for share in shares)
    return f"{mean} [{low}, {high}]"


if __name__ == "__main__":
    main()
