"""Measure a model on the selection track's test items: a student in reasoning and in answer mode, a
base by the structured record; loaded here, or asked at servers."""

from __future__ import annotations

import json
import logging
from collections import Counter
from dataclasses import asdict
from functools import partial
from pathlib import Path

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import write_text
from conf.schema import SelectCommand, SftCommand

log = logging.getLogger(__name__)


@command("evaluation.select", SelectCommand)
def main(cfg: SelectCommand, run: Run) -> dict[str, float]:
    from train.trained import measured

    folder, trained = measured(cfg, SftCommand, "student")
    student, regime = trained.student, trained.train.regime
    modes = cfg.modes or default_modes(cfg, regime)
    if folder is not None and regime == "answer_only" and "reasoning" in modes:
        raise UserError(
            f"model={folder} was trained in answer mode alone (train.regime=answer_only): give "
            "modes=[answer]"
        )

    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from data.frames import Frames
    from evaluation import answers, asked, figures, tables
    from evaluation.confidence import calibration, positions
    from evaluation.metrics import accuracy_by, accuracy_table

    items = spread(store.selection("test", cfg.suite), cfg.limit, cfg.seed)
    if not items:
        suite = cfg.suite or store.suite
        raise UserError(f"{store.folder} has no test items of the {suite} suite to measure on")
    frames = Frames(store, student.image_size)
    sample_of = partial(asked.shown, regime, frames, student, cfg.control)
    model = asked.asked_model(cfg, folder, trained, sample_of)
    name = model.name
    asked_of = ", ".join(filter(None, (store.name, cfg.suite, cfg.control)))
    known = {
        mode: asked.known_by(
            mode, regime, student, cfg.seed, model.revision, store.identity, cfg.control
        )
        for mode in modes
    }
    journal = answers.AnswerLog(run.folder / "answers.jsonl", known, items)
    rows, metrics = [], {}
    subtypes, letters, confidences, reasons = {}, {}, {}, {}
    for mode in modes:
        log.info("asking %s in %s mode", name, mode)
        given = answers.ask_all(items, mode, model.say(mode), journal)
        right = [float(a.right) for a in given]
        accuracy = accuracy_table([i.family for i in items], right)
        parsed = sum(a.letter is not None for a in given) / len(given)
        rows.append(tables.SelectionRow.of(asked_of, name, mode, accuracy, parsed))
        subtypes[mode] = accuracy_by([f"{i.family}/{i.subtype}" for i in items], right)
        letters[mode] = positions([a.letter for a in given], [i.letter for i in items])
        reasons[mode] = readings(given)
        sure = [(a.record.confidence, a.right) for a in given if a.valid]
        confidences[mode] = calibration(*zip(*sure, strict=True)) if sure else None
        metrics |= {f"{mode}_{f}": found.value for f, found in accuracy.families.items()}
        metrics |= {f"{mode}_macro": accuracy.macro, f"{mode}_micro": accuracy.micro.value}
        metrics[f"{mode}_parse_rate"] = parsed

    table = tables.selection_table(rows)
    log.info("%s", table)
    told = {mode: found for mode, found in confidences.items() if found}
    parts = [table, tables.subtype_table(subtypes), tables.reading_table(reasons)]
    parts += [tables.position_table(letters)]
    parts += [tables.calibration_table(mode, found) for mode, found in told.items()]
    write_text(run.folder / "report.txt", "\n\n".join(parts) + "\n")
    cells = {mode: {c: vars(found) for c, found in by.items()} for mode, by in subtypes.items()}
    report = {
        "rows": [r.to_dict() for r in rows],
        "subtypes": cells,
        "readings": reasons,
        "positions": {mode: asdict(found) for mode, found in letters.items()},
        "calibration": {mode: asdict(found) for mode, found in told.items()},
    }
    write_text(run.folder / "report.json", json.dumps(report, indent=1))
    figures.selection_figure(rows, run.folder / "selection.png")
    answer = journal.answers[items[0].item_id, modes[0]]
    draw_item(items[0], answer.letter, Frames(store), run.folder / "item.png")
    return metrics


def default_modes(cfg: SelectCommand, regime: str) -> list[str]:
    """The modes that a student was trained in; of a base, the record."""
    if cfg.model is not None:
        return ["answer"] if regime == "answer_only" else ["reasoning", "answer"]
    return ["record"] if cfg.server.url is None else ["record", "constrained"]


def readings(given: list) -> dict[str, int]:
    """How many answers could be read, how many of them are or hold a valid record where one was
    asked for, and why the others could not."""
    counts = {"with a letter": sum(a.letter is not None for a in given)}
    if given[0].valid is not None:
        counts["  in a valid record"] = sum(a.valid for a in given)
    reasons = Counter(f"without: {a.reason}" for a in given if a.letter is None)
    return counts | dict(reasons.most_common())


def draw_item(item, chosen, frames, path: Path) -> None:
    """An item's prefix and candidates at full size, with what was chosen."""
    from data.records import LETTERS, shown_frames
    from evaluation.figures import item_figure

    shown = shown_frames(item.prefix_start, item.prefix_stop, 6)
    item_figure(
        [frames.image(item.scene_id, f) for f in shown],
        [frames.image(c.scene_id, c.frame) for c in item.candidates],
        LETTERS,
        item.letter,
        chosen,
        item.question,
        path,
    )


def spread(items: list, limit: int | None, seed: int) -> list:
    """`limit` items in a seeded order that takes the families in turn; all where it is null."""
    import numpy as np

    if limit is None:
        return items
    order = np.random.default_rng(seed).permutation(len(items))
    turns: dict[str, int] = {}
    ranked = []
    for k in order:
        family = items[k].family
        turns[family] = turns.get(family, 0) + 1
        ranked.append((turns[family], len(ranked), items[k]))
    return [item for _, _, item in sorted(ranked, key=lambda r: r[:2])][:limit]


if __name__ == "__main__":
    main()
