"""Measure a retriever on the selection track: the candidate that is nearest to the prefix and the
question is its choice, and no future is generated."""

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
    from evaluation.embedders import embed
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
    rows, told, subtypes, letters, apart = [], [], {}, {}, []
    for embedder in embed.embedders(folder, preset, precision, store, run.folder):
        asked = embed.embed_queries(embedder, items, store, frames, cfg.batch)
        shown = embed.embed_frames(embedder, candidates, store, frames, cfg.batch)
        log.info("choosing for %s items with %s", f"{len(items):,}", embedder.name)
        scores = nearest_candidate.candidate_scores(items, asked, shown, preset)
        right = nearest_candidate.credits(scores, [item.answer for item in items])
        name = embedder.name
        told += nearest_candidate.told(name, items, scores)
        how = (None, cfg.seed, cfg.suite)
        rows.append(selection_row(store.name, name, SIMILARITY, items, right, *how))
        subtypes[name] = accuracy_by_subtype(items, right)
        letters[name] = measure_position_bias(
            nearest_candidate.letters(scores), [item.letter for item in items]
        )
        if cfg.suite == MATCHED_ANCHOR:
            credits = {item.item_id: credit for item, credit in zip(items, right, strict=True)}
            apart.append((name, compare_anchors(items, credits, cfg.seed)))

    write_text(run.folder / "scores.jsonl", "".join(f"{line}\n" for line in told))
    suite = items[0].suite
    parts = [tables.selection_table(rows, suite), *([tables.paired_table(apart)] if apart else [])]
    log.info("%s", "\n\n".join(map(str, parts)))
    parts += [tables.subtype_table(subtypes), tables.position_table(letters)]
    write_text(run.folder / "report.txt", "\n\n".join(map(str, parts)) + "\n")
    report = {
        "build": store.identity,
        "rows": [r.to_dict() for r in rows],
        "controls": [{"mode": name, **asdict(p)} for name, found in apart for p in found],
        "subtypes": {n: {c: vars(i) for c, i in by.items()} for n, by in subtypes.items()},
        "positions": {n: asdict(found) for n, found in letters.items()},
    }
    write_text(run.folder / "report.json", json.dumps(report, indent=1))
    figures.selection_figure(rows, run.folder / "selection.png", suite == reference.SUITE)
    first = rows[0]
    metrics = {family: found.value for family, found in first.families.items()}
    return metrics | {"macro": first.macro, "micro": first.micro.value}


if __name__ == "__main__":
    main()
