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

from dynapix.conf.schema import (
    ContrastiveTrainConfig,
    EmbedderConfig,
    LateConfig,
    RetrieverConfig,
    ServerConfig,
    StudentConfig,
    TwoStageCommand,
)
from dynapix.data.store import Store, open_store
from dynapix.evaluation import two_stage
from dynapix.evaluation.embedders.embedder import Embedder, open_embedders
from dynapix.evaluation.metrics.ranking import query_metrics
from dynapix.evaluation.metrics.results import SCENE_ALONE, retrieval_results
from dynapix.evaluation.retrieval.exact_search import Ranks
from dynapix.evaluation.retrieval.standard_test import load_test
from dynapix.evaluation.retrieval.text_matching import ROUTES, future_text, rank_by_text
from tests.evaluation.metrics.reference import matrix_metrics
from tests.evaluation.models import released
from tests.evaluation.models.conftest import NO_LORA, STUDENT, check_resumed, new_run, tear
from tests.saved_retrievers import sentence_encoder
from tests.user_errors import raises_user_error

SERVED = StudentConfig(name="any", model="any", image_size=96, max_new_tokens=40)
RATIONALE = (
    "Scene parse: A cube.\nMotion analysis: It moves.\nPrediction: The cube will be near the top.\n"
    "Outcome: The cube is near the top.\nAnswer: B"
)
STATE = "The cube will be near the top. The cube is near the top."


@pytest.fixture(scope="module")
def clip(tmp_path_factory) -> RetrieverConfig:
    folder = released.clip(tmp_path_factory.mktemp("released") / "clip")
    return RetrieverConfig(
        name="clip", encoder="dual", model=str(folder), widths=[24, 12],
        image_size=released.IMAGE_SIZE, frames=released.CLIP_FRAMES, **NO_LORA,
    )  # fmt: skip


@pytest.fixture
def store(tmp_path, micro_store) -> Store:
    """A copy of the store, to which the command may write."""
    return open_store(shutil.copytree(micro_store.folder, tmp_path / "store" / "micro"))


@pytest.fixture
def matcher(clip, store, tmp_path) -> Embedder:
    train = ContrastiveTrainConfig(precision="fp32")
    [embedder] = open_embedders(
        None, EmbedderConfig(retriever=clip, train=train), store, tmp_path, 16
    )
    return embedder


@pytest.fixture
def rank(store, matcher) -> Callable[..., Ranks]:
    """A function that ranks the standard test by texts for its queries and captions of its
    frames."""
    queries, database = load_test(store)

    def rank(route: str, query_texts: list[str], captions: list[str] = ()) -> Ranks:
        texts = {ROUTES[route].mode: dict(zip((q.name for q in queries), query_texts, strict=True))}
        texts["caption"] = dict(zip((f.name for f in database), captions, strict=False))
        return rank_by_text(ROUTES[route], matcher, texts, queries, database)

    return rank


@pytest.mark.parametrize(
    ("text", "state"),
    [
        (RATIONALE, STATE),
        (RATIONALE.replace("Prediction:", "### 3. **prediction**\n"), STATE),
        (RATIONALE.replace("Outcome:", "**Outcome:**"), STATE),
        (f"<think>Prediction: A sphere.</think>\n{RATIONALE}", STATE),
        ("  The cube is near the top.\n", "The cube is near the top."),
        ("Scene parse: A cube.", "Scene parse: A cube."),
        ("<think>The cube will", ""),
        ("\ud800 rests", "? rests"),
        (" \n", ""),
    ],
)
def test_the_part_of_a_response_about_the_target_is_matched(text, state) -> None:
    assert future_text(text) == state


def test_ranks_follow_from_the_scores_and_an_empty_text_is_a_miss(rank, store, matcher) -> None:
    queries, database = load_test(store)
    texts = [f"The scene after {q.question} {k}" for k, q in enumerate(queries)]
    found = rank("predict_image", texts)
    encoder = matcher.encoder
    scores = encoder.embed_texts(texts) @ encoder.embed_frames(database, matcher.frames).T
    targets = np.array([database.index(q.target) for q in queries])
    expected = matrix_metrics(scores, targets, [10])
    row = retrieval_results("micro", "x", found, queries, 0)[0]
    assert row.mrr.value == pytest.approx(expected["mrr"], rel=0.01)
    assert row.median_rank.value == pytest.approx(expected["median_rank"], abs=1)

    missing = rank("predict_image", ["", *texts[1:-1], ""])
    assert missing.found.tolist() == [False, *[True] * (len(texts) - 2), False]
    assert (missing.above[:, 1:-1] == found.above[:, 1:-1]).all()
    row = retrieval_results("micro", "x", missing, queries, 0)[0]
    assert (row.queries, row.frames) == (len(queries), len(database))
    measures = query_metrics(found.above[0], found.tied[0], found.found, len(database), [1])
    assert row.mrr.value == pytest.approx(measures["mrr"][1:-1].sum() / len(queries))
    with raises_user_error("no-texts", contains="predict -> image"):
        rank("predict_image", [""] * len(queries))


