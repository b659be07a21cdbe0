"""Compares ways to train a student at tiny scale, on more than a thousand test items: zero-shot,
answers alone, rationales in the paper's vocabulary and in relational words, and the latter without
the candidate analysis, without the match layout, or with facts that are not the simulator's.

    python -m research.experiments.regimes            # train and evaluate what is missing
    python -m research.experiments.regimes --table    # print the recorded results

`--benchmark comparison_balanced` measures on balanced items. Every chosen letter is recorded in
`letters.parquet`, one row per test item, run, mode and control, with the hash of the base's
weights and what the response claims. Accuracies are means over three seeds; intervals are 95%
percentile intervals of a bootstrap that resamples scenes and seeds.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import pandas as pd

from dynapix.conf.compose import compose
from dynapix.conf.failures import report_failures
from dynapix.conf.schema import SftCommand
from dynapix.conf.schema.benchmark import MATCHED_ANCHOR
from dynapix.data.records import FAMILIES
from dynapix.data.store import Store
from dynapix.data.versions import BUILDERS
from dynapix.evaluation.metrics.seeds import MACRO, SeedBootstrap
from dynapix.evaluation.metrics.selection import baseline_results
from dynapix.models.fingerprints import weights_digest
from dynapix.teacher.narrator import NARRATOR_VERSION
from dynapix.teacher.predicates.vocabulary import VERSIONS
from dynapix.teacher.validation.reasons import PARTS
from research.experiments.experiment import (
    Experiment,
    Job,
    create_parser,
    open_benchmark,
    print_header,
    print_row,
    read_item_responses,
    training_key,
)
from research.experiments.records import (
    HORIZONS,
    bootstrap,
    count_claims,
    credit_matrix,
    format_cells,
    format_percent,
    horizon_accuracies,
)

RECORD = Path(__file__).with_name("letters.parquet")
BOTH = ("reasoning", "answer")
RELATIONAL = "teacher.predicates=relational"
SHARED = ("train.evaluations=1",)
"""Overrides of every training."""
EVALUATION = ("batch=64",)
"""Overrides of every evaluation."""
STEPS = "train.max_steps=100"
"""Number of steps of the students that learn rationales."""
ANSWER_STEPS = "train.max_steps=600"
"""Number of steps on answers alone. For the first 300, the loss is that of a random letter."""
LONG_STEPS = "train.max_steps=300"
"""Number of steps on rationales that take about as long as `ANSWER_STEPS`."""
ZERO_SHOT = "zero-shot"
EXTRAPOLATED, SHUFFLED = "relational CoT, extrapolated facts", "relational CoT, shuffled facts"
"""Students of ungrounded rationales (`teacher.grounding`)."""
WEIGHED = "relational CoT, samples weighed"
"""The student whose loss is a mean over samples instead of tokens."""
UNCHANGED = "none"
CONTROLS = ("candidate_only", "shuffled_prefix", MATCHED_ANCHOR)
"""Overlays of `evaluation.select`: without the prefix, with its frames shuffled, and on pairs of
items whose question names the target's moment by an event or by a time."""


@dataclass(frozen=True)
class Variant:
    """A way to train a student.

    Attributes:
        training: Overrides of `train.sft`; None leaves the base untrained.
        modes: Modes of its evaluation.
        controls: Whether its first seed is also evaluated under `CONTROLS`.
    """

    training: tuple[str, ...] | None
    modes: tuple[str, ...] = BOTH
    controls: bool = False


VARIANTS = {
    ZERO_SHOT: Variant(None),
    "answers alone": Variant(("+exp=answer_only", ANSWER_STEPS), ("answer",), controls=True),
    "CoT": Variant(("+exp=cot", STEPS)),
    "relational CoT": Variant(("+exp=cot", STEPS, RELATIONAL), controls=True),
    "relational CoT, 300 steps": Variant(("+exp=cot", LONG_STEPS, RELATIONAL)),
    "relational CoT without candidate analysis": Variant(
        ("+exp=cot_no_candidate_analysis", STEPS, RELATIONAL)
    ),
    "relational CoT without match layout": Variant(("+exp=cot_no_match_layout", STEPS, RELATIONAL)),
    EXTRAPOLATED: Variant(("+exp=cot", STEPS, RELATIONAL, "teacher.grounding=extrapolated")),
    SHUFFLED: Variant(("+exp=cot", STEPS, RELATIONAL, "teacher.grounding=shuffled")),
    WEIGHED: Variant(("+exp=cot", STEPS, RELATIONAL, "train.weighting=sample")),
}
MAIN = ("relational CoT", "reasoning")
"""A variant and a mode."""
PAIRS = (
    (MAIN, ("answers alone", "answer")),
    (("relational CoT, 300 steps", "reasoning"), ("answers alone", "answer")),
    (("relational CoT, 300 steps", "reasoning"), MAIN),
    (MAIN, ("CoT", "reasoning")),
    (MAIN, ("relational CoT", "answer")),
    (MAIN, ("relational CoT without candidate analysis", "reasoning")),
    (MAIN, ("relational CoT without match layout", "reasoning")),
    (MAIN, (ZERO_SHOT, "reasoning")),
    (("CoT", "reasoning"), ("answers alone", "answer")),
    (("relational CoT", "answer"), ("answers alone", "answer")),
    (MAIN, (EXTRAPOLATED, "reasoning")),
    (MAIN, (SHUFFLED, "reasoning")),
    ((EXTRAPOLATED, "reasoning"), ("answers alone", "answer")),
    ((WEIGHED, "reasoning"), MAIN),
    ((WEIGHED, "answer"), ("relational CoT", "answer")),
)
"""The variants and modes that the second table compares: first minus second."""


