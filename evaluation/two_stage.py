"""Measure two-stage retrieval: a model describes the future frame of each query in text, and a
frozen encoder, the matcher, ranks the test database by similarity to this text."""

from __future__ import annotations

import logging
from functools import partial
from pathlib import Path

from dynapix.conf.entry import Run, command
from dynapix.conf.errors import UserError
from dynapix.conf.files import write_json_lines
from dynapix.conf.runs import rank
from dynapix.conf.schema import ContrastiveCommand, SftCommand, TwoStageCommand
from dynapix.conf.schema.evaluation import ROUTES

log = logging.getLogger(__name__)


@command("evaluation.two_stage", TwoStageCommand, ranks=True)
def main(cfg: TwoStageCommand, run: Run) -> dict[str, float]:
    from dynapix.models.trained_runs import resolve_model

    folder, trained = resolve_model(cfg, cfg.benchmark, SftCommand, "student", run.overrides)
    matcher_folder, matcher_settings = resolve_model(
        cfg.matcher, cfg.benchmark, ContrastiveCommand, "retriever", run.overrides, "matcher.model"
    )
    # As in the paper: the rationales of a student, or all three routes for a base.
    routes = cfg.routes or (["cot_text"] if cfg.model is not None else list(ROUTES))
    check_routes(routes, folder, trained.train.regime, matcher_settings)

    from dynapix.data.build import ensure_benchmark
    from dynapix.models.distributed import end_ranks, main_first, share_from_main

    with main_first():
        store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from dynapix.data.frames.frame_cache import FrameReader
    from dynapix.evaluation.embedders.embedder import open_embedders
    from dynapix.evaluation.generators.generator import open_generator
    from dynapix.evaluation.metrics import results
    from dynapix.evaluation.metrics.ranking import query_metrics
    from dynapix.evaluation.reporting import tables
    from dynapix.evaluation.retrieval import standard_test, text_matching
    from dynapix.models.student.prompts import text_sample

    queries, database = standard_test.load_test(store)
    matcher = next(
        open_embedders(matcher_folder, matcher_settings, store, run.folder, cfg.matcher.batch)
    )
    chosen = [text_matching.ROUTES[key] for key in routes]
    # No text is written for a matcher that cannot be loaded, or cannot embed what a route compares.
    matcher.try_out(None if all(route.captions for route in chosen) else database[0])
    student = trained.student
    sample_of = partial(text_sample, FrameReader(store, student.image_size), student.frames)
    model = open_generator(cfg, folder, trained)
    name = model.name
    log.info("collecting the texts of %s", name)
    responses = text_matching.collect_texts(
        cfg, student, model, sample_of, chosen, queries, database, store, run.folder
    )
    texts = {
        mode: {r.item_id: text_matching.future_text(r.text) for r in mode_responses}
        for mode, mode_responses in responses.items()
    }
    texts = share_from_main(texts)
    # The matcher needs the memory that the model occupies.
    del model

    rows, matched, metrics = [], [], {}
    for key, route in zip(routes, chosen, strict=True):
        log.info("matching %s with %s", route.title, matcher.name)
        ranks = text_matching.rank_by_text(route, matcher, texts, queries, database)
        if ranks is None:
            continue
        title = f"{name} {route.title}, {matcher.name.removeprefix(results.UNTRAINED).strip()}"
        route_rows = results.retrieval_results(store.name, title, ranks, queries, cfg.seed)
        rows += route_rows
        # Ranks at the widest width; a query without a rank (a miss) gets the last one.
        counts = ranks.above[0], ranks.tied[0], ranks.found
        target_ranks = query_metrics(*counts, ranks.frames, ())["median_rank"].tolist()
        matched += [
            {"query_id": q.query_id, "route": key, "text": texts[route.mode][q.name], "rank": rank}
            for q, rank in zip(queries, target_ranks, strict=True)
        ]
        measures = route_rows[0].measures
        metrics |= {f"{key}_{m}": v.value for m, v in measures.items() if m != "tie_rate"}

    end_ranks()
    if rank() > 0:
        return {}
    rows += standard_test.score_scene_alone(store.name, queries, database, cfg.seed)
    text_counts = {mode: text_matching.count_texts(found) for mode, found in responses.items()}
    extra = [tables.parsing_table(text_counts)]
    entries = {"build": store.identity, "texts": text_counts}
    standard_test.write_report(run.folder, rows, extra, "two_stage", **entries)
    write_json_lines(run.folder / "matched.jsonl", matched)
    return metrics


def check_routes(
    routes: list[str], folder: Path | None, regime: str, matcher: ContrastiveCommand
) -> None:
    """Raise UserError if the matcher cannot match texts, or if `cot_text` is among the routes of a
    student that was not trained to write rationales."""
    from dynapix.models.trained_runs import modes_of_regime

    if matcher.retriever.late is not None:
        raise UserError(
            "a late-interaction matcher (retriever.late) cannot embed a text without an image or a "
            "clip: choose another matcher",
            code="unsupported-matcher",
        )
    if folder is not None and "cot_text" in routes and "reasoning" not in modes_of_regime(regime):
        raise UserError(
            f"model={folder} was not trained to write rationales (train.regime={regime}): remove "
            "cot_text from routes",
            code="unsupported-route",
        )


if __name__ == "__main__":
    main()
