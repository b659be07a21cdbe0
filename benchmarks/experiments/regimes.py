"""The paper's comparison of training regimes at tiny scale: zero-shot, answer-only, CoT, and CoT
without each of its parts, three seeds each, on more than a thousand test items.

    python -m benchmarks.experiments.regimes            # train and evaluate what is missing
    python -m benchmarks.experiments.regimes --table    # print the recorded results

Every chosen letter is recorded in `letters.parquet`, one row per test item, run and mode, under the
hash of the base's weights. A run that is recorded is not trained again. Accuracies are means over
the seeds; intervals are 95% percentile intervals of a bootstrap that resamples scenes and seeds.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from threading import Lock

import numpy as np
import pandas as pd

from benchmarks.experiments.jobs import run, run_all
from conf.compose import compose
from conf.schema import SelectCommand, SftCommand
from data.records import FAMILIES
from data.store import open_store
from models.fingerprints import weights_digest

LETTERS = Path(__file__).with_name("letters.parquet")
MODES = {
    "zero-shot": ("reasoning", "answer"),
    "answer_only": ("answer",),
    "cot": ("reasoning", "answer"),
    "cot_no_candidate_analysis": ("reasoning", "answer"),
    "cot_no_match_layout": ("reasoning", "answer"),
}
"""The modes in which each regime is evaluated. Zero-shot decoding is greedy and has one seed."""
PAIRS = (
    (("cot", "reasoning"), ("answer_only", "answer")),
    (("cot", "answer"), ("answer_only", "answer")),
    (("cot", "reasoning"), ("cot", "answer")),
    (("cot", "reasoning"), ("cot_no_candidate_analysis", "reasoning")),
    (("cot", "reasoning"), ("cot_no_match_layout", "reasoning")),
    (("cot", "reasoning"), ("zero-shot", "reasoning")),
)
"""The differences in the second table: first minus second."""
DRAWS = 4000
WRITING = Lock()


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n\n")[0])
    parser.add_argument("--benchmark", default="comparison")
    parser.add_argument("--student", default="tiny")
    parser.add_argument("--store", default="store")
    parser.add_argument("--checkpoints", default="checkpoints")
    parser.add_argument("--letters", type=Path, default=LETTERS, help="table of recorded answers")
    parser.add_argument("--jobs", type=int, default=1, help="runs at a time; they share the cores")
    parser.add_argument("--seeds", type=int, default=3)
    parser.add_argument("--table", action="store_true", help="only print the recorded results")
    args = parser.parse_args()
    preset = compose("train.sft", SftCommand, [f"student={args.student}"]).student
    experiment = Experiment(
        args.benchmark, args.student, args.store, Path(args.checkpoints), args.letters,
        base=weights_digest(preset.model),
    )  # fmt: skip
    if not args.table:
        run(["data.build", f"benchmark={args.benchmark}", f"store={args.store}"])
        # Seed by seed: a comparison over fewer seeds is complete early.
        trained = [regime for regime in MODES if regime != "zero-shot"]
        jobs = [("zero-shot", 0), *((r, seed) for seed in range(args.seeds) for r in trained)]
        run_all(partial(train_and_evaluate, experiment), experiment.missing(jobs), args.jobs)
    print_tables(experiment.recorded(args.seeds))


@dataclass(frozen=True)
class Experiment:
    """The compared runs and the table that records their answers."""

    benchmark: str
    student: str
    store: str
    checkpoints: Path
    letters: Path
    base: str

    def name(self, regime: str, seed: int) -> str:
        return f"{self.benchmark}-{self.base[:8]}-{regime}-{seed}"

    def missing(self, jobs: list[tuple[str, int]]) -> list[tuple[str, int]]:
        """The jobs whose answers are not recorded."""
        table = self.recorded()
        done = set(zip(table.regime, table.seed, strict=True))
        return [job for job in jobs if job not in done]

    def recorded(self, seeds: int | None = None) -> pd.DataFrame:
        """The recorded answers of this benchmark and base, of the first `seeds` seeds."""
        table = pd.read_parquet(self.letters)
        table = table[(table.base == self.base) & (table.benchmark == self.benchmark)]
        return table if seeds is None else table[table.seed < seeds]


def train_and_evaluate(experiment: Experiment, job: tuple[str, int], threads: int) -> None:
    """Train and evaluate one student, and record its letters."""
    regime, seed = job
    name = experiment.name(regime, seed)
    shared = [
        f"student={experiment.student}", f"benchmark={experiment.benchmark}",
        f"store={experiment.store}", f"checkpoints={experiment.checkpoints}", f"run={name}",
    ]  # fmt: skip
    # By default a base is prompted for the structured record, which the tiny base never learned.
    model = ["modes=[reasoning,answer]"]
    if regime != "zero-shot":
        run(["train.sft", f"+exp={regime}", f"seed={seed}", *shared], threads)
        model = [f"model={experiment.checkpoints / 'sft' / name}"]
    evaluated = experiment.checkpoints / "select" / name
    if not (evaluated / "metrics.json").exists():
        run(["evaluation.select", *model, "batch=64", *shared], threads)
    record_letters(experiment, regime, seed, evaluated / "answers.jsonl")


def record_letters(experiment: Experiment, regime: str, seed: int, answers: Path) -> None:
    """Append one run's letters to the table."""
    benchmark = compose("evaluation.select", SelectCommand, [f"benchmark={experiment.benchmark}"])
    items = open_store(Path(experiment.store) / benchmark.benchmark.name).selection("test")
    lines = [json.loads(line) for line in answers.read_text().splitlines()]
    letters = {(r["item_id"], r["mode"]): r["letter"] for r in lines if "item_id" in r}
    rows = [
        {
            "base": experiment.base, "benchmark": experiment.benchmark, "regime": regime,
            "seed": seed, "mode": mode, "item_id": item.item_id, "family": item.family,
            "scene_id": item.scene_id, "answer": item.letter,
            "letter": letters[item.item_id, mode],
        }
        for item in items
        for mode in MODES[regime]
    ]  # fmt: skip
    with WRITING:
        table = pd.concat([pd.read_parquet(experiment.letters), pd.DataFrame(rows)])
        table.to_parquet(experiment.letters, index=False, compression="zstd")


