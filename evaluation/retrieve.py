"""Measure a retriever: rank all frames of the test database for each test query and width."""

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
                "index=faiss stores one vector per frame, but a retriever with retriever.late has "
                "several: set index=exact",
                code="unsupported-index",
            )
        import_faiss()

    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from data.render.frame_cache import FrameReader
    from evaluation.embedders.base import embed_frames, embed_queries, open_embedders
    from evaluation.metrics import results
    from evaluation.reporting import tables
    from evaluation.retrieval import faiss_index, standard_test
    from models.precision import resolve_precision

    queries, database = standard_test.load_standard_test(store)
    frames = FrameReader(store, preset.image_size)
    names = [f.name for f in database]
    targets = [q.target.name for q in queries]
    rows, curves, indexes, ranks = [], [], [], {}
    precision = resolve_precision(trained.train.precision)
    for embedder in open_embedders(folder, preset, precision, store, run.folder):
        query_embeddings = embed_queries(embedder, queries, store, frames, cfg.batch)
        query_rows = query_embeddings.rows([q.query_id for q in queries])
        embeddings = embed_frames(embedder, database, store, frames, cfg.batch)
        name = embedder.name
        log.info("ranking %s frames with %s", f"{len(names):,}", name)
        if cfg.index == "exact":
            parts = standard_test.read_parts(embeddings, names)
            target_rows = embeddings.rows(targets)
            ranks[name] = standard_test.rank_targets(preset, query_rows, target_rows, parts)
        else:
            name = f"{name} ({cfg.index})"
            ranks[name], summaries = faiss_index.approximate_ranks(
                query_rows, targets, embeddings, names, preset.widths, cfg.probes, cfg.seed
            )
            indexes += [{"name": name, **summary} for summary in summaries]
        rows += results.retrieval_results(store.name, name, ranks[name], queries, cfg.seed)
        curves.append(results.recall_curve(name, ranks[name]))

    differences = results.compare_retrievers(ranks, queries, cfg.seed)
    extra = [tables.rank_differences_table(differences)] if differences else []
    extra += [tables.index_table(indexes)] if indexes else []
    standard_test.write_ranks(run.folder, ranks, queries)
    entries = {"build": store.identity, "indexes": indexes, "differences": differences}
    standard_test.write_report(run.folder, rows, curves, extra, **entries)
    return {name: of.value for name, of in rows[0].measures.items() if name != "tie_rate"}


if __name__ == "__main__":
    main()
