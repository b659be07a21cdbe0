"""Compares training on a student's own responses with training on more rationales, at tiny scale.

    python -m benchmarks.experiments.on_policy            # train and evaluate what is missing
    python -m benchmarks.experiments.on_policy --table    # print the recorded results

The variants are

    student         `train.sft +exp=cot`
    longer SFT      the same with more epochs (`--epochs`)
    distillation    the student, trained further by `train.distill`, towards a teacher that
                    `train.sft` has trained with the facts in its prompt
    rewards         the student, trained further by `train.reinforce`

The record, `on_policy.parquet`, has a row per test item and run. The first table has accuracies in
percent, with 95% intervals over scenes and seeds, and minutes of CPU time: those of the trainings
that a variant needs besides the student, and for the first row those of the student, without
trainings that were interrupted. The second one describes the responses: the share of their claims
that the oracle supports; answers that follow from the response; responses that state a number;
different sequences of four words, as a share of all; and the share of claims about objects that are
out of view at the end of the observation, which only a reader of the facts can know.
"""

from __future__ import annotations

import re
import resource
from collections.abc import Iterator
from pathlib import Path
from typing import Any

import pandas as pd

from benchmarks.experiments.experiment import (
    Experiment,
    Job,
    create_parser,
    open_benchmark,
    print_header,
    print_row,
    read_item_responses,
    run_command,
    training_settings,
)
from benchmarks.experiments.records import Resampling, count_claims, credit_matrix
from conf.compose import compose
from conf.failures import report_failures
from conf.schema import DistillCommand, ReinforceCommand, SftCommand
from data.records import FAMILIES
from data.store import Store
from models.fingerprints import settings_key, weights_digest
from teacher.narrator import NARRATOR_VERSION
from teacher.numbers.detection import find_numbers
from teacher.validation.reasons import PARTS
from teacher.vocabulary import VERSIONS

RECORD = Path(__file__).with_name("on_policy.parquet")
SFT = ["+exp=cot", "teacher.predicates=relational"]
DISTILL, REWARDS = ["+exp=on_policy"], ["+exp=grpo"]
VARIANTS = ("student", "longer SFT", "distillation", "rewards")
HORIZONS = {"1 s": "in_1s", "2 s": "in_2s"}
"""Subtypes of the time family."""


def main() -> None:
    parser = create_parser(__doc__, "tiny", RECORD)
    parser.add_argument("--epochs", type=float, default=6, help="epochs of the longer SFT")
    args = parser.parse_args()
    overrides = [f"benchmark={args.benchmark}"]
    sft = training_settings("train.sft", SftCommand, [*SFT, *overrides])
    distill = training_settings("train.distill", DistillCommand, [*DISTILL, "model=none"])
    rewards = training_settings("train.reinforce", ReinforceCommand, [*REWARDS, "model=none"])
    versions = {"narrator": NARRATOR_VERSION, "words": VERSIONS, "epochs": args.epochs}
    base = weights_digest(compose("train.sft", SftCommand, overrides).student.model)
    settings = settings_key({"sft": sft, "distill": distill, "rewards": rewards} | versions)
    identity = {"base": base, "benchmark": args.benchmark, "settings": settings}
    experiment = Experiment(args, identity, "variant", "train.sft", "evaluation.select")
    prefix = f"on_policy-{args.benchmark}-{base[:8]}-{settings[:8]}"

    def run_variant(job: Job) -> list[dict[str, Any]]:
        variant, seed = job
        name = f"{prefix}-{variant.replace(' ', '_')}-{seed}"
        # What an interrupted training took before is not known.
        resumed = any(args.checkpoints.glob(f"*/{name}*"))
        started = cpu_minutes()
        model = train_variant(experiment, variant, name, f"{prefix}-student-{seed}", seed)
        minutes = None if resumed else cpu_minutes() - started
        shared = experiment.shared_overrides
        run_command([
            "evaluation.select", f"model={model}", "modes=[reasoning]", "batch=64", *shared,
            f"run={name}",
        ])  # fmt: skip
        store = open_benchmark(Path(args.store), args.benchmark)
        folder = args.checkpoints / "select" / name
        return [{"cpu_minutes": minutes, **row} for row in read_rows(folder, store)]

    jobs = [(variant, seed) for seed in range(args.seeds) for variant in VARIANTS]
    results = experiment.run(jobs, run_variant)
    print_accuracies(results)
    print_responses(results)