def print_tables(table: pd.DataFrame) -> None:
    """Print accuracies by regime and mode, then differences between them, in percent."""
    if table.empty:
        raise SystemExit("error: no answers are recorded for this base: run without --table")
    groups = [(regime, mode) for regime in MODES for mode in MODES[regime]]
    correct = {g: credit_matrix(table, *g) for g in groups}
    correct = {group: credits for group, credits in correct.items() if credits.shape[1]}
    resampling = Resampling(next(iter(correct.values())).index)
    print("| | mode | " + " | ".join(FAMILIES) + " | macro | by seed | parsed |")
    print("|---" * (len(FAMILIES) + 5) + "|")
    for (regime, mode), credits in correct.items():
        rows = table[(table.regime == regime) & (table["mode"] == mode)]
        seeds = [100 * resampling.point(credits[[seed]])[-1] for seed in credits]
        cells = [
            f"{m:.1f} [{low:.1f}, {high:.1f}]" for m, low, high in resampling.intervals(credits)
        ]
        cells += [" ".join(f"{s:.1f}" for s in seeds), f"{100 * rows.letter.notna().mean():.1f}"]
        print(f"| {regime} | {mode} | " + " | ".join(cells) + " |", flush=True)
    print("\n| difference | " + " | ".join(FAMILIES) + " | macro |")
    print("|---" * (len(FAMILIES) + 2) + "|")
    for first, second in PAIRS:
        if first in correct and second in correct:
            intervals = resampling.intervals(correct[first], correct[second])
            cells = [f"{m:+.1f} [{low:+.1f}, {high:+.1f}]" for m, low, high in intervals]
            title = f"{' '.join(first)} minus {' '.join(second)}"
            print(f"| {title} | " + " | ".join(cells) + " |", flush=True)


def credit_matrix(table: pd.DataFrame, regime: str, mode: str) -> pd.DataFrame:
    """Whether each answer is right: a row per item, a column per seed."""
    rows = table[(table.regime == regime) & (table["mode"] == mode)]
    credits = (rows.letter == rows.answer).astype(float)
    return credits.groupby([rows.family, rows.scene_id, rows.item_id, rows.seed]).sum().unstack()


class Resampling:
    """A bootstrap over scenes and seeds of the family means and of their plain mean, the macro.

    Compared runs share the resampled scenes. Their seeds are resampled independently, since runs
    of the same seed number have nothing else in common.
    """

    def __init__(self, items: pd.MultiIndex) -> None:
        families = items.get_level_values("family")
        self._scene, scenes = pd.factorize(items.get_level_values("scene_id"))
        self._members = [families == family for family in FAMILIES]
        self._rng = np.random.default_rng(0)
        share = np.full(len(scenes), 1 / len(scenes))
        # (draws, scenes): how often each draw holds each scene.
        self._weights = self._rng.multinomial(len(scenes), share, size=DRAWS).astype(float)

    def point(self, credits: pd.DataFrame) -> np.ndarray:
        """(families + 1,) the means over all items and seeds, and their macro."""
        means = [credits[members].to_numpy().mean() for members in self._members]
        return np.array([*means, np.mean(means)])

    def intervals(
        self, first: pd.DataFrame, second: pd.DataFrame | None = None
    ) -> list[tuple[float, float, float]]:
        """Mean, low and high, in percent, of each family and the macro of `first`, or of the
        difference `first` minus `second`."""
        point, draws = self.point(first), self._draws(first)
        if second is not None:
            point, draws = point - self.point(second), draws - self._draws(second)
        low, high = np.percentile(draws, [2.5, 97.5], axis=0)
        return [tuple(100 * np.array(t)) for t in zip(point, low, high, strict=True)]

    def _draws(self, credits: pd.DataFrame) -> np.ndarray:
        """(draws, families + 1)."""
        seeds = credits.shape[1]
        seed_shares = self._rng.multinomial(seeds, np.full(seeds, 1 / seeds), size=DRAWS) / seeds
        means = []
        for members in self._members:
            sums = np.zeros((self._weights.shape[1], seeds))
            np.add.at(sums, self._scene[members], credits[members].to_numpy())
            counts = np.bincount(self._scene[members], minlength=len(sums))
            totals = ((self._weights @ sums) * seed_shares).sum(axis=1)
            means.append(totals / (self._weights @ counts))
        return np.column_stack([*means, np.mean(means, axis=0)])


if __name__ == "__main__":
    main()
