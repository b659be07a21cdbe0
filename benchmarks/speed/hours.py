"""Estimates the GPU hours of the paper-scale training runs from measured rates.

    python -m benchmarks.speed.hours
    python -m benchmarks.speed.hours --student qwen3_vl_2b --retriever qwen3_vl_emb_2b

A run passes its training samples or queries once an epoch, so its hours are
passes / (passes per second) / 3600. The rates are lines of rates.jsonl beside this file, to which
benchmarks.speed.sft_gpu and benchmarks.speed.contrastive_gpu append; the last line of a card and a
preset counts. If a rate is missing, the output names the benchmark that measures it. The estimate
is slightly high: a tenth of the training scenes is held out, and answer-only samples are shorter
than the measured mix of rationales and answers. Evaluation and narration are not included.
"""

from __future__ import annotations

import argparse
import json
from collections.abc import Iterable
from dataclasses import asdict, dataclass
from datetime import date
from pathlib import Path

from conf.compose import compose
from conf.errors import UserError
from conf.schema import ContrastiveCommand, Quota, SftCommand

RATES = Path(__file__).with_name("rates.jsonl")
REGIMES = ("answer_only", "cot", "cot_no_candidate_analysis", "cot_no_match_layout")


@dataclass(frozen=True)
class Rate:
    """A measured rate: samples or queries per second of a preset over a base on a card."""

    benchmark: str
    preset: str
    base: str
    rate: float
    card: str
    date: str


@dataclass(frozen=True)
class Step:
    """A training run of the paper's scale and the benchmark that measures its rate."""

    name: str
    passes: float
    """Samples or queries, over all epochs."""
    benchmark: str
    preset: str
    base: str

    @property
    def command(self) -> str:
        """The command that measures the rate."""
        size = self.preset.replace("emb_", "")
        return f"python -m benchmarks.speed.{self.benchmark} {size} --base {self.base}"


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--student", default="qwen3_vl_8b")
    parser.add_argument("--retriever", default="qwen3_vl_emb_8b")
    parser.add_argument("--rates", type=Path, default=RATES)
    args = parser.parse_args()
    try:
        print(table(steps(args.student, args.retriever), read(args.rates)))
    except UserError as error:
        raise SystemExit(f"error: {error}") from None


def steps(student: str, retriever: str) -> list[Step]:
    """The training runs of `make paper`."""
    found = []
    for regime in REGIMES:
        overrides = [f"+exp={regime}", "benchmark=dynapix", f"student={student}"]
        cfg = compose("train.sft", SftCommand, overrides)
        track = cfg.benchmark.selection
        items = _training(q for by in (track.event, track.time, track.window) for q in by.values())
        # A CoT regime has two samples an item: one in answer mode, one in reasoning mode.
        samples = items * (1 if regime == "answer_only" else 2)
        base = _base(cfg.student.quantization)
        passes = samples * cfg.train.epochs
        found.append(Step(f"train.sft +exp={regime}", passes, "sft_gpu", student, base))
    overrides = ["benchmark=dynapix", f"retriever={retriever}"]
    cfg = compose("train.contrastive", ContrastiveCommand, overrides)
    queries = _training(cfg.benchmark.retrieval.builders.values())
    passes, base = queries * cfg.train.epochs, _base(cfg.retriever.quantization)
    return [*found, Step("train.contrastive", passes, "contrastive_gpu", retriever, base)]


def _training(quotas: Iterable[Quota]) -> int:
    return sum(quota.train for quota in quotas)


def _base(quantization: str) -> str:
    return "nf4" if quantization == "nf4" else "bf16"


def hours(passes: float, rate: float) -> float:
    """Hours of `passes` at `rate` passes per second."""
    return passes / rate / 3600


def table(wanted: list[Step], rates: list[Rate]) -> str:
    """Format the hours by step and card, and the commands that measure missing rates."""
    # Later lines of a card replace earlier ones.
    latest = {(r.benchmark, r.preset, r.base, r.card): r for r in rates}.values()
    lines: list[str] = []
    missing: dict[str, list[str]] = {}
    for step in wanted:
        of = (step.benchmark, step.preset, step.base)
        known = [r for r in latest if (r.benchmark, r.preset, r.base) == of]
        lines += [
            f"{step.name:<40}{step.passes:>9,.0f}{r.rate:>10.2f}"
            f"{hours(step.passes, r.rate):>8.1f}  {r.card}, {r.date}"
            for r in known
        ]
        if not known:
            missing.setdefault(step.command, []).append(step.name)
    if lines:
        lines.insert(0, f"{'on one GPU':<40}{'passes':>9}{'a second':>10}{'hours':>8}  measured on")
    lines += [
        f"No rate is measured for {', '.join(names)}: run {command} on your GPU, which adds it to "
        f"{RATES.name}."
        for command, names in missing.items()
    ]
    return "\n".join(lines)


def read(path: Path) -> list[Rate]:
    """Read the measured rates, oldest first; an absent file has none.

    Raises:
        UserError: A line is not a valid rate.
    """
    if not path.exists():
        return []
    found = []
    for number, line in enumerate(path.read_text().splitlines(), start=1):
        try:
            rate = Rate(**json.loads(line))
            if not rate.rate > 0:
                raise ValueError
        except (ValueError, TypeError) as error:
            raise UserError(
                f"{path}, line {number} is not a valid rate: delete the line or measure again",
                code="damaged-file",
            ) from error
        found.append(rate)
    return found


def add(benchmark: str, preset: str, base: str, rate: float, card: str, path: Path = RATES) -> None:
    """Append a rate measured today."""
    line = Rate(benchmark, preset, base, round(rate, 4), card, date.today().isoformat())
    with path.open("a") as file:
        file.write(json.dumps(asdict(line)) + "\n")


if __name__ == "__main__":
    main()
