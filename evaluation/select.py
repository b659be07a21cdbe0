"""Measure a student or a base on the test items of the selection track, locally or on servers."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import UserError
from dynapix.conf.files import write_text
from dynapix.conf.runs import rank
from dynapix.conf.schema import SelectCommand, SftCommand

if TYPE_CHECKING:
    from dynapix.data.records import SelectionItem
    from dynapix.data.store import Store
    from dynapix.evaluation.metrics.results import SelectionReport

log = logging.getLogger(__name__)

PAIR_SOURCES = {
    "matched_anchor": ("matched.test", "small"),
    "interventions": ("interventions.absent.test", "tiny_interventions"),
}
"""A quota of the pairs of each suite, and a preset that has them."""


@command("evaluation.select", SelectCommand, ranks=True)
def main(cfg: SelectCommand, run: Run) -> dict[str, float]:
    from dynapix.models.trained_runs import check_modes, modes_of_regime, resolve_model

    folder, trained = resolve_model(cfg, cfg.benchmark, SftCommand, "student", run.overrides)
    student, regime = trained.student, trained.train.regime
    # By default, a base is measured in both record modes, a student in the modes of its training.
    default_modes = ["record", "constrained"] if folder is None else modes_of_regime(regime)
    modes = cfg.modes or default_modes
    if folder is not None:
        check_modes(folder, regime, modes)
    elif student.model is not None and not cfg.server.urls:
        from dynapix.models.checks import check_available

        check_available("student", student.model)
    regime = cfg.prompt_regime or regime

    from dynapix.data.build import ensure_benchmark
    from dynapix.models.distributed import end_ranks, main_first

    with main_first():
        store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from dynapix.data.frames.frame_cache import FrameReader
    from dynapix.evaluation.generators import response_log
    from dynapix.evaluation.generators.generator import (
        item_sample,
        open_generator,
        response_settings,
    )
    from dynapix.evaluation.metrics.reasons import measure_reasons
    from dynapix.evaluation.metrics.results import variant_name
    from dynapix.evaluation.metrics.selection import Choices, build_selection_report

    items = select_items(store, cfg.suite, cfg.limit, cfg.seed)
    frames = FrameReader(store, student.image_size)
    model = open_generator(cfg, folder, trained)
    answers, keys, runs_folder = {}, {}, Path(cfg.checkpoints, "select")
    # The results under a control are compared with those on the unchanged items.
    for control in dict.fromkeys([None, cfg.control]):
        settings = {
            mode: response_settings(
                mode, regime, student, cfg.seed, model.identity, store.identity, control
            )
            for mode in modes
        }
        responses = response_log.ResponseLog(run.folder / "answers.jsonl", settings, items)
        other_logs = sorted(runs_folder.glob("**/answers.jsonl")) if cfg.control else []
        if count := responses.add_from(other_logs):
            log.info("reusing %d answers from other runs of this model", count)
        for mode in modes:
            log.info("measuring %s in %s mode, control %s", model.name, mode, control or "none")
            sample_of = partial(item_sample, regime, frames, student, control, mode)
            respond = partial(model.respond, mode, sample_of)
            answers[mode, control] = response_log.collect_responses(items, mode, respond, responses)
            keys[mode, control] = responses.keys[mode]

    end_ranks()
    if rank() > 0:
        return {}
    name = model.name + (f", prompt of {cfg.prompt_regime}" if cfg.prompt_regime else "")
    choices = [
        Choices.from_answers(name, *variant, responses) for variant, responses in answers.items()
    ]
    asked = [(*variant, key) for variant, key in keys.items()]
    reasons = {
        variant_name(*variant): summary
        for variant, responses in answers.items()
        if variant[0] == "reasoning"
        and (summary := measure_reasons(items, responses, store, cfg.seed)) is not None
    }
    report = build_selection_report(choices, items, store, cfg.seed, cfg.suite, asked, reasons)
    write_report(report, run.folder, items[0].suite)
    return {
        f"{r.mode}_{name}": value
        for r in report.rows
        if r.control == cfg.control
        for name, value in (*r.metrics.items(), ("parse_rate", r.parse_rate))
    }


def select_items(
    store: Store, suite: str | None, limit: int | None, seed: int
) -> list[SelectionItem]:
    """Return the test items of a suite (None for the benchmark's own), reduced by `limit_items`.

    Raises:
        UserError: The benchmark has no such items.
    """
    items = store.selection("test", suite)
    if not items:
        problem = f"{store.folder} has no test items of the {suite or store.suite} suite"
        if suite in PAIR_SOURCES:
            key, preset = PAIR_SOURCES[suite]
            problem += f": set benchmark.selection.{key}, or choose a benchmark={preset}"
        raise UserError(problem, code="no-items")
    return limit_items(items, limit, seed)


def limit_items(items: list[SelectionItem], limit: int | None, seed: int) -> list[SelectionItem]:
    """Return a random sample of `limit` items, or all items if `limit` is None.

    The sample is spread evenly over the families, or consists of `limit // 2` pairs.
    """
    import numpy as np

    from dynapix.conf.schema.benchmark import PAIRED
    from dynapix.data.items.controls import pair_items
    from dynapix.data.seeded_order import interleave

    if limit is None:
        return items
    rng = np.random.default_rng(seed)
    if items[0].suite in PAIRED:
        pairs = pair_items(items)
        return [item for k in rng.permutation(len(pairs))[: limit // 2] for item in pairs[k]]
    order = rng.permutation(len(items))
    return interleave([items[k] for k in order], lambda item: item.family)[:limit]


def write_report(report: SelectionReport, folder: Path, suite: str) -> None:
    """Write report.txt, report.json and selection.png into `folder`, and log the main tables.
    `suite` is the suite of the items."""
    from dynapix.evaluation.reporting import tables
    from dynapix.evaluation.reporting.figures import plot_accuracies
    from dynapix.evaluation.reporting.reference import SUITE

    results = report.rows
    parts = [tables.selection_table(results, suite)]
    parts += [tables.paired_table(report.controls)] if report.controls else []
    parts += [tables.pair_table(report.pairs)] if report.pairs else []
    log.info("%s", "\n\n".join(map(str, parts)))
    parts += tables.detail_tables({r.key: (r.key, report) for r in results})
    write_text(folder / "report.txt", "\n\n".join(map(str, parts)) + "\n")
    write_text(folder / "report.json", json.dumps(asdict(report), indent=1))
    by_family = {f"{r.name} ({r.variant})": r.families for r in results}
    plot_accuracies(by_family, folder / "selection.png", suite == SUITE)


if __name__ == "__main__":
    main()
