"""Write the folders of finished runs, of models whose responses a test determines."""

from __future__ import annotations

import json
from collections.abc import Callable, Sequence
from dataclasses import asdict
from datetime import UTC, datetime
from pathlib import Path

import numpy as np
from omegaconf import OmegaConf

from dynapix.conf.entry import Run
from dynapix.conf.files import write_json_lines
from dynapix.conf.schema import (
    ContrastiveCommand,
    ReportCommand,
    RetrieveCommand,
    RetrieverConfig,
    SelectCommand,
    SftCommand,
    SimilarityCommand,
    StudentConfig,
    TeacherConfig,
)
from dynapix.conf.schema.training import SftTrainConfig
from dynapix.data.records import SelectionItem
from dynapix.data.store import Store
from dynapix.evaluation import report
from dynapix.evaluation.generators.response_log import score_response
from dynapix.evaluation.metrics.results import compare_retrievers, retrieval_results
from dynapix.evaluation.metrics.selection import Choices, build_selection_report
from dynapix.evaluation.reporting.run_responses import nearest_candidates
from dynapix.evaluation.retrieval.exact_search import Ranks
from dynapix.evaluation.select import limit_items, write_report
from dynapix.models.student.responses import GeneratedText

STUDENT = StudentConfig(name="small")
Respond = Callable[[SelectionItem], str]


def right(item: SelectionItem) -> str:
    return f"Answer: {item.letter}"


def always_a(item: SelectionItem) -> str:
    return "Answer: A"


def finish(
    folder: Path, settings: object, report: dict | None = None, metrics: dict | None = None
) -> None:
    """Write the files that mark a run as finished."""
    folder.mkdir(parents=True, exist_ok=True)
    OmegaConf.save(OmegaConf.structured(settings), folder / "config.yaml")
    if report is not None:
        (folder / "report.json").write_text(json.dumps(report, default=asdict))
    (folder / "metrics.json").write_text(json.dumps(metrics or {}))
    started = {"started": datetime.now(UTC).isoformat(), "earlier_starts": []}
    (folder / "run.json").write_text(json.dumps(started))


def trained_student(root: Path, benchmark, name: str, regime: str, seed: int = 0) -> None:
    """Write a run of train.sft, without its weights."""
    folder = root / "sft" / name
    train, teacher = SftTrainConfig(regime=regime), TeacherConfig(name="template")
    settings = SftCommand(
        benchmark=benchmark, teacher=teacher, student=STUDENT, train=train, seed=seed, run=name
    )
    finish(folder, settings, None, {"answer_loss_at_start": 2.0, "answer_loss": 1.0})
    journal = [{"step": k, "loss": 2 - k / 9, "eval_answer_loss": 2 - k / 8} for k in range(5)]
    write_json_lines(folder / "metrics.jsonl", journal)


def select_run(
    root: Path,
    store: Store,
    benchmark,
    name: str,
    respond: Respond,
    items: Sequence[SelectionItem] | None = None,
    model: str | None = None,
    mode: str = "answer",
    suite: str | None = None,
    prompt_regime: str | None = None,
) -> Path:
    """Write a run of evaluation.select on `items` (None: all test items), and return its folder.

    `model` is the name of a run of train.sft; None measures a released base.
    """
    items = store.selection("test") if items is None else items
    folder = root / "select" / name
    settings = SelectCommand(
        benchmark=benchmark, student=STUDENT, store=str(store.folder.parent),
        model=None if model is None else f"{root}/sft/{model}", suite=suite,
        prompt_regime=prompt_regime,
    )  # fmt: skip
    finish(folder, settings)
    answers = [score_response(item, mode, GeneratedText(respond(item), False)) for item in items]
    title = (model or "small base") + f", prompt of {prompt_regime}" * bool(prompt_regime)
    choices = Choices.from_answers(title, mode, None, answers)
    asked = [(mode, None, "k1")]
    report = build_selection_report([choices], items, store, 0, suite, asked)
    write_report(report, folder, items[0].suite)
    keys = {"key": "k1", "mode": mode}
    lines = [{**keys, "asked": {"control": None, "seed": 0}}]
    lines += [{**keys, "item_id": i.item_id, "text": respond(i), "truncated": False} for i in items]
    write_json_lines(folder / "answers.jsonl", lines)
    return folder


