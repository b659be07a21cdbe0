"""Measure a retriever and its untrained base: for each test query of a pool and each width, rank
all frames of its test database. A baseline knows the scene and nothing else."""

from __future__ import annotations

import logging

from dynapix.conf.entry import Run, command
from dynapix.conf.runs import rank
from dynapix.conf.schema import RetrieveCommand

log = logging.getLogger(__name__)


@command("evaluation.retrieve", RetrieveCommand, ranks=True)
def main(cfg: RetrieveCommand, run: Run) -> dict[str, float]:
    from dynapix.evaluation.embedders.embedder import open_retriever
    from dynapix.evaluation.metrics import results
    from dynapix.evaluation.reporting import tables
    from dynapix.evaluation.retrieval import exact_search, standard_test
    from dynapix.models.distributed import end_ranks

    preset, store, embedders = open_retriever(cfg, run)
    queries, database = standard_test.load_test(store, cfg.pool)
    frame_names = [f.name for f in database]
    twins = [q.factual_twin.name for q in queries if q.factual_twin]
    embedded = [(e.name, e.embed_queries(queries), e.embed_frames(database)) for e in embedders]
    end_ranks()
    if rank() > 0:
        return {}
    widths = preset.widths if preset.late is None else [preset.late.width]
    rows, ranks = [], {}
    for name, query_embeddings, frame_embeddings in embedded:
        log.info("ranking %s frames with %s", f"{len(frame_names):,}", name)
        ranks[name] = exact_search.exact_ranks(
            query_embeddings.rows([q.query_id for q in queries]),
            frame_embeddings.rows([q.target.name for q in queries]),
            frame_embeddings.parts(frame_names),
            widths,
            frame_embeddings.rows(twins) if twins else None,
            preset.late is not None,
        )
        rows += results.retrieval_results(store.name, name, ranks[name], queries, cfg.seed)

    rows += standard_test.score_scene_alone(store.name, queries, database, cfg.seed)
    differences = results.compare_retrievers(ranks, queries, cfg.seed)
    extra = [tables.rank_differences_table(differences)] if differences else []
    exact_search.write_ranks(run.folder, ranks, queries)
    entries = {"build": store.identity, "differences": differences}
    standard_test.write_report(run.folder, rows, extra, **entries)
    # The first row has the first retriever's measures over all queries, at its widest width.
    return {name: m.value for name, m in rows[0].measures.items() if name != "tie_rate"}


if __name__ == "__main__":
    main()
