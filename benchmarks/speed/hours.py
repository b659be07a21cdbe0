"""Estimates the GPU hours of the paper-scale training runs from measured rates.

    python -m benchmarks.speed.hours
    python -m benchmarks.speed.hours --student qwen3_vl_2b --retriever qwen3_vl_emb_2b

A run trains on each sample or query once per epoch, so it takes samples * epochs / rate / 3600
hours. The rates (samples per second) are in rates.jsonl beside this file, to which the scripts
benchmarks.speed.sft and benchmarks.speed.contrastive append a line per measurement. If a preset and
a GPU have several lines, the last one counts. If a rate is missing, the output names the script
that measures it.

The estimates are slightly too high: a tenth of the training scenes is held out, and answer-only
samples are shorter than the measured samples, of which half have rationales. Evaluation and
narration are not included.
"""

from __future__ import annotations

import argparse
import json
from dataclasses import asdict, dataclass
from datetime import date
from importlib.metadata import version
from pathlib import Path

from dynapix.conf.compose import compose
from dynapix.conf.errors import UserError
from dynapix.conf.failures import report_failures
from dynapix.conf.schema import ContrastiveCommand, SftCommand
from dynapix.data.items.cells import family_quotas

RATES = Path(__file__).with_name("rates.jsonl")
LIBRARIES = ("torch", "transformers", "sentence-transformers")
"""Libraries whose versions are recorded with a rate."""
REGIMES = ("answer_only", "cot", "cot_no_candidate_analysis", "cot_no_match_layout")


@dataclass(frozen=True)
class Rate:
    """A line of rates.jsonl: samples or queries per second of a preset on a GPU, the `card`."""

    benchmark: str
    preset: str
    quantization: str
    rate: float
    card: str
    date: str
    versions: str
    """Of the libraries, such as `torch 2.14.0, transformers 5.23.0`."""


@dataclass(frozen=True)
class TrainingRun:
    """A training run at the paper's scale."""

    name: str
    samples: float
    """Number of samples or queries, summed over all epochs."""
    measured_by: tuple[str, str, str]
    """Benchmark, preset and quantization of the rate that applies to this run; see `Rate`."""


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--student", default="qwen3_vl_8b")
    parser.add_argument("--retriever", default="qwen3_vl_emb_8b")
    args = parser.parse_args()
    print(format_table(list_runs(args.student, args.retriever), read_rates(RATES)))


def list_runs(student: str, retriever: str) -> list[TrainingRun]:
    """Return the training runs of `make paper`, with another student and retriever."""
    runs = []
    for regime in REGIMES:
        overrides = [f"+exp={regime}", "benchmark=dynapix", f"student={student}"]
        cfg = compose("train.sft", SftCommand, overrides)
        quotas = family_quotas(cfg.benchmark).values()
        items = sum(quota.train for family in quotas for quota in family.values())
        # A CoT regime has two samples per item: one in answer mode, one in reasoning mode.
        samples = items * (1 if regime == "answer_only" else 2) * cfg.train.epochs
        measured_by = ("sft", student, cfg.student.quantization)
        runs.append(TrainingRun(f"train.sft +exp={regime}", samples, measured_by))
    overrides = ["benchmark=dynapix", f"retriever={retriever}"]
    cfg = compose("train.contrastive", ContrastiveCommand, overrides)
    queries = sum(quota.train for quota in cfg.benchmark.retrieval.builders.values())
    measured_by = ("contrastive", retriever, cfg.retriever.quantization)
    return [*runs, TrainingRun("train.contrastive", queries * cfg.train.epochs, measured_by)]


def format_table(runs: list[TrainingRun], rates: list[Rate]) -> str:
    """Format the hours of each run on each GPU, and the commands that measure missing rates."""
    head = f"{'on one GPU':<40}{'samples':>9}{'samples/s':>10}{'hours':>8}  measured on"
    lines: list[str] = []
    missing: dict[tuple[str, str, str], list[str]] = {}
    for run in runs:
        # A later rate on a GPU replaces an earlier one.
        known = {
            r.card: r for r in rates if (r.benchmark, r.preset, r.quantization) == run.measured_by
        }
        lines += [head] if known and not lines else []
        lines += [
            f"{run.name:<40}{run.samples:>9,.0f}{rate.rate:>10.2f}"
            f"{run.samples / rate.rate / 3600:>8.1f}  {card}, {rate.date}, {rate.versions}"
            for card, rate in known.items()
        ]
        if not known:
            missing.setdefault(run.measured_by, []).append(run.name)
    lines += [
        f"No rate is measured for {', '.join(names)}: run python -m benchmarks.speed.{benchmark} "
        f"{preset} --quantization {quantization} on your GPU, which adds it to {RATES.name}."
        for (benchmark, preset, quantization), names in missing.items()
    ]
    return "\n".join(lines)


def read_rates(path: Path) -> list[Rate]:
    """Read the measured rates, oldest first; none if the file does not exist.

    Raises:
        UserError: A line is not a valid rate.
    """
    rates = []
    for number, line in enumerate(path.read_text().splitlines() if path.exists() else [], start=1):
        try:
            rates.append(Rate(**json.loads(line)))
            if not rates[-1].rate > 0:
                raise ValueError
        except (ValueError, TypeError) as error:
            raise UserError(
                f"{path}, line {number} is not a valid rate: delete the line or measure again",
                code="damaged-file",
            ) from error
    return rates


def add_rate(
    benchmark: str, preset: str, quantization: str, rate: float, card: str, path: Path = RATES
) -> None:
    """Append a rate to the file, with today's date and the versions of the libraries."""
    versions = ", ".join(f"{name} {version(name)}" for name in LIBRARIES)
    today = date.today().isoformat()
    line = Rate(benchmark, preset, quantization, round(rate, 4), card, today, versions)
    with path.open("a") as file:
        file.write(json.dumps(asdict(line)) + "\n")


if __name__ == "__main__":
    with report_failures():
        main()
