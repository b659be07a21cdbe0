"""Two-stage retrieval: the texts that a model writes, and how a frozen encoder matches them."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf

from dynapix.conf.schema import EmbedderConfig, LateConfig, RetrieverConfig, TwoStageCommand
from dynapix.data.store import Store, open_store
from dynapix.evaluation import two_stage
from dynapix.evaluation.embedders.embedder import open_embedders
from dynapix.evaluation.metrics.results import SCENE_ALONE, retrieval_results
from dynapix.evaluation.retrieval.standard_test import load_test
from dynapix.evaluation.retrieval.text_matching import ROUTES, future_text, rank_by_text
from tests.evaluation.metrics.reference import matrix_metrics
from tests.evaluation.models.conftest import NO_LORA, SERVED, STUDENT, new_run, served_by
from tests.saved_retrievers import sentence_encoder
from tests.user_errors import raises_user_error

RATIONALE = (
    "Scene parse: A cube.\nMotion analysis: It moves.\nPrediction: The cube will be near the top.\n"
    "Outcome: The cube is near the top.\nAnswer: B"
)
STATE = "The cube will be near the top. The cube is near the top."


@pytest.fixture
def store(tmp_path, micro_store) -> Store:
    """A copy of the store, to which the command may write."""
    return open_store(shutil.copytree(micro_store.folder, tmp_path / "store" / "micro"))


def test_the_part_of_a_response_about_the_target_is_matched() -> None:
    heading = RATIONALE.replace("Prediction:", "### 3. **prediction**\n")
    marked = RATIONALE.replace("Outcome:", "**Outcome:**")
    thought = f"<think>Prediction: A sphere.</think>\n{RATIONALE}"
    assert {future_text(text) for text in (RATIONALE, heading, marked, thought)} == {STATE}
    assert future_text("  The cube is near the top.\n") == "The cube is near the top."
    assert future_text("<think>The cube will") == ""
    assert future_text("\ud800 rests") == "? rests"


def test_texts_are_matched_to_frames_and_captions(store, clip, tmp_path) -> None:
    [matcher] = open_embedders(None, EmbedderConfig(retriever=clip), store, tmp_path, 16)
    queries, database = load_test(store)

    def rank(route: str, texts: list[str], captions: list[str] = ()):
        by_name = {ROUTES[route].mode: dict(zip((q.name for q in queries), texts, strict=True))}
        by_name["caption"] = dict(zip((f.name for f in database), captions, strict=False))
        return rank_by_text(ROUTES[route], matcher, by_name, queries, database)

    # Ranks follow from the scores.
    texts = [f"The scene after {q.question} {k}" for k, q in enumerate(queries)]
    found = rank("predict_image", texts)
    encoder = matcher.encoder
    scores = encoder.embed_texts(texts) @ encoder.embed_frames(database, matcher.frames).T
    targets = np.array([database.index(q.target) for q in queries])
    expected = matrix_metrics(scores, targets, [10])
    row = retrieval_results("micro", "x", found, queries, 0)[0]
    assert row.mrr.value == pytest.approx(expected["mrr"], rel=0.01)
    assert row.median_rank.value == pytest.approx(expected["median_rank"], abs=1)

    # An empty text is a miss, which counts.
    missing = rank("predict_image", ["", *texts[1:-1], ""])
    assert missing.found.tolist() == [False, *[True] * (len(texts) - 2), False]
    assert (missing.above[:, 1:-1] == found.above[:, 1:-1]).all()
    row = retrieval_results("micro", "x", missing, queries, 0)[0]
    assert (row.queries, row.frames) == (len(queries), len(database))
    with raises_user_error("no-texts", contains="predict -> image"):
        rank("predict_image", [""] * len(queries))

    # A text is matched to the caption with the same words. Frames with the same caption tie.
    captions = [f"Frame {f.name}." for f in database]
    texts = [f"Frame {q.target.name}." for q in queries]
    found = rank("predict_caption", texts, captions)
    assert not np.any([found.above, found.tied])
    same = rank("predict_caption", texts, ["A frame."] * len(captions))
    assert (same.tied == len(database) - 1).all()
    # A query whose target has no caption is a miss. The frame still counts in the database.
    captions[captions.index(texts[0])] = ""
    missing = rank("predict_caption", texts, captions)
    assert missing.found.tolist() == [text != texts[0] for text in texts]
    assert missing.frames == len(database)


@pytest.fixture
def measure(tmp_path, micro, store, clip) -> Callable[..., tuple[dict, dict]]:
    """A function that runs the command, and returns its metrics and its report without the
    times."""

    def run_command(name: str = "one", *overrides: str, **settings) -> tuple[dict, dict]:
        run = new_run(tmp_path / name, *overrides)
        cfg = TwoStageCommand(
            benchmark=micro, student=SERVED, store=str(store.folder.parent),
            matcher=EmbedderConfig(retriever=clip, batch=16),
        )  # fmt: skip
        metrics = two_stage.main.__wrapped__(replace(cfg, **settings), run)
        report = json.loads((run.folder / "report.json").read_text())
        timed = {row["name"] for row in report["rows"] if row.pop("seconds") is not None}
        assert {row["name"] for row in report["rows"]} == {*timed, SCENE_ALONE}
        return metrics, report

    return run_command


@pytest.mark.slow
def test_a_students_texts_serve_every_matcher(
    measure, store, trained_student, clip, tmp_path
) -> None:
    folder = Path(shutil.copytree(trained_student, tmp_path / "sft"))
    routes = ["cot_text", "predict_caption"]
    # With random weights, greedy decoding gives every response the same text.
    overrides = ("student.temperature=1.0", "student.top_k=50")
    student = replace(STUDENT, temperature=1.0, top_k=50)
    settings = {"model": str(folder), "routes": routes, "student": student}
    metrics, report = measure("one", *overrides, **settings)
    queries, database = load_test(store)
    measures = ("recall@1", "recall@10", "recall@50", "mrr", "median_rank")
    assert set(metrics) == {f"{route}_{measure}" for route in routes for measure in measures}
    names = dict.fromkeys(row["name"] for row in report["rows"])
    assert list(names) == [*(f"sft {ROUTES[r].title}, clip" for r in routes), SCENE_ALONE]
    assert {(r["queries"], r["frames"]) for r in report["rows"] if r["builder"] is None} == {
        (len(queries), len(database))
    }
    assert report["texts"]["caption"]["texts"] == len(database)
    text = (tmp_path / "one" / "report.txt").read_text()
    assert all(part in text for part in ("Qwen3-VL-2B predict -> caption", "Parsed responses"))

    # With another matcher, the student is not loaded: without config.json, it could not be loaded.
    (folder / "student" / "config.json").unlink()
    other = EmbedderConfig(retriever=replace(clip, name="narrow", widths=[12]))
    assert set(measure("three", *overrides, **settings, matcher=other)[0]) == set(metrics)


@pytest.mark.slow
def test_texts_of_a_server_are_requested_once(
    measure, store, start_server, monkeypatch, tmp_path
) -> None:
    answered = 5
    server = start_server(lambda _: RATIONALE if len(server.requests) <= answered else 500)
    served = served_by(server, concurrency=1, unreachable_timeout=0.2)
    settings = {"server": served, "routes": ["cot_text", "predict_image"]}
    with raises_user_error("no-server", contains="server.url"):
        measure(**settings)
    # The responses before the server failed are kept.
    server.requests.clear()
    answered = 10**6
    _, report = measure(**settings)
    queries, _ = load_test(store)
    assert len(server.requests) == 2 * len(queries) - 5
    assert report["texts"]["rationale"]["  prediction and outcome alone"] == len(queries)
    # A store that cannot be written has texts to read, and keeps no others.
    server.requests.clear()
    monkeypatch.setattr("os.access", lambda *_: False)
    assert measure("two", **settings)[1] == report
    assert not server.requests
    assert (tmp_path / "two" / "texts" / "texts.jsonl").exists()


def test_routes_that_a_model_or_a_matcher_cannot_take_are_refused(
    measure, store, trained_student, tmp_path, monkeypatch
) -> None:
    """Before a text is written."""
    monkeypatch.setattr("dynapix.evaluation.generators.generator.open_generator", None)
    late = RetrieverConfig(name="late", model="unused", late=LateConfig(width=24))
    with raises_user_error("unsupported-matcher", contains="retriever.late"):
        measure(matcher=EmbedderConfig(retriever=late))
    run = shutil.copytree(trained_student, tmp_path / "sft")
    config = OmegaConf.load(run / "config.yaml")
    config.train.regime = "answer_only"
    OmegaConf.save(config, run / "config.yaml")
    with raises_user_error("unsupported-route", contains="cot_text"):
        measure(model=str(run))

    # A sentence encoder matches captions and nothing else.
    weights = str(sentence_encoder(tmp_path / "minilm"))
    minilm = RetrieverConfig(name="minilm", model=weights, widths=[32, 16], **NO_LORA)
    with raises_user_error("no-images", contains="routes=[predict_caption]"):
        measure(matcher=EmbedderConfig(retriever=minilm))
    [matcher] = open_embedders(None, EmbedderConfig(retriever=minilm), store, tmp_path, 16)
    matcher.try_out(None)