def main() -> None:
    parser = create_parser(__doc__, "comparison", RECORD)
    parser.add_argument("--student", default="tiny")
    parser.add_argument("--variants", nargs="+", choices=[*VARIANTS], default=[*VARIANTS])
    args = parser.parse_args()
    overrides = [f"student={args.student}", f"benchmark={args.benchmark}", *SHARED]
    base = weights_digest(compose("train.sft", SftCommand, overrides).student.model)
    # Results of other settings, other items or other rationales are not reused.
    versions = {"builders": BUILDERS, "narrator": NARRATOR_VERSION, "words": VERSIONS}
    settings = {
        name: training_key("train.sft", SftCommand, [*(v.training or ()), *overrides], versions)
        for name, v in VARIANTS.items()
    }
    experiment = Experiment(args, base, settings)

    def evaluate(job: Job) -> list[dict[str, Any]]:
        (variant_name, seed), student = job, f"student={args.student}"
        variant = VARIANTS[variant_name]
        run = experiment.run_name(*job)
        if variant.training is None:
            model = student
        else:
            training = [*variant.training, f"seed={seed}", student, *SHARED]
            trained = experiment.train("train.sft", run, [*training, *experiment.shared_overrides])
            # A trained student is evaluated with the settings of its training.
            model = f"model={trained}"
        # The default modes ask a base for a structured record, which the tiny base cannot write.
        modes = f"modes=[{','.join(variant.modes)}]"
        evaluation = [*EVALUATION, modes, model]
        store, rows = open_benchmark(Path(args.store), args.benchmark), []
        controls = [c for c in CONTROLS if c != MATCHED_ANCHOR or store.selection("test", c)]
        for control in (UNCHANGED, *(controls if variant.controls and seed == 0 else ())):
            name, overlay = run, []
            if control != UNCHANGED:
                name, overlay = f"{run}-{control}", [f"+exp={control}"]
            folder = experiment.evaluate("evaluation.select", name, [*evaluation, *overlay])
            rows += read_letters(folder, store, control, variant.modes)
        return rows

    # Sorted by seed, so that an interrupted experiment has fewer seeds of every variant.
    trained = [name for name in args.variants if name != ZERO_SHOT]
    jobs = [(ZERO_SHOT, 0)] if ZERO_SHOT in args.variants else []
    jobs += [(name, seed) for seed in range(args.seeds) for name in trained]
    print_tables(experiment.run(jobs, evaluate), open_benchmark(Path(args.store), args.benchmark))


def read_letters(
    folder: Path, store: Store, control: str, modes: Sequence[str]
) -> list[dict[str, Any]]:
    """Return the rows of a run: the chosen letter for each test item in each mode, and what the
    response claims."""
    suite = MATCHED_ANCHOR if control == MATCHED_ANCHOR else None
    asked = None if suite or control == UNCHANGED else control
    rows = []
    for mode in modes:
        responses = read_item_responses(folder, mode, asked)
        for item in store.selection("test", suite):
            response = responses[item.item_id]
            row = {
                "mode": mode, "control": control, "item_id": item.item_id, "family": item.family,
                "scene_id": item.scene_id, "answer": item.letter, "letter": response.letter,
            }  # fmt: skip
            if mode == "reasoning" and control == UNCHANGED:
                row |= dict(count_claims(item, response, store))
            rows.append(row)
    return rows


