"""The results of all runs, with the training of the measured models, and comparisons of models."""

from __future__ import annotations

import hashlib
import json
import re
from collections import Counter
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from itertools import permutations
from pathlib import Path
from typing import Any

import numpy as np

from dynapix.conf.runs import RESULT_NEUTRAL_KEYS, flatten
from dynapix.conf.schema.benchmark import store_name
from dynapix.data.checks.intervals import Interval
from dynapix.data.records import SelectionItem
from dynapix.evaluation.metrics.results import (
    SCENE_ALONE,
    UNTRAINED,
    RetrievalResult,
    SelectionResult,
)
from dynapix.evaluation.metrics.seeds import MACRO, SeedBootstrap
from dynapix.evaluation.metrics.significance import PairedComparison, compare_runs
from dynapix.evaluation.reporting.run_responses import Responses
from dynapix.evaluation.reporting.runs import FinishedRun

TRANSFER_SUITES = {"movi_a": "MoVi-A", "physion": "Physion"}
"""Names of the paper's transfer suites, by `benchmark.simulator` of a release or by
`benchmark.recipe` of a simulated stand-in."""
REGIMES = {
    "answer_only": "answer-only",
    "cot": "full student",
    "cot_no_candidate_analysis": "- candidate analysis",
    "cot_no_match_layout": "- match layout",
}
"""The paper's names of the training regimes, which differ in the text that a student learns."""
ABLATED_REGIMES = ("cot_no_candidate_analysis", "cot_no_match_layout")
"""The regimes whose rationales lack a part."""


@dataclass(frozen=True)
class Measurement:
    """A result with its run and the training of the measured model.

    Attributes:
        name: Name of the model in the report: `result.name`, or a longer name that is unique.
        training: Settings of the model's training run; None for a released model, empty if unknown.
    """

    result: SelectionResult | RetrievalResult
    run: FinishedRun
    name: str
    training: dict[str, Any] | None
    distinction: str = ""

    @property
    def benchmark(self) -> str:
        return self.result.benchmark

    @property
    def responses(self) -> Responses:
        """The model's responses by item id; empty for a retrieval result."""
        if isinstance(self.result, RetrievalResult):
            return {}
        return self.run.responses.get(self.result.key, {})

    @property
    def variants(self) -> list[str]:
        """The suite and the control, if any, or the pool of counterfactual queries; empty for the
        standard items without a control and for the standard test."""
        if isinstance(self.result, RetrievalResult):
            pool = self.result.pool
            return [] if pool == "future" else [f"{pool} queries"]
        return [x for x in (self.result.suite, self.result.control) if x is not None]

    @property
    def group(self) -> str:
        """The name of its benchmark, with the distinction."""
        return ", ".join(filter(None, [self.benchmark, self.distinction]))

    @property
    def item_set(self) -> str:
        """The name of the item set: `group`, suite and control."""
        return ", ".join([self.group, *self.variants])

    @property
    def trained(self) -> bool:
        return self.training is not None

    @property
    def regime(self) -> str | None:
        """The regime of a student's training, or that of the prompts if it is another."""
        trained = (self.training or {}).get("train", {}).get("regime")
        return trained and (self.prompt_regime or trained)

    @property
    def prompt_regime(self) -> str | None:
        """The regime of the prompts, if they are not those of the training."""
        return self.run.config.get("prompt_regime")

    @property
    def training_benchmark(self) -> str | None:
        """The benchmark that the model was trained on, if known."""
        if (benchmark := (self.training or {}).get("benchmark")) is None:
            return None
        world = benchmark.get("world", {}).get("name", "clevrer")
        return store_name(benchmark["name"], world)

    @property
    def base(self) -> str | None:
        """The base of a student, or the released model itself."""
        settings = self.run.config if self.training is None else self.training
        return settings.get("student", {}).get("name")

    @property
    def seed(self) -> int | None:
        """The seed of the training, if known."""
        return (self.training or {}).get("seed")

    @property
    def label(self) -> str:
        return f"{self.name} ({self.result.mode})"

    @property
    def is_transfer_suite(self) -> bool:
        """Whether the benchmark is a transfer suite, or a simulated stand-in for one."""
        benchmark = self.run.config.get("benchmark", {})
        return bool({benchmark.get("simulator"), benchmark.get("recipe")} & {*TRANSFER_SUITES})

    @property
    def source(self) -> tuple:
        """The benchmark, its build and its suite."""
        suite = self.result.suite if isinstance(self.result, SelectionResult) else None
        return self.benchmark, self.run.report.build, suite

    @property
    def row_key(self) -> tuple:
        """Key of the result's row in a table; results with equal keys need different names."""
        result = self.result
        is_selection = isinstance(result, SelectionResult)
        variant = result.mode if is_selection else (result.width, result.builder)
        return self.run.kind, self.item_set, result.name, variant


