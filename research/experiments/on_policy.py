"""Compares training on a student's own responses with training on more rationales, at tiny scale.

    python -m research.experiments.on_policy            # train and evaluate what is missing
    python -m research.experiments.on_policy --table    # print the recorded results

The variants are

    relational CoT               the student of `research.experiments.regimes`, 100 steps
    relational CoT, 300 steps    the same, for about as much compute as the next two
    distillation                 the student, trained further by `train.distill`, towards a teacher
    rewards                      the student, trained further by `train.reinforce`
    rewarded claims              the same, where each claim gets its own reward

The runs of the first two are those of `research.experiments.regimes`, whichever runs first. All
seeds have the same teacher: the base, all of whose weights `train.sft` has trained with the facts
in the prompt. With adapters alone, it does not learn in 100 steps to read the facts.

The record, `on_policy.parquet`, has a row per test item and run. The first table has accuracies in
percent, with 95% intervals over scenes and seeds, and minutes of CPU time of all trainings that a
variant needs, those of the student and the teacher included ("-" if one was interrupted). The
second table has differences: those from the student compare the runs of each seed, since these
runs continue this student. The third one describes the responses: the share of their claims that
the oracle supports; answers that follow from the response; responses that state a number; distinct
4-grams, as a share of all 4-grams; and, of the claims about the prefix and the prediction,
the share about objects that are out of view at the cut.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Sequence
from pathlib import Path
from typing import Any

import pandas as pd

from dynapix.conf.compose import compose
from dynapix.conf.failures import report_failures
from dynapix.conf.schema import DistillCommand, ReinforceCommand, SftCommand
from dynapix.data.records import FAMILIES
from dynapix.data.store import Store
from dynapix.data.versions import BUILDERS
from dynapix.models.fingerprints import settings_key, weights_digest
from dynapix.teacher.narrator import NARRATOR_VERSION
from dynapix.teacher.numbers.detection import find_numbers
from dynapix.teacher.predicates.vocabulary import VERSIONS
from dynapix.teacher.validation.reasons import PARTS
from research.experiments.experiment import (
    MINUTES,
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
    horizon_accuracies,
)
from research.experiments.regimes import BOTH, EVALUATION, SHARED
from research.experiments.regimes import VARIANTS as REGIMES

RECORD = Path(__file__).with_name("on_policy.parquet")
STUDENT, LONGER, DISTILLATION, REWARDS, CLAIMS = (
    "relational CoT", "relational CoT, 300 steps", "distillation", "rewards", "rewarded claims"
)  # fmt: skip
VARIANTS = (STUDENT, LONGER, DISTILLATION, REWARDS, CLAIMS)
TEACHER = "teacher with facts"
SFT = {
    **{name: [*(REGIMES[name].training or ()), *SHARED] for name in (STUDENT, LONGER)},
    TEACHER: [
        "+exp=cot", "teacher.predicates=relational", "train.facts=true", *SHARED,
        "student.lora.rank=0", "train.reuse_features=false",
        "train.lr=1e-3", "train.batch=8", "train.max_steps=600",
    ],
}  # fmt: skip
"""Overrides of `train.sft` by variant, and those of the teacher."""
DISTILL = ["+exp=on_policy", "train.lr=1e-3", "train.max_steps=60", "train.evaluations=2"]
REWARDED = ["+exp=grpo", "train.lr=3e-4", "train.max_steps=20", "train.evaluations=2"]
REINFORCE = {REWARDS: REWARDED, CLAIMS: [*REWARDED, "train.credit=claims"]}
"""Overrides of `train.reinforce` by variant."""


def main() -> None:
    parser = create_parser(__doc__, "comparison", RECORD)
    parser.add_argument("--variants", nargs="+", choices=VARIANTS, default=VARIANTS)
    args = parser.parse_args()
    base = compose("train.sft", SftCommand, [f"benchmark={args.benchmark}"]).student.model
    settings = settings_keys(args.benchmark)
    experiment = Experiment(args, weights_digest(base), settings)

    def run_variant(job: Job) -> list[dict[str, Any]]:
        trained = train_variant(experiment, *job)
        overrides = [f"model={trained[-1]}", f"modes=[{','.join(BOTH)}]", *EVALUATION]
        folder = experiment.evaluate("evaluation.select", experiment.run_name(*job), overrides)
        minutes = sum_minutes(trained)
        rows = [*read_rows(folder, open_benchmark(Path(args.store), args.benchmark))]
        distinct = share_of_distinct_4grams([row.pop("text") for row in rows])
        return [{"cpu_minutes": minutes, "distinct_4grams": distinct, **row} for row in rows]

    jobs = [(variant, seed) for seed in range(args.seeds) for variant in args.variants]
    results = experiment.run(jobs, run_variant)
    print_accuracies(results)
    print_responses(results)


def settings_keys(benchmark: str) -> dict[str, str]:
    """Return the key of each variant's settings: those of all trainings that it needs."""
    versions = {"builders": BUILDERS, "narrator": NARRATOR_VERSION, "words": VERSIONS}
    keys = {
        name: training_key("train.sft", SftCommand, [*sft, f"benchmark={benchmark}"], versions)
        for name, sft in SFT.items()
    }
    distill = training_key("train.distill", DistillCommand, [*DISTILL, "model=none"], versions)
    reinforced = {
        name: training_key("train.reinforce", ReinforceCommand, [*own, "model=none"], versions)
        for name, own in REINFORCE.items()
    }
    return keys | {
        DISTILLATION: settings_key([keys[STUDENT], keys[TEACHER], distill]),
        **{name: settings_key([keys[STUDENT], key]) for name, key in reinforced.items()},
    }