def print_tables(table: pd.DataFrame, store: Store) -> None:
    """Print the accuracies of variants and modes, those of strategies that learn nothing, the
    differences, the controls, and what the responses claim, in percent."""
    unchanged = table[table.control == UNCHANGED]
    groups = [(name, mode) for name, v in VARIANTS.items() for mode in v.modes]
    correct = {g: credit_matrix(unchanged, *g) for g in groups}
    correct = {group: credits for group, credits in correct.items() if credits.shape[1]}
    resampling = bootstrap(next(iter(correct.values())))
    print_accuracies(unchanged, correct, resampling)
    print_baselines(store)
    print_differences(correct, resampling)
    print_controls(table, correct, resampling)
    print_claims(unchanged)


def print_accuracies(
    table: pd.DataFrame, correct: dict[tuple[str, str], pd.DataFrame], resampling: SeedBootstrap
) -> None:
    horizons = [f"time, {horizon}" for horizon in HORIZONS]
    print_header("", "mode", *FAMILIES, "macro", *horizons, "by seed", "parsed")
    for (name, mode), credits in correct.items():
        rows = table[(table.variant == name) & (table["mode"] == mode)]
        cells = format_cells(resampling.accuracies(name, credits.to_numpy()))
        cells += format_cells(horizon_accuracies(table, name, mode), HORIZONS)
        macros = [credits[seed].groupby("family").mean().mean() for seed in credits]
        by_seed = " ".join(f"{100 * macro:.1f}" for macro in macros)
        print_row(name, mode, *cells, by_seed, f"{100 * rows.letter.notna().mean():.1f}")


def print_baselines(store: Store) -> None:
    print_header("strategy", *FAMILIES, "macro")
    for row in baseline_results(store.selection("test"), store, seed=0):
        found = [row.metrics.get(name) for name in (*FAMILIES, "macro")]
        print_row(row.name, *("-" if x is None else f"{100 * x:.1f}" for x in found))


def print_differences(
    correct: dict[tuple[str, str], pd.DataFrame], resampling: SeedBootstrap
) -> None:
    print_header("difference", *FAMILIES, "macro")
    for first, second in PAIRS:
        if first in correct and second in correct:
            pair = [(group[0], correct[group].to_numpy()) for group in (first, second)]
            title = f"{', '.join(first)} minus {', '.join(second)}"
            print_row(title, *format_cells(resampling.differences(*pair), sign="+"))


def print_controls(
    table: pd.DataFrame, correct: dict[tuple[str, str], pd.DataFrame], resampling: SeedBootstrap
) -> None:
    """Print the macro accuracy of the first seed under the controls and its difference from the
    unchanged items, and the accuracies on matched-anchor pairs by what names the moment."""
    controls = [control for control in CONTROLS if control != MATCHED_ANCHOR]
    print_header("macro, first seed", "unchanged", *controls, "pairs, event", "pairs, time")
    for (name, mode), credits in correct.items():
        if not VARIANTS[name].controls or 0 not in credits:
            continue
        first = credits[[0]]
        cells = [f"{100 * resampling.accuracies(name, first.to_numpy())[MACRO].value:.1f}"]
        for control in controls:
            changed = credit_matrix(table[table.control == control], name, mode)
            pair = [(name, credits.to_numpy()) for credits in (changed, first)]
            difference = format_percent(resampling.differences(*pair)[MACRO], "+")
            mean = resampling.accuracies(*pair[0])[MACRO].value
            cells.append(f"{100 * mean:.1f} ({difference})")
        pairs = credit_matrix(table[table.control == MATCHED_ANCHOR], name, mode)
        by_family = pairs.groupby("family").mean().mean(axis=1)
        cells += [f"{100 * by_family[f]:.1f}" if len(pairs) else "-" for f in ("event", "time")]
        print_row(f"{name}, {mode}", *cells)


def print_claims(table: pd.DataFrame) -> None:
    """Print how many claims the responses in reasoning mode make, and the shares of them that the
    oracle supports."""
    if "follows" not in table:
        return
    reasoning = table[(table["mode"] == "reasoning") & table.follows.notna()]
    columns = [f"{part}: claims, true" for part in PARTS]
    print_header("claims", *columns, "answer follows", "right for true reasons")
    for name in VARIANTS:
        rows = reasoning[reasoning.variant == name]
        if len(rows):
            cells = []
            for part in PARTS:
                claims, supported = rows[f"{part}_claims"].sum(), rows[f"{part}_supported"].sum()
                share = f"{100 * supported / claims:.1f}" if claims else "-"
                cells.append(f"{claims / len(rows):.1f}, {share}")
            shares = (rows.follows.astype(float), rows.true_reasons.astype(float))
            print_row(name, *cells, *(f"{100 * share.mean():.1f}" for share in shares))


if __name__ == "__main__":
    with report_failures():
        main()
