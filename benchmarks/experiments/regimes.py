"""Compares the paper's training regimes at tiny scale: zero-shot, answer-only, CoT, CoT without the
candidate analysis, and CoT without the match layout, on more than a thousand test items.

    python -m benchmarks.experiments.regimes            # train and evaluate what is missing
    python -m benchmarks.experiments.regimes --table    # print the recorded results

Every chosen letter is recorded in `letters.parquet`, one row per test item, run and mode, together
with the hash of the base's weights. Accuracies are means over three seeds; intervals are 95%
percentile intervals of a bootstrap that resamples scenes and seeds.
"""

from __future__ import annotations

import json
from pathlib import Path
from typing import Any

import numpy as np
import pandas as pd

from benchmarks.experiments.experiment import Experiment, Job, create_parser
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
"""The modes in which each regime is evaluated. Zero-shot decodes greedily, so it has one seed."""
PAIRS = (
    (("cot", "reasoning"), ("answer_only", "answer")),
    (("cot", "answer"), ("answer_only", "answer")),
    (("cot", "reasoning"), ("cot", "answer")),
    (("cot", "reasoning"), ("cot_no_candidate_analysis", "reasoning")),
    (("cot", "reasoning"), ("cot_no_match_layout", "reasoning")),
    (("cot", "reasoning"), ("zero-shot", "reasoning")),
)
"""The regimes and modes that the second table compares: first minus second."""
DRAWS = 4000
"""Number of bootstrap samples."""


def main() -> None:
    parser = create_parser(__doc__, "comparison", LETTERS)
    parser.add_argument("--student", default="tiny")
    args = parser.parse_args()
    preset = compose("train.sft", SftCommand, [f"student={args.student}"]).student
    base = weights_digest(preset.model)
    identity = {"base": base, "benchmark": args.benchmark}
    experiment = Experiment(args, identity, "regime", "train.sft", "evaluation.select")

    def evaluate(job: Job) -> list[dict[str, Any]]:
        regime, seed = job
        student = f"student={args.student}"
        training = [f"+exp={regime}", f"seed={seed}", student]
        # The default modes ask a base for a structured record, which the tiny base cannot write.
        zero_shot = regime == "zero-shot"
        folder = experiment.train_and_evaluate(
            f"{args.benchmark}-{base[:8]}-{regime}-{seed}",
            None if zero_shot else training,
            [student, "batch=64", *(["modes=[reasoning,answer]"] if zero_shot else [])],
        )
        return read_letters(folder, Path(args.store), args.benchmark, regime)

    # Sorted by seed, so that an interrupted experiment has fewer seeds of every regime.
    trained = [regime for regime in MODES if regime != "zero-shot"]
    jobs = [("zero-shot", 0), *((r, seed) for seed in range(args.seeds) for r in trained)]
    print_tables(experiment.run(jobs, evaluate))


def read_letters(folder: Path, store: Path, benchmark: str, regime: str) -> list[dict[str, Any]]:
    """Return the rows of a run: the chosen letter for each test item in each mode."""
    cfg = compose("evaluation.select", SelectCommand, [f"benchmark={benchmark}"]).benchmark
    lines = [json.loads(line) for line in (folder / "answers.jsonl").read_text().splitlines()]
    letters = {(r["item_id"], r["mode"]): r["letter"] for r in lines if "item_id" in r}
    return [
        {
            "mode": mode, "item_id": item.item_id, "family": item.family,
            "scene_id": item.scene_id, "answer": item.letter, "letter": letters[item.item_id, mode],
        }
        for item in open_store(store / cfg.name).selection("test")
        for mode in MODES[regime]
    ]  # fmt: skip


def print_tables(table: pd.DataFrame) -> None:
    """Print the accuracies of regimes and modes, then the differences in `PAIRS`, in percent."""
    groups = [(regime, mode) for regime in MODES for mode in MODES[regime]]
    correct = {g: credit_matrix(table, *g) for g in groups}
    correct = {group: credits for group, credits in correct.items() if credits.shape[1]}
    resampling = Resampling(next(iter(correct.values())).index)
    print("| | mode | " + " | ".join(FAMILIES) + " | macro | by seed | parsed |")
    print("|---" * (len(FAMILIES) + 5) + "|")
    for (regime, mode), credits in correct.items():
        rows = table[(table.regime == regime) & (table["mode"] == mode)]
        seeds = [100 * resampling.means(credits[[seed]])[-1] for seed in credits]
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
    """Return 1 for each right answer and 0 for each wrong one, (items, seeds)."""
    rows = table[(table.regime == regime) & (table["mode"] == mode)]
    credits = (rows.letter == rows.answer).astype(float)
    return credits.groupby([rows.family, rows.scene_id, rows.item_id, rows.seed]).sum().unstack()


class Resampling:
    """A bootstrap over scenes and seeds of the accuracy in each family and their mean, the macro.

    All regimes share the resampled scenes. Their seeds are resampled independently, since runs of
    two regimes with the same seed have nothing in common but its number.
    """

    def __init__(self, items: pd.MultiIndex) -> None:
        families = items.get_level_values("family")
        self._scene, scenes = pd.factorize(items.get_level_values("scene_id"))
        self._members = [families == family for family in FAMILIES]
        self._rng = np.random.default_rng(0)
        share = np.full(len(scenes), 1 / len(scenes))
        # (draws, scenes) how often each draw contains each scene.
        self._weights = self._rng.multinomial(len(scenes), share, size=DRAWS).astype(float)

    def means(self, credits: pd.DataFrame) -> np.ndarray:
        """Return (families + 1,) means over all items and seeds: of each family, and the macro."""
        means = [credits[members].to_numpy().mean() for members in self._members]
        return np.array([*means, np.mean(means)])

    def intervals(
        self, first: pd.DataFrame, second: pd.DataFrame | None = None
    ) -> list[tuple[float, float, float]]:
        """Return the mean and the bounds of its interval, in percent, for each family and the macro
        of `first`, or of the difference `first` minus `second`."""
        means, draws = self.means(first), self._draws(first)
        if second is not None:
            means, draws = means - self.means(second), draws - self._draws(second)
        low, high = np.percentile(draws, [2.5, 97.5], axis=0)
        return [tuple(100 * np.array(t)) for t in zip(means, low, high, strict=True)]

    def _draws(self, credits: pd.DataFrame) -> np.ndarray:
        """Return the means of each draw, (draws, families + 1)."""
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