def train_variant(experiment: Experiment, variant: str, seed: int) -> list[Path]:
    """Train what is missing of a variant, and return the folders of its trainings: the last one has
    the student to evaluate."""
    args = experiment.args

    def train_model(variant: str, seed: int) -> Path:
        overrides = [*SFT[variant], f"seed={seed}", *experiment.shared_overrides]
        return experiment.train("train.sft", experiment.run_name(variant, seed), overrides)

    if variant in SFT:
        return [train_model(variant, seed)]
    student, name = train_model(STUDENT, seed), experiment.run_name(variant, seed)
    further = [
        f"model={student}", f"seed={seed}", f"store={args.store}", f"checkpoints={args.checkpoints}"
    ]  # fmt: skip
    if variant in REINFORCE:
        overrides = [*REINFORCE[variant], *further]
        return [student, experiment.train("train.reinforce", name, overrides)]
    teacher = train_model(TEACHER, 0)
    overrides = [*DISTILL, f"teacher_model={teacher}", *further]
    return [student, teacher, experiment.train("train.distill", name, overrides)]


def sum_minutes(trained: Sequence[Path]) -> float | None:
    """Return the minutes of CPU time of several trainings, or None if one was interrupted."""
    files = [folder / MINUTES for folder in trained]
    return sum(float(f.read_text()) for f in files) if all(f.exists() for f in files) else None


def read_rows(folder: Path, store: Store) -> Iterator[dict[str, Any]]:
    """Yield a row for each test item of an evaluation: the chosen letter, the response, and what it
    claims."""
    responses = read_item_responses(folder, "reasoning")
    for item in store.selection("test"):
        response = responses[item.item_id]
        yield {
            "mode": "reasoning", "item_id": item.item_id, "family": item.family,
            "scene_id": item.scene_id, "answer": item.letter,
            "letter": response.letter, "numbers": bool(find_numbers(response.text)),
            "text": response.text,
        } | dict(count_claims(item, response, store))  # fmt: skip


def print_accuracies(results: pd.DataFrame) -> None:
    """Print the accuracy of each variant by family, and of the time family by horizon; and the
    differences between variants."""
    credits = {v: credit_matrix(results, v, "reasoning") for v in VARIANTS}
    credits = {variant: matrix for variant, matrix in credits.items() if matrix.shape[1]}
    resampling = bootstrap(next(iter(credits.values())))
    print_header("", *FAMILIES, "macro", *HORIZONS, "seeds", "CPU minutes")
    for variant, matrix in credits.items():
        rows = results[results.variant == variant]
        cells = format_cells(resampling.accuracies(variant, matrix.to_numpy()))
        cells += format_cells(horizon_accuracies(results, variant, "reasoning"), HORIZONS)
        minutes = rows.groupby("seed").cpu_minutes.first().astype(float).mean()
        print_row(variant, *cells, matrix.shape[1], "-" if pd.isna(minutes) else f"{minutes:.0f}")
    print_header("difference", *FAMILIES, "macro")
    for variant in (DISTILLATION, REWARDS, CLAIMS):
        for other in (LONGER, STUDENT):
            if {variant, other} <= {*credits}:
                first, second = credits[variant].align(credits[other], join="inner", axis=1)
                # Variants with one name share the resampled seeds.
                name = other if other == STUDENT else variant
                pair = (name, first.to_numpy()), (other, second.to_numpy())
                cells = format_cells(resampling.differences(*pair), sign="+")
                print_row(f"{variant} minus {other}", *cells)


def print_responses(results: pd.DataFrame) -> None:
    """Print what the responses of each variant are like, in percent."""
    print_header(
        "", "claims per response", "supported", "answer follows", "right for true reasons",
        "with numbers", "distinct 4-grams", "about objects out of view",
    )  # fmt: skip
    for variant in VARIANTS:
        rows = results[(results.variant == variant) & results.follows.notna()]
        if rows.empty:
            continue
        claims = sum(rows[f"{part}_claims"].sum() for part in PARTS)
        shares = (
            sum(rows[f"{part}_supported"].sum() for part in PARTS) / claims,
            rows.follows.astype(float).mean(),
            rows.true_reasons.astype(float).mean(),
            rows.numbers.mean(),
            rows.groupby("seed").distinct_4grams.first().mean(),
            rows.unseen_claims.sum() / (rows.prefix_claims + rows.prediction_claims).sum(),
        )
        cells = [f"{100 * share:.1f}" for share in shares]
        print_row(variant, f"{claims / len(rows):.1f}", *cells)


def share_of_distinct_4grams(texts: Sequence[str]) -> float:
    """Return the number of distinct 4-grams (sequences of four words), as a share of all in the
    texts."""
    words = [re.findall(r"[\w-]+", text.lower()) for text in texts]
    sequences = [tuple(w[k : k + 4]) for w in words for k in range(len(w) - 3)]
    return len(set(sequences)) / len(sequences) if sequences else 0.0


if __name__ == "__main__":
    with report_failures():
        main()
