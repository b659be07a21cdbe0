"""Measure a student on the selection track's test items, in reasoning and in answer mode."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import write_text
from conf.schema import SelectCommand, SftCommand

log = logging.getLogger(__name__)


@command("evaluation.select", SelectCommand)
def main(cfg: SelectCommand, run: Run) -> dict[str, float]:
    from train.trained import product_folder, run_title, settings_of

    folder = Path(cfg.model) if cfg.model is not None else None
    trained = settings_of(folder, SftCommand, "student") if folder else cfg
    student, regime = trained.student, trained.train.regime
    modes = cfg.modes or (["answer"] if regime == "answer_only" else ["reasoning", "answer"])
    if folder is not None and regime == "answer_only" and "reasoning" in modes:
        raise UserError(
            f"model={folder} was trained in answer mode alone (train.regime=answer_only): give "
            "modes=[answer]"
        )

    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from data.frames import Frames
    from evaluation import answers, figures, tables
    from evaluation.metrics import accuracy_by, accuracy_table
    from train import backbone, compatible, room
    from train.precision import settled

    items = spread(store.selection("test", cfg.suite), cfg.limit, cfg.seed)
    if not items:
        suite = cfg.suite or store.suite
        raise UserError(f"{store.folder} has no test items of the {suite} suite to measure on")
    room.keep_big_blocks()
    precision = settled(trained.train.precision)
    if folder is not None:
        compatible.check_base(folder, student.model)
        weights = product_folder(folder, "student")
        model, processor = backbone.load_trained(student, precision, weights)
    else:
        weights = None
        model, processor = backbone.load_base(student, precision, list)
    name = run_title(folder) if folder else f"{student.name} base"
    asked = ", ".join(filter(None, (store.name, cfg.suite, cfg.control)))
    frames = Frames(store, student.image_size)
    digest = compatible.weights_digest(student.model, weights)
    measured = f"{digest} on {store.identity}, {asked}"
    journal = answers.AnswerLog(run.folder / "answers.jsonl", measured, items)
    rows, subtypes, metrics = [], {}, {}
    for mode in modes:
        log.info("asking %s in %s mode", name, mode)
        given = answers.ask_all(
            model,
            processor,
            items,
            mode,
            regime,
            frames,
            student,
            precision,
            cfg.batch,
            journal,
            cfg.control,
        )
        right = [float(a.right) for a in given]
        accuracy = accuracy_table([i.family for i in items], right)
        parsed = sum(a.letter is not None for a in given) / len(given)
        rows.append(tables.SelectionRow.of(asked, name, mode, accuracy, parsed))
        subtypes[mode] = accuracy_by([f"{i.family}/{i.subtype}" for i in items], right)
        metrics |= {f"{mode}_{f}": found.value for f, found in accuracy.families.items()}
        metrics |= {f"{mode}_macro": accuracy.macro, f"{mode}_micro": accuracy.micro.value}
        metrics[f"{mode}_parse_rate"] = parsed

    table = tables.selection_table(rows)
    log.info("%s", table)
    write_text(run.folder / "report.txt", f"{table}\n\n{tables.subtype_table(subtypes)}\n")
    cells = {mode: {c: vars(found) for c, found in by.items()} for mode, by in subtypes.items()}
    report = {"rows": [r.to_dict() for r in rows], "subtypes": cells}
    write_text(run.folder / "report.json", json.dumps(report, indent=1))
    figures.selection_figure(rows, run.folder / "selection.png")
    answer = journal.answers[items[0].item_id, modes[0]]
    draw_item(items[0], answer.letter, Frames(store), run.folder / "item.png")
    return metrics


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
