"""Measure a retriever: rank the whole test database for every test query, at each width."""

from __future__ import annotations

import json
import logging
from pathlib import Path

from conf.entry import Run, command
from conf.runs import write_text
from conf.schema import ContrastiveCommand, RetrieveCommand

log = logging.getLogger(__name__)


@command("evaluation.retrieve", RetrieveCommand)
def main(cfg: RetrieveCommand, run: Run) -> dict[str, float]:
    from train.trained import run_title, settings_of

    folder = Path(cfg.model) if cfg.model is not None else None
    trained = settings_of(folder, ContrastiveCommand, "retriever") if folder else cfg
    preset, precision = trained.retriever, trained.train.precision

    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from data.frames import Frames
    from evaluation.embedding import rank_all
    from evaluation.figures import retrieval_figure
    from evaluation.tables import RECALLS, UNTRAINED, RetrievalRow, retrieval_table
    from train import compatible, retriever, room

    room.keep_big_blocks()
    frames = Frames(store, preset.image_size)
    rows: list[RetrievalRow] = []
    if folder is not None:
        log.info("ranking with the retriever of %s", folder)
        compatible.check_base(folder, preset.model)
        model = retriever.load_trained(preset, precision, folder / "retriever")
        rows += rank_all(model, preset, store, frames, cfg.batch, run_title(folder))
    log.info("ranking with the untrained %s", preset.name)
    texts = retriever.corpus(store.retrieval("train"), preset)
    untrained = retriever.load_retriever(preset, precision, texts, run.folder / "untrained")
    rows += rank_all(untrained, preset, store, frames, cfg.batch, f"{UNTRAINED} {preset.name}")

    table = retrieval_table(rows)
    log.info("%s", table)
    write_text(run.folder / "report.txt", table + "\n")
    write_text(
        run.folder / "report.json", json.dumps({"rows": [r.to_dict() for r in rows]}, indent=1)
    )
    retrieval_figure(rows, run.folder / "retrieval.png")
    widest = rows[0]
    recalls = (widest.recall_1, widest.recall_10, widest.recall_50)
    return {
        **{f"recall@{k}": value for k, value in zip(RECALLS, recalls, strict=True)},
        "mrr": widest.mrr,
        "median_rank": widest.median_rank,
    }


if __name__ == "__main__":
    main()
