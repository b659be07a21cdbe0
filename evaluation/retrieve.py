"""Measure a retriever: rank the whole test database for every test query, at each width."""

from __future__ import annotations

import logging
from pathlib import Path

from conf.entry import Run, command
from conf.errors import UserError
from conf.schema import ContrastiveCommand, RetrieveCommand

log = logging.getLogger(__name__)


@command("evaluation.retrieve", RetrieveCommand)
def main(cfg: RetrieveCommand, run: Run) -> dict[str, float]:
    from models.trained_runs import resolve_model

    folder, trained = resolve_model(
        cfg, cfg.benchmark, ContrastiveCommand, "retriever", run.overrides
    )
    preset = trained.retriever
    if cfg.index == "faiss":
        from evaluation.retrieval.faiss_index import import_faiss

        if preset.late is not None:
            raise UserError(
                "index=faiss holds one vector a frame, and retriever.late has many: "
                "leave index=exact"
            )
        import_faiss()

    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from data.render.frame_cache import FrameReader
    from evaluation.embedders import embed
    from evaluation.metrics import breakdown
    from evaluation.reporting import tables
    from evaluation.retrieval import faiss_index, standard_test
    from models.precision import resolve_precision

    queries, database = standard_test.load_standard_test(store)
    frames = FrameReader(store, preset.image_size)
    ids = [q.query_id for q in queries]
    names = [f.name for f in database]
    targets = [q.target.name for q in queries]
    rows, curves, indexes, found = [], [], [], {}
    precision = resolve_precision(trained.train.precision)
    for embedder in embed.embedders(folder, preset, precision, store, run.folder):
        asked = embed.embed_queries(embedder, queries, store, frames, cfg.batch).rows(ids)
        shown = embed.embed_frames(embedder, database, store, frames, cfg.batch)
        name = embedder.name
        log.info("ranking %s frames with %s", f"{len(names):,}", name)
        if cfg.index == "exact":
            parts = standard_test.in_parts(shown, names)
            ranks = standard_test.rank_targets(preset, asked, shown.rows(targets), parts)
        else:
            name = f"{name} ({cfg.index})"
            ranks, told = faiss_index.approximate_ranks(
                asked, targets, shown, names, preset.widths, cfg.probes, cfg.seed
            )
            indexes += [{"name": name, **of_width} for of_width in told]
        found[name] = ranks
        rows += breakdown.retrieval_rows(store.name, name, ranks, queries, cfg.seed)
        curves += breakdown.recall_curves(name, ranks, queries)

    apart = breakdown.compare_retrievers(found, queries, cfg.seed)
    told = [tables.rank_differences_table(apart)] if apart else []
    told += [tables.index_table(indexes)] if indexes else []
    standard_test.write_ranks(run.folder, found, queries)
    also = {"build": store.identity, "indexes": indexes, "differences": apart}
    standard_test.write_report(run.folder, rows, curves, told, **also)
    return {name: found.value for name, found in rows[0].measures.items() if name != "tie_rate"}


if __name__ == "__main__":
    main()