def test_a_text_is_matched_to_the_caption_with_the_same_words(rank, store) -> None:
    queries, database = load_test(store)
    captions = [f"Frame {f.name}." for f in database]
    texts = [f"Frame {q.target.name}." for q in queries]
    found = rank("predict_caption", texts, captions)
    assert not found.above.any()
    assert not found.tied.any()
    # Frames with the same caption tie.
    same = rank("predict_caption", texts, ["A frame."] * len(captions))
    assert (same.tied == len(database) - 1).all()
    # A query whose target has no caption is a miss. The frame still counts in the database.
    first = captions.index(texts[0])
    captions[first] = ""
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


def log_of(store: Store) -> Path:
    [log] = (store.folder / "texts").glob("*/texts.jsonl")
    return log


@pytest.mark.slow
def test_a_students_texts_serve_every_matcher(
    measure, store, trained_student, clip, tmp_path
) -> None:
    folder = Path(shutil.copytree(trained_student, tmp_path / "sft"))
    routes = ["cot_text", "predict_caption", "predict_image"]
    # With random weights, greedy decoding gives every response the same text.
    overrides = ("student.temperature=1.0", "student.top_k=50")
    settings = {
        "model": str(folder), "routes": routes,
        "student": replace(STUDENT, temperature=1.0, top_k=50),
    }  # fmt: skip
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
    assert "Qwen3-VL-2B predict -> caption" in text
    assert "Parsed responses" in text
    matched = (tmp_path / "one" / "matched.jsonl").read_text().splitlines()
    assert len(matched) == 3 * len(queries)
    assert (tmp_path / "one" / "retrieval.png").stat().st_size > 10_000

    # A killed run generates the missing texts again, in batches of any size.
    log = log_of(store)
    complete, torn = tear(log)
    assert measure("two", *overrides, **settings, batch=5) == (metrics, report)
    check_resumed(log, complete, torn)

    # With another matcher, the student is not loaded: without config.json, it could not be loaded.
    (folder / "student" / "config.json").unlink()
    other = EmbedderConfig(retriever=replace(clip, name="narrow", widths=[12]))
    again, _ = measure("three", *overrides, **settings, matcher=other)
    assert set(again) == set(metrics)


@pytest.mark.slow
def test_texts_of_a_server_are_requested_once(
    measure, store, start_server, monkeypatch, tmp_path
) -> None:
    server = start_server(lambda _: 500 if len(server.requests) == 6 else RATIONALE)
    served = ServerConfig(
        url=server.url, model="served", concurrency=1, unreachable_timeout=0.2, timeout=10.0
    )
    settings = {"server": served, "routes": ["cot_text", "predict_image"]}
    queries, _ = load_test(store)
    _, report = measure(**settings)
    assert report["texts"]["rationale"]["  prediction and outcome alone"] == len(queries)
    # A text is requested once, except for the request that failed.
    requests = len(server.requests)
    assert measure("two", **settings)[1] == report
    # A store that cannot be written has texts to read, and keeps no others.
    monkeypatch.setattr("os.access", lambda *_: False)
    assert measure("three", **settings)[1] == report
    assert len(server.requests) == requests
    assert (tmp_path / "three" / "texts" / "texts.jsonl").exists()


def test_a_late_interaction_matcher_is_refused(measure) -> None:
    late = RetrieverConfig(name="late", model="unused", late=LateConfig(width=24))
    with raises_user_error("unsupported-matcher", contains="retriever.late"):
        measure(matcher=EmbedderConfig(retriever=late))


def test_a_student_without_rationales_is_refused(measure, trained_student, tmp_path) -> None:
    shutil.copytree(trained_student, tmp_path / "sft")
    config = OmegaConf.load(tmp_path / "sft" / "config.yaml")
    config.train.regime = "answer_only"
    OmegaConf.save(config, tmp_path / "sft" / "config.yaml")
    with raises_user_error("unsupported-route", contains="cot_text"):
        measure(model=str(tmp_path / "sft"))


def test_a_sentence_encoder_matches_captions_and_nothing_else(
    store, tmp_path, micro, monkeypatch
) -> None:
    """For another route, it is refused before a text is written."""
    minilm = RetrieverConfig(
        name="minilm", model=str(sentence_encoder(tmp_path / "minilm")), widths=[32, 16], **NO_LORA
    )
    settings = EmbedderConfig(retriever=minilm, train=ContrastiveTrainConfig(precision="fp32"))
    [matcher] = open_embedders(None, settings, store, tmp_path, 16)
    queries, database = load_test(store)
    texts = {
        "prediction": {q.name: f"Frame {q.target.name}." for q in queries},
        "caption": {f.name: f"Frame {f.name}." for f in database},
    }
    ranks = rank_by_text(ROUTES["predict_caption"], matcher, texts, queries, database)
    assert not ranks.above.any()
    monkeypatch.setattr("dynapix.evaluation.generators.generator.open_generator", None)
    for number, routes in enumerate((["predict_image"], None, ["cot_text", "predict_caption"])):
        cfg = TwoStageCommand(
            benchmark=micro, student=SERVED, store=str(store.folder.parent), routes=routes,
            matcher=settings,
        )  # fmt: skip
        with raises_user_error("no-images", contains="routes=[predict_caption]"):
            two_stage.main.__wrapped__(cfg, new_run(tmp_path / str(number)))
    with raises_user_error("no-images", contains="minilm"):
        matcher.embed_queries(queries)
