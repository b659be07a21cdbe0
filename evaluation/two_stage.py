"""Measure two-stage retrieval: a model writes what the future frame shows, and a frozen encoder
matches that to the whole test database."""

from __future__ import annotations

import json
import logging
from functools import partial
from pathlib import Path

from conf.entry import Run, command
from conf.errors import UserError
from conf.runs import write_text
from conf.schema import ContrastiveCommand, SftCommand, TwoStageCommand
from conf.schema.two_stage import ROUTES

log = logging.getLogger(__name__)


@command("evaluation.two_stage", TwoStageCommand)
def main(cfg: TwoStageCommand, run: Run) -> dict[str, float]:
    from models.trained_runs import modes_of, resolve_model

    folder, trained = resolve_model(cfg, cfg.benchmark, SftCommand, "student", run.overrides)
    matched_by, frozen = resolve_model(
        cfg.matcher, cfg.benchmark, ContrastiveCommand, "retriever", run.overrides, "matcher.model"
    )
    if frozen.retriever.late is not None:
        raise UserError(
            "a matcher by late interaction (retriever.late) scores the tokens of images and clips "
            "alone, and cannot match a text: give another matcher"
        )
    routes = cfg.routes or default_routes(cfg)
    if folder is not None and "cot_text" in routes:
        regime = trained.train.regime
        if "reasoning" not in modes_of(regime):
            raise UserError(
                f"model={folder} writes no rationale (train.regime={regime}): leave cot_text out "
                "of routes"
            )

    from data.build import ensure_benchmark

    store = ensure_benchmark(cfg.benchmark, Path(cfg.store), cfg.workers)

    from data.render.frame_cache import FrameReader
    from evaluation.embedders.embed import embedders
    from evaluation.generators.model_source import open_generator
    from evaluation.metrics import breakdown
    from evaluation.reporting import tables
    from evaluation.reporting.results import UNTRAINED
    from evaluation.retrieval import predicted_texts, standard_test, text_matching
    from models.precision import resolve_precision
    from models.student.prompts import text_sample

    queries, database = standard_test.load_standard_test(store)
    precision = resolve_precision(frozen.train.precision)
    matcher = next(embedders(matched_by, frozen.retriever, precision, store, run.folder))
    student = trained.student
    sample_of = partial(text_sample, FrameReader(store, student.image_size), student.frames)
    model = open_generator(cfg, folder, trained)
    name = model.name
    log.info("asking %s", name)
    modes = predicted_texts.modes_of(routes)
    written = predicted_texts.write_texts(
        cfg, student, model, sample_of, modes, queries, database, store
    )
    texts = {mode: predicted_texts.texts_of(told) for mode, told in written.items()}
    # The matcher needs the room.
    del model

    rows, curves, matched, metrics = [], [], [], {}
    for key in routes:
        route = predicted_texts.ROUTES[key]
        log.info("matching %s with %s", route.title, matcher.name)
        ranks = text_matching.ranks(cfg, route, matcher, texts, queries, database, store)
        title = f"{name} {route.title}, {matcher.name.removeprefix(UNTRAINED).strip()}"
        found = breakdown.retrieval_rows(store.name, title, ranks, queries, cfg.seed)
        rows += found
        curves += breakdown.recall_curves(title, ranks, queries)
        matched += text_matching.matched(key, queries, texts[route.mode], ranks)
        metrics |= {f"{key}_{m}": i.value for m, i in found[0].measures.items() if m != "tie_rate"}

    told = {mode: predicted_texts.counts(of) for mode, of in written.items()}
    reading = tables.parsing_table(told, "What was written")
    also = {"build": store.identity, "indexes": [], "texts": told}
    standard_test.write_report(run.folder, rows, curves, [reading], "retrieval_two_stage", **also)
    write_text(run.folder / "matched.jsonl", "".join(json.dumps(m) + "\n" for m in matched))
    return metrics


def default_routes(cfg: TwoStageCommand) -> list[str]:
    """The paper's: of a student by its rationale, of a base all three."""
    return ["cot_text"] if cfg.model is not None else list(ROUTES[:3])


if __name__ == "__main__":
    main()
