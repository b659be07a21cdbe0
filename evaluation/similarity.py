"""Measure a retriever on the selection track: the candidate that is nearest to the prefix and the
question is its choice, and no future is generated."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import write_text
from conf.schema import ContrastiveCommand, SimilarityCommand

log = logging.getLogger(__name__)


@command("evaluation.similarity", SimilarityCommand)
def main(cfg: SimilarityCommand, run: Run) -> dict[str, float]:
    from train.trained import measured

    folder, trained = measured(cfg, ContrastiveCommand, "retriever")
    preset = trained.retriever

    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from data.frames import Frames
    from data.records import FrameRef
    from evaluation import embedding, figures, nearest, tables
    from evaluation.metrics import accuracy_by, accuracy_table
    from evaluation.select import spread
    from train.precision import settled

    items = spread(store.selection("test", cfg.suite), cfg.limit, cfg.seed)
    if not items:
        suite = cfg.suite or store.suite
        raise UserError(f"{store.folder} has no test items of the {suite} suite to measure on")
    candidates = {FrameRef(c.scene_id, c.frame) for item in items for c in item.candidates}
    frames = Frames(store, preset.image_size)
    precision = settled(trained.train.precision)
    asked_of = ", ".join(filter(None, (store.name, cfg.suite)))
    rows, subtypes = [], {}
    for embedder in embedding.embedders(folder, preset, precision, store, run.folder):
        asked = embedding.embed_queries(embedder, items, store, frames, cfg.batch)
        shown = embedding.embed_frames(embedder, candidates, store, frames, cfg.batch)
        log.info("choosing for %s items with %s", f"{len(items):,}", embedder.name)
        scores = nearest.candidate_scores(items, asked, shown, preset)
        right = nearest.credits(scores, [item.answer for item in items])
        accuracy = accuracy_table([i.family for i in items], right)
        rows.append(
            tables.SelectionRow.of(asked_of, embedder.name, tables.SIMILARITY, accuracy, None)
        )
        subtypes[embedder.name] = accuracy_by([f"{i.family}/{i.subtype}" for i in items], right)

    table = tables.selection_table(rows)
    log.info("%s", table)
    write_text(run.folder / "report.txt", f"{table}\n\n{tables.subtype_table(subtypes)}\n")
    cells = {name: {c: vars(found) for c, found in by.items()} for name, by in subtypes.items()}
    report = {"rows": [r.to_dict() for r in rows], "subtypes": cells}
    write_text(run.folder / "report.json", json.dumps(report, indent=1))
    figures.selection_figure(rows, run.folder / "selection.png")
    first = rows[0]
    metrics = {family: found.value for family, found in first.families.items()}
    return metrics | {"macro": first.macro, "micro": first.micro.value}


if __name__ == "__main__":
    main()