def read_measurements(runs: Iterable[FinishedRun], kinds: Sequence[str]) -> list[Measurement]:
    """Return the results of the runs of some kinds, each once and with a unique name."""
    measurements = []
    for run in runs:
        if run.kind in kinds:
            for row in run.report.rows:
                # The report of a trained retriever also has rows for its base and a baseline.
                is_trained = not row.name.startswith((UNTRAINED, SCENE_ALONE))
                trained = run.training if is_trained else None
                measurements.append(Measurement(row, run, row.name, trained))
    return _deduplicate(_distinguish_item_sets(measurements))


def _distinguish_item_sets(measurements: Sequence[Measurement]) -> list[Measurement]:
    """Label each result that is not on the main build of its benchmark, or not on its main items.

    The main build of a benchmark is that of its most recent run, because two builds can have other
    items and queries with the same ids. The main items of a build are the largest set that a run
    answered; `limit=` gives smaller ones.
    """
    by_time = sorted(measurements, key=lambda m: m.run.started)
    builds = {m.benchmark: m.run.report.build for m in by_time}
    main: dict[tuple, Responses] = {}
    for m in measurements:
        main[m.source] = max(main.get(m.source, {}), m.responses, key=len)
    distinguished = []
    for m in measurements:
        parts = []
        if m.run.report.build != builds[m.benchmark]:
            parts.append(f"build {m.run.report.build[:8]}")
        if m.responses and m.responses.keys() != main[m.source].keys():
            digest = hashlib.sha256("\n".join(sorted(m.responses)).encode()).hexdigest()[:4]
            parts.append(f"{len(m.responses)} items ({digest})")
        distinguished.append(replace(m, distinction=", ".join(parts)))
    return distinguished


def _deduplicate(measurements: Sequence[Measurement]) -> list[Measurement]:
    """Drop repeated results, and give the others unique names.

    Retrievers with the same base each report the results of that base. If different results have
    the same name, the names of their runs are appended.
    """
    kept: list[Measurement] = []
    for m in measurements:
        if all((m.group, m.result) != (other.group, other.result) for other in kept):
            kept.append(m)
    counts = Counter(m.row_key for m in kept)
    return [
        replace(m, name=f"{m.result.name}, {m.run.name}") if counts[m.row_key] > 1 else m
        for m in kept
    ]


def group_by_item_set(measurements: Iterable[Measurement]) -> dict[str, list[Measurement]]:
    """Return the results by item set: results on different items are never in the same table."""
    groups: dict[str, list[Measurement]] = {}
    for m in measurements:
        groups.setdefault(m.item_set, []).append(m)
    return groups


def transfer_benchmarks(measurements: Sequence[Measurement]) -> set[str]:
    """Return the benchmarks that test transfer to other scenes.

    These are the benchmarks on which no model was trained, if they are transfer suites or if a
    trained model was measured on them.
    """
    trained_on = {m.training_benchmark for m in measurements if m.training_benchmark}
    measured = {m.benchmark for m in measurements if m.is_transfer_suite or m.training_benchmark}
    return measured - trained_on


def widest_results(measurements: Iterable[Measurement]) -> list[Measurement]:
    """Return the results over all queries at each model's largest width, released models first."""
    widest: dict[tuple[Path, str], Measurement] = {}
    for m in measurements:
        # The rows of a report are sorted by width, widest first.
        if m.result.builder is None:
            widest.setdefault((m.run.folder, m.name), m)
    return sorted(widest.values(), key=lambda m: m.trained)


def compare_models(
    models: Mapping[str, Measurement],
    items: Mapping[str, SelectionItem],
    seed: int,
) -> list[PairedComparison]:
    """Compare the pairs of models that the paper compares; see `compare_runs`.

    Args:
        models: The models that were measured on the same items, by label.
        items: The benchmark's items by id.
        seed: Seed of the bootstrap over scenes.
    """
    comparisons: list[PairedComparison] = []
    # The responses of a run may be damaged or deleted.
    answered_by = [label for label, m in models.items() if m.responses]
    for pair in permutations(answered_by, 2):
        if not _is_paper_comparison(*(models[label] for label in pair)):
            continue
        credits = [
            {k: r.credit(items[k].letter) for k, r in models[label].responses.items()}
            for label in pair
        ]
        answered = [item for item_id, item in items.items() if item_id in credits[0]]
        if answered:
            comparisons += compare_runs(answered, *credits, pair, seed)
    return comparisons