def similarity_run(
    root: Path,
    store: Store,
    benchmark,
    name: str,
    limit: int | None = None,
    model: str | None = None,
    untrained: Sequence[float] = (0.5, 0.25, 0.125, 0),
) -> Path:
    """Write a run of evaluation.similarity, and return its folder.

    The untrained retriever gives the candidates of every item the scores `untrained`. If `model`,
    the name of a run of train.contrastive, is given, that retriever always chooses the target.
    """
    items = limit_items(store.selection("test"), limit, 0)
    settings = SimilarityCommand(
        benchmark=benchmark, retriever=RetrieverConfig(name=name), limit=limit,
        model=None if model is None else f"{root}/contrastive/{model}",
    )  # fmt: skip
    answers = np.array([item.answer for item in items])
    scores = {f"untrained {name}": np.tile(np.float32(untrained), (len(items), 1))}
    if model is not None:
        scores = {model: np.eye(4, dtype=np.float32)[answers], **scores}
    choices, rows = [], []
    for title, by_item in scores.items():
        by_item = by_item.tolist()
        choices.append(Choices.from_scores(title, [*map(nearest_candidates, by_item)], items))
        for item, own in zip(items, by_item, strict=True):
            rows.append({"by": title, "item_id": item.item_id, "scores": own})
    folder = root / "similarity" / (model or name)
    finish(folder, settings)
    report = build_selection_report(choices, items, store, 0)
    write_report(report, folder, items[0].suite)
    write_json_lines(folder / "scores.jsonl", rows)
    return folder


def retrieve_run(
    root: Path,
    store: Store,
    benchmark,
    name: str,
    frames: int = 60,
    kind: str = "retrieve",
    pool: str = "future",
) -> Path:
    """Write a run of evaluation.retrieve, or of another `kind`, and return its folder.

    It measured a trained retriever, whose training is also written, and its untrained base.
    """
    trained = ContrastiveCommand(benchmark=benchmark, retriever=RetrieverConfig(name="small"))
    finish(root / "contrastive" / name, trained)
    queries = store.retrieval("test", pool)
    rng = np.random.default_rng(0)
    rows, ranked = [], {}
    for title in (name, "untrained small"):
        above = rng.integers(frames, size=(2, len(queries)))
        found = np.ones(len(queries), bool)
        twins = None if pool == "future" else rng.integers(2, size=above.shape)
        ranks = Ranks((64, 32), above, np.zeros_like(above), found, frames, frames, 0.5, twins)
        ranked[title] = ranks
        rows += retrieval_results(store.name, title, ranks, queries, 0)
    report = {"rows": rows, "build": store.identity}
    if kind == "retrieve":
        report["differences"] = compare_retrievers(ranked, queries, 0)
    settings = RetrieveCommand(
        benchmark=benchmark, retriever=RetrieverConfig(name="small"),
        model=f"{root}/contrastive/{name}", pool=pool,
    )  # fmt: skip
    folder = root / kind / (name if pool == "future" else f"{name}-{pool}")
    finish(folder, settings, report)
    return folder


def run_report(root: Path, store: Path, **settings) -> Path:
    """Report the runs below `root`, and return the report's folder."""
    folder = root / "report" / "default"
    folder.mkdir(parents=True, exist_ok=True)
    cfg = ReportCommand(checkpoints=str(root), store=str(store), **settings)
    report.main.__wrapped__(cfg, Run("default", folder))
    return folder


def read_table(folder: Path, name: str) -> str:
    """Return a table of a report as Markdown."""
    return (folder / "tables" / f"{name}.md").read_text()
