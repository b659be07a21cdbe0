"""Measure a retriever on the selection track: it chooses the candidate nearest to the query."""

from __future__ import annotations

import json
import logging
from dataclasses import asdict
from pathlib import Path

from conf.entry import Run, command
from conf.runs import write_text
from conf.schema import ContrastiveCommand, SimilarityCommand

log = logging.getLogger(__name__)


@command("evaluation.similarity", SimilarityCommand)
def main(cfg: SimilarityCommand, run: Run) -> dict[str, float]:
    from models.trained_runs import resolve_model

    folder, trained = resolve_model(
        cfg, cfg.benchmark, ContrastiveCommand, "retriever", run.overrides
    )
    preset = trained.retriever

    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from data.records import FrameRef
    from data.render.frame_cache import FrameReader
    from data.tracks.controls import MATCHED_ANCHOR
    from evaluation.embedders.base import embed_frames, embed_queries, open_embedders
    from evaluation.metrics.breakdown import accuracy_by_subtype, selection_row
    from evaluation.metrics.calibration import measure_position_bias
    from evaluation.metrics.significance import compare_anchors
    from evaluation.reporting import figures, reference, tables
    from evaluation.reporting.results import SIMILARITY
    from evaluation.retrieval import nearest_candidate
    from evaluation.select import select_items
    from models.precision import resolve_precision

    items = select_items(store, cfg.suite, cfg.limit, cfg.seed)
    candidates = {FrameRef(c.scene_id, c.frame) for item in items for c in item.candidates}
    frames = FrameReader(store, preset.image_size)
    precision = resolve_precision(trained.train.precision)
    rows, score_lines, subtypes, positions, anchors = [], [], {}, {}, []
    for embedder in open_embedders(folder, preset, precision, store, run.folder):
        name = embedder.name
        queries = embed_queries(embedder, items, store, frames, cfg.batch)
        embeddings = embed_frames(embedder, candidates, store, frames, cfg.batch)
        log.info("scoring %s items with %s", f"{len(items):,}", name)
        scores = nearest_candidate.score_candidates(items, queries, embeddings, preset)
        credits = nearest_candidate.credit_choices(scores, [item.answer for item in items])
        score_lines += nearest_candidate.format_scores(name, items, scores)
        rows.append(
            selection_row(store.name, name, SIMILARITY, items, credits, None, cfg.seed, cfg.suite)
        )
        subtypes[name] = accuracy_by_subtype(items, credits)
        positions[name] = measure_position_bias(
            nearest_candidate.choose_letters(scores), [item.letter for item in items]
        )
        if cfg.suite == MATCHED_ANCHOR:
            by_item = {item.item_id: credit for item, credit in zip(items, credits, strict=True)}
            anchors.append((name, compare_anchors(items, by_item, cfg.seed)))

    write_text(run.folder / "scores.jsonl", "".join(f"{line}\n" for line in score_lines))
    suite = items[0].suite
    parts = [tables.selection_table(rows, suite)]
    parts += [tables.paired_table(anchors)] if anchors else []
    log.info("%s", "\n\n".join(map(str, parts)))
    parts += [tables.subtype_table(subtypes), tables.position_table(positions)]
    write_text(run.folder / "report.txt", "\n\n".join(map(str, parts)) + "\n")
    report = {
        "build": store.identity,
        "rows": [r.to_dict() for r in rows],
        "controls": [{"mode": name, **asdict(p)} for name, pairs in anchors for p in pairs],
        "subtypes": {n: {c: vars(i) for c, i in by.items()} for n, by in subtypes.items()},
        "positions": {n: asdict(bias) for n, bias in positions.items()},
    }
    write_text(run.folder / "report.json", json.dumps(report, indent=1))
    figures.selection_figure(rows, run.folder / "selection.png", suite == reference.SUITE)
    first = rows[0]
    metrics = {family: interval.value for family, interval in first.families.items()}
    return metrics | {"macro": first.macro, "micro": first.micro.value}


if __name__ == "__main__":
    main()