@dataclass(frozen=True)
class SeededResult:
    """The results of trainings that differ only in their seed, on the same items.

    Attributes:
        name: Name of the first run, without its seed, and the mode of the evaluation.
        accuracies: By family and macro, with intervals over scenes and seeds.
        macros: Macro accuracy by seed.
    """

    name: str
    accuracies: dict[str, Interval]
    macros: dict[int, float]


def combine_seeds(
    models: Mapping[str, Measurement], items: Mapping[str, SelectionItem]
) -> tuple[list[SeededResult], dict[str, dict[str, Interval]]]:
    """Return the accuracies of trainings with several seeds, and the differences between the pairs
    of them that the paper compares, by a name.

    Args:
        models: The models that were measured on the same items, by label.
        items: The benchmark's items by id.
    """
    trainings: dict[tuple[str, str], dict[int, Measurement]] = {}
    for m in models.values():
        if "seed" in m.run.recipe and m.trained and m.responses:
            key = _without_seed(m), ", ".join(filter(None, [m.result.mode, m.prompt_regime]))
            trainings.setdefault(key, {}).setdefault(m.run.recipe["seed"], m)
    results, found = [], []
    for (training, variant), by_seed in trainings.items():
        group = {seed: by_seed[seed] for seed in sorted(by_seed)}
        first = next(iter(group.values()))
        ids = [item_id for item_id in items if item_id in first.responses]
        if len(group) < 2 or any({*ids} != m.responses.keys() for m in group.values()):
            continue
        name = f"{_name_without_seed(first)} ({variant})"
        rows = [[m.responses[k].credit(items[k].letter) for m in group.values()] for k in ids]
        credits = np.array(rows, float)
        bootstrap = _bootstrap(ids, items)
        macros = {
            seed: bootstrap.accuracies(training, credits[:, [k]])[MACRO].value
            for k, seed in enumerate(group)
        }
        results.append(SeededResult(name, bootstrap.accuracies(training, credits), macros))
        found.append((name, group, ids, (training, credits)))
    differences = {}
    for (first, group, ids, one), (second, others, other_ids, other) in permutations(found, 2):
        shared = group.keys() & others.keys()
        compared = any(_is_paper_comparison(group[seed], others[seed]) for seed in shared)
        if compared and ids == other_ids:
            name = f"{first} minus {second}"
            differences[name] = _bootstrap(ids, items).differences(one, other)
    return results, differences


def _bootstrap(ids: Sequence[str], items: Mapping[str, SelectionItem]) -> SeedBootstrap:
    return SeedBootstrap([items[k].family for k in ids], [items[k].scene_id for k in ids])


def _without_seed(m: Measurement) -> str:
    """Return the settings that decide the result of the run that trained a model, without its seed.
    The run that it continues, if any, has the seed in its name."""
    names = RESULT_NEUTRAL_KEYS | {"seed"}
    settings = {name: value for name, value in flatten(m.run.recipe).items() if name not in names}
    if "model" in settings:
        settings["model"] = _strip_seed(str(settings["model"]), m.run.recipe["seed"])
    return json.dumps(settings, sort_keys=True, default=str)


def _name_without_seed(m: Measurement) -> str:
    return _strip_seed(m.name.partition(", prompt of ")[0], m.run.recipe["seed"])


def _strip_seed(name: str, seed: int) -> str:
    """Return a name without a seed: "cot" for "cot-0" and "cot_seed0", and "cot+lr-1" for
    "cot+seed-0+lr-1"."""
    stripped = re.sub(rf"[\W_]*seed[\W_]*{seed}(?!\d)", "", name)
    return (re.sub(rf"[\W_]+{seed}$", "", name) if stripped == name else stripped) or name


def _is_paper_comparison(m: Measurement, other: Measurement) -> bool:
    """Return whether the paper compares `m` with a model such as `other`. It compares:

    - a student with its base, in the same mode;
    - a student that learned rationales with an answer-only student of the same base and seed;
    - the full student with an ablated student of the same base, seed and mode;
    - a retriever with its untrained base.
    """
    if m.run.kind == "similarity":
        # `other.run` may be another run: a base that several runs measured is kept only once.
        return m.trained and not other.trained and other.result in m.run.report.rows
    if m.regime not in REGIMES or other.base != m.base:
        return False
    same_mode = other.result.mode == m.result.mode
    if not other.trained:
        return same_mode
    if other.seed != m.seed:
        return False
    if other.regime == "answer_only":
        return m.regime != "answer_only"
    return m.regime == "cot" and other.regime in ABLATED_REGIMES and same_mode
