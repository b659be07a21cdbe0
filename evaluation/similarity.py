"""Measure a retriever and its untrained base on the selection track: they choose the candidate with
the highest similarity to the prefix and the question."""

from __future__ import annotations

import logging
from collections.abc import Sequence
from typing import TYPE_CHECKING

from dynapix.conf.entry import Run, command
from dynapix.conf.files import write_json_lines
from dynapix.conf.runs import rank
from dynapix.conf.schema import SimilarityCommand

if TYPE_CHECKING:
    import numpy as np

    from dynapix.conf.schema import RetrieverConfig
    from dynapix.data.records import SelectionItem
    from dynapix.evaluation.embedders.cache import EmbeddingCache

log = logging.getLogger(__name__)


@command("evaluation.similarity", SimilarityCommand, ranks=True)
def main(cfg: SimilarityCommand, run: Run) -> dict[str, float]:
    from dynapix.data.records import FrameRef
    from dynapix.evaluation.embedders.embedder import open_retriever
    from dynapix.evaluation.metrics.selection import Choices, build_selection_report
    from dynapix.evaluation.reporting.run_responses import nearest_candidates
    from dynapix.evaluation.select import select_items, write_report
    from dynapix.models.distributed import end_ranks

    preset, store, embedders = open_retriever(cfg, run)
    items = select_items(store, cfg.suite, cfg.limit, cfg.seed)
    candidates = {FrameRef(c.scene_id, c.frame) for item in items for c in item.candidates}
    embedded = [(e.name, e.embed_queries(items), e.embed_frames(candidates)) for e in embedders]
    end_ranks()
    if rank() > 0:
        return {}
    choices, score_rows = [], []
    for name, queries, embeddings in embedded:
        log.info("scoring %s items with %s", f"{len(items):,}", name)
        scores = score_candidates(items, queries, embeddings, preset).tolist()
        for item, row in zip(items, scores, strict=True):
            score_rows.append({"by": name, "item_id": item.item_id, "scores": row})
        choices.append(Choices.from_scores(name, [*map(nearest_candidates, scores)], items))

    write_json_lines(run.folder / "scores.jsonl", score_rows)
    report = build_selection_report(choices, items, store, cfg.seed, cfg.suite)
    write_report(report, run.folder, items[0].suite)
    return report.rows[0].metrics


def score_candidates(
    items: Sequence[SelectionItem],
    queries: EmbeddingCache,
    frames: EmbeddingCache,
    preset: RetrieverConfig,
) -> np.ndarray:
    """Return the fp32 scores (items, candidates) at the widest width, computed as in retrieval:
    equal embeddings have bit-identical scores."""
    import numpy as np

    from dynapix.evaluation.retrieval.exact_search import pair_scores

    query_rows = queries.rows([item.name for item in items])
    late = preset.late is not None
    width = preset.late.width if late else preset.widths[0]
    columns = []
    for k in range(len(items[0].candidates)):
        frame_rows = frames.rows([item.candidates[k].name for item in items])
        columns.append(pair_scores(query_rows, frame_rows, width, late))
    return np.stack(columns, axis=1)


if __name__ == "__main__":
    main()
