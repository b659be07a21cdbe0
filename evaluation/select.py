"""Measure a model on the selection track's test items: a student in reasoning and in answer mode, a
base by the structured record; loaded here, or asked at servers."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

from conf.entry import Run, command
from conf.errors import UserError
from conf.schema import SelectCommand, SftCommand

if TYPE_CHECKING:
    from data.records import SelectionItem
    from data.store import Store

log = logging.getLogger(__name__)


@command("evaluation.select", SelectCommand)
def main(cfg: SelectCommand, run: Run) -> dict[str, float]:
    from models.trained_runs import check_modes, resolve_model

    folder, trained = resolve_model(cfg, cfg.benchmark, SftCommand, "student", run.overrides)
    student, regime = trained.student, trained.train.regime
    modes = cfg.modes or default_modes(cfg, regime)
    if folder is not None:
        check_modes(folder, regime, modes)

    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from data.render.frame_cache import FrameReader
    from evaluation.generators import model_source, response_log
    from evaluation.reporting import selection_report

    items = select_items(store, cfg.suite, cfg.limit, cfg.seed)
    frames = FrameReader(store, student.image_size)
    model = model_source.open_generator(cfg, folder, trained)
    given, keys, runs = {}, {}, Path(cfg.checkpoints, "select")
    # What a control changes shows only beside the same items as they are.
    for control in dict.fromkeys([None, cfg.control]):
        known = {
            mode: model_source.response_settings(
                mode, regime, student, cfg.seed, model.revision, store.identity, control
            )
            for mode in modes
        }
        journal = response_log.ResponseLog(run.folder / "answers.jsonl", known, items)
        if cfg.control and (taken := journal.take_over(sorted(runs.glob("**/answers.jsonl")))):
            log.info("%d answers are there already, from other runs of this model", taken)
        sample_of = partial(model_source.shown, regime, frames, student, control)
        for mode in modes:
            log.info("asking %s in %s mode%s", model.name, mode, f", {control}" if control else "")
            given[mode, control] = response_log.collect_responses(
                items, mode, model.say(mode, sample_of), journal
            )
            keys[mode, control] = journal.keys[mode]

    about = {"build": store.identity, "asked": [[*how, key] for how, key in keys.items()]}
    metrics = selection_report.write_report(
        given, items, model.name, store.name, cfg, run.folder, about
    )
    letter = given[modes[0], cfg.control][0].letter
    draw_item(items[0], letter, FrameReader(store), run.folder / "item.png")
    return metrics


def default_modes(cfg: SelectCommand, regime: str) -> list[str]:
    """The modes that a student was trained in; of a base, the record, free and held to its form."""
    from models.trained_runs import modes_of

    if cfg.model is not None:
        return modes_of(regime) or ["answer"]
    return ["record", "constrained"]


def draw_item(item, chosen, frames, path: Path) -> None:
    """An item's prefix and candidates at full size, with what was chosen."""
    from data.records import LETTERS, sample_prefix_frames
    from evaluation.reporting.figures import item_figure

    shown = sample_prefix_frames(item.prefix_start, item.prefix_stop, 6)
    item_figure(
        [frames.image(item.scene_id, f) for f in shown],
        [frames.image(c.scene_id, c.frame) for c in item.candidates],
        LETTERS,
        item.letter,
        chosen,
        item.question,
        path,
    )


def select_items(
    store: Store, suite: str | None, limit: int | None, seed: int
) -> list[SelectionItem]:
    """The test items of a suite that are asked, see `spread`.

    Raises:
        UserError: the benchmark has none.
    """
    from data.tracks.controls import MATCHED_ANCHOR

    items = store.selection("test", suite)
    if not items:
        hint = (
            "; a benchmark has pairs by benchmark.selection.matched.test, such as benchmark=small"
        )
        raise UserError(
            f"{store.folder} has no test items of the {suite or store.suite} suite to measure on"
            f"{hint if suite == MATCHED_ANCHOR else ''}"
        )
    return limit_items(items, limit, seed)


def limit_items(items: list[SelectionItem], limit: int | None, seed: int) -> list[SelectionItem]:
    """`limit` items in a seeded order that takes the families in turn; all where it is null. Of
    matched-anchor pairs it takes both items or neither."""
    import numpy as np

    from data.tracks.controls import MATCHED_ANCHOR, pair_items
    from data.tracks.quota import interleave

    if limit is None:
        return items
    if items[0].suite == MATCHED_ANCHOR:
        matched = pair_items(items)
        order = np.random.default_rng(seed).permutation(len(matched))
        return [item for k in order[: limit // 2] for item in matched[k]]
    order = np.random.default_rng(seed).permutation(len(items))
    return interleave([items[k] for k in order], lambda item: item.family)[:limit]


if __name__ == "__main__":
    main()