def train_variant(experiment: Experiment, variant: str, name: str, student: str, seed: int) -> Path:
    """Train a variant, and return the folder of its run.

    Args:
        name: Run of the variant.
        student: Run of the student that further training continues.
    """
    shared, checkpoints = experiment.shared_overrides, experiment.args.checkpoints
    source = checkpoints / "sft" / student
    where = [f"store={experiment.args.store}", f"checkpoints={checkpoints}", f"seed={seed}"]
    if variant in ("student", "longer SFT"):
        longer = [f"train.epochs={experiment.args.epochs}"] * (variant == "longer SFT")
        run_command(["train.sft", *SFT, *longer, *shared, f"seed={seed}", f"run={name}"])
        return checkpoints / "sft" / name
    if variant == "rewards":
        run_command(["train.reinforce", *REWARDS, f"model={source}", *where, f"run={name}"])
        return checkpoints / "reinforce" / name
    teacher = f"{name}-teacher"
    facts = [*SFT, "train.facts=true", *shared, f"seed={seed}", f"run={teacher}"]
    run_command(["train.sft", *facts])
    run_command([
        "train.distill", *DISTILL, f"model={source}",
        f"teacher_model={checkpoints / 'sft' / teacher}", *where, f"run={name}",
    ])  # fmt: skip
    return checkpoints / "distill" / name


def cpu_minutes() -> float:
    """Return the CPU time of all finished subprocesses, in minutes."""
    used = resource.getrusage(resource.RUSAGE_CHILDREN)
    return (used.ru_utime + used.ru_stime) / 60


def read_rows(folder: Path, store: Store) -> Iterator[dict[str, Any]]:
    """Yield a row for each test item of an evaluation: the chosen letter, and what the response
    claims."""
    responses = read_item_responses(folder, "reasoning")
    for item in store.selection("test"):
        response = responses[item.item_id]
        yield {
            "mode": "reasoning", "item_id": item.item_id, "family": item.family,
            "subtype": item.subtype, "scene_id": item.scene_id, "answer": item.letter,
            "letter": response.letter, "numbers": bool(find_numbers(response.text)),
            "text": response.text,
        } | dict(count_claims(item, response, store))  # fmt: skip


def print_accuracies(results: pd.DataFrame) -> None:
    """Print the accuracy of each variant by family, and of the time family by horizon."""
    credits = {v: credit_matrix(results, v, "reasoning") for v in VARIANTS}
    credits = {variant: matrix for variant, matrix in credits.items() if matrix.shape[1]}
    resampling = Resampling(next(iter(credits.values())).index)
    print_header("", *FAMILIES, "macro", *HORIZONS, "seeds", "CPU minutes")
    for variant, matrix in credits.items():
        rows = results[results.variant == variant]
        cells = [
            f"{m:.1f} [{low:.1f}, {high:.1f}]"
            for m, low, high in resampling.intervals((variant, matrix))
        ]
        for subtype in HORIZONS.values():
            some = rows[rows.subtype == subtype]
            cells.append(f"{100 * (some.letter == some.answer).mean():.1f}")
        minutes = rows.groupby("seed").cpu_minutes.first().astype(float).mean()
        print_row(variant, *cells, matrix.shape[1], "-" if pd.isna(minutes) else f"{minutes:.0f}")


def print_responses(results: pd.DataFrame) -> None:
    """Print what the responses of each variant are like, in percent."""
    print_header(
        "", "claims per response", "supported", "answer follows", "right for true reasons",
        "with numbers", "different sequences of four words", "claims about unseen objects",
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
            rows.groupby("seed").text.apply(share_of_different_sequences).mean(),
            rows.unseen_claims.sum() / claims,
        )
        cells = [f"{100 * share:.1f}" for share in shares]
        print_row(variant, f"{claims / len(rows):.1f}", *cells)


def share_of_different_sequences(texts: pd.Series) -> float:
    """Return the number of different sequences of four words, as a share of all in the texts."""
    words = [re.findall(r"[\w-]+", text.lower()) for text in texts]
    sequences = [tuple(w[k : k + 4]) for w in words for k in range(len(w) - 3)]
    return len(set(sequences)) / len(sequences) if sequences else 0.0


if __name__ == "__main__":
    with report_failures():
        main()
