"""Two-stage retrieval: what is written, what is drawn, and how a frozen encoder matches it."""

from __future__ import annotations

import io
import json
import shutil
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from omegaconf import OmegaConf
from PIL import Image
from transformers import CLIPVisionModel

from conf.entry import Run
from conf.schema import (
    ArchitectureConfig,
    ImageServerConfig,
    LateConfig,
    LoraConfig,
    MatcherConfig,
    RetrieverConfig,
    ServerConfig,
    SftCommand,
    StudentConfig,
    TeacherConfig,
    TwoStageCommand,
)
from data.render.frame_cache import FrameReader
from data.store import Store, open_store
from evaluation import two_stage
from evaluation.embedders.base import embed_queries, open_embedders, untrained_embedder
from evaluation.embedders.joint_encoder import released_encoder
from evaluation.metrics.ranking import query_metrics
from evaluation.metrics.results import retrieval_results
from evaluation.retrieval import text_matching
from evaluation.retrieval.predicted_texts import ROUTES, future_text
from evaluation.retrieval.standard_test import load_standard_test, rank_targets
from models import loading
from tests.evaluation.metrics.reference import matrix_metrics
from tests.evaluation.models import released
from tests.user_errors import raises_user_error
from train.student import dataset

SMALL = ArchitectureConfig(
    hidden=64, layers=1, heads=2, kv_heads=2, feed_forward=64,
    vision_hidden=64, vision_layers=1, vision_heads=2, vision_feed_forward=64,
)  # fmt: skip
WHOLE = {"quantization": "none", "lora": LoraConfig(rank=0)}
# It is random, and so are its words.
STUDENT = StudentConfig(
    name="small", architecture=SMALL, image_size=96, max_length=1500, max_new_tokens=12,
    temperature=1.0, top_k=50, **WHOLE,
)  # fmt: skip
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
        image_size=released.SIZE, frames=released.TIMES, **WHOLE,
    )  # fmt: skip


@pytest.fixture
def store(tmp_path, micro_store) -> Store:
    """A copy, which what is written may be kept in."""
    return open_store(shutil.copytree(micro_store.folder, tmp_path / "store" / "micro"))


@pytest.fixture
def ranks(store, clip, tmp_path) -> Callable[..., text_matching.Ranks]:
    """Ranks of the standard test by texts of its queries, and of frames."""
    queries, database = load_standard_test(store)
    matcher = untrained_embedder(clip, "fp32", tmp_path)

    def rank(route: str, said: list[str], captions: list[str] = (), **images):
        texts = {ROUTES[route].mode: dict(zip((q.name for q in queries), said, strict=True))}
        texts["caption"] = dict(zip((f.name for f in database), captions, strict=False))
        cfg = TwoStageCommand(images=ImageServerConfig(model="painter", **images))
        return text_matching.rank_by_text(
            cfg, ROUTES[route], matcher, texts, queries, database, store
        )

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
        (" \n", ""),
    ],
)
def test_the_foreseen_state_is_matched(text, state) -> None:
    assert future_text(text) == state


def test_texts_rank_by_their_scores_and_a_missing_one_is_a_miss(ranks, store, clip) -> None:
    queries, database = load_standard_test(store)
    said = [f"The scene after {q.question} {k}" for k, q in enumerate(queries)]
    found = ranks("predict_image", said)
    encoder = released_encoder(clip, "fp32", Path("unused"))
    scores = encoder.texts(said) @ encoder.frames(database, FrameReader(store, clip.image_size)).T
    gold = np.array([database.index(q.target) for q in queries])
    plain = matrix_metrics(scores, gold, [10])
    row = retrieval_results("micro", "x", found, queries, 0)[0]
    assert row.mrr.value == pytest.approx(plain["mrr"], rel=0.01)
    assert row.median_rank.value == pytest.approx(plain["median_rank"], abs=1)

    missing = ranks("predict_image", ["", *said[1:-1], ""])
    assert missing.found.tolist() == [[False, *[True] * (len(said) - 2), False]] * 2
    assert (missing.greater[:, 1:-1] == found.greater[:, 1:-1]).all()
    less = retrieval_results("micro", "x", missing, queries, 0)[0]
    assert (less.queries, less.frames) == (len(queries), len(database))
    lost = query_metrics(found.greater[0], found.tied[0], found.found[0], len(database), [1])
    assert less.mrr.value == pytest.approx(lost["mrr"][1:-1].sum() / len(queries))
    with raises_user_error("no-texts", contains="predict -> image"):
        ranks("predict_image", [""] * len(queries))


def test_repeating_the_question_ranks_as_seeing_no_prefix(ranks, store, clip, tmp_path) -> None:
    queries, database = load_standard_test(store)
    frames, names = FrameReader(store, clip.image_size), [f.name for f in database]
    [embedder] = open_embedders(None, clip, "fp32", store, tmp_path)
    encoder = embedder.load()
    encoder.embed_clips = lambda clips: np.zeros((len(clips), 24), np.float32)
    blind = replace(embedder, weights="blind")
    asked = embed_queries(blind, queries, store, frames, 16).rows([q.name for q in queries])
    shown = encoder.frames(database, frames)
    targets = shown[[names.index(q.target.name) for q in queries]]
    direct = rank_targets(clip, asked, targets, [shown])
    found = ranks("predict_image", [q.question for q in queries])
    for a, b in zip(
        retrieval_results("micro", "x", found, queries, 0),
        retrieval_results("micro", "x", direct, queries, 0),
        strict=True,
    ):
        assert (a.width, a.builder, a.queries) == (b.width, b.builder, b.queries)
        assert a.mrr.value == pytest.approx(b.mrr.value, rel=0.01)


def test_captions_match_by_their_words(ranks, store) -> None:
    queries, database = load_standard_test(store)
    captions = [f"Frame {f.name}." for f in database]
    said = [f"Frame {q.target.name}." for q in queries]
    found = ranks("predict_caption", said, captions)
    assert not found.greater.any()
    assert not found.tied.any()
    # Frames of one caption cannot be told apart.
    same = ranks("predict_caption", said, ["A frame."] * len(captions))
    assert (same.tied == len(database) - 1).all()
    # A target without a caption is not found; another frame without one stands in nobody's way.
    first = captions.index(said[0])
    bare = ranks("predict_caption", said, ["" if k == first else c for k, c in enumerate(captions)])
    assert bare.found[0].tolist() == [s != said[0] for s in said]
    assert bare.frames == len(database)


def test_a_drawn_target_is_found_first_and_drawn_once(ranks, store, talking) -> None:
    queries, _ = load_standard_test(store)
    pixels = FrameReader(store)

    def paint(request) -> bytes:
        scene, frame = request["prompt"].split("/")
        assert (request["model"], request["size"], request["seed"]) == ("painter", "192x128", 3)
        buffer = io.BytesIO()
        pixels.image(scene, int(frame)).save(buffer, "PNG")
        return buffer.getvalue()

    server = talking(paint)
    drawn = {"url": server.url, "size": "192x128", "seed": 3, "concurrency": 1}
    said = [q.target.name for q in queries]
    found = ranks("predict_generated_image", said, **drawn)
    assert not found.greater.any()
    assert len(server.asked) == len(set(said))
    server.asked.clear()
    assert np.array_equal(ranks("predict_generated_image", said, **drawn).tied, found.tied)
    assert not server.asked
    # A damaged file is drawn again, and another seed draws all.
    damaged = min((store.folder / "generated_images").rglob("*.png"))
    damaged.write_bytes(damaged.read_bytes()[:-40])
    ranks("predict_generated_image", said, **drawn)
    assert len(server.asked) == 1


def test_what_is_drawn_is_kept_when_the_server_fails(ranks, store, talking) -> None:
    queries, _ = load_standard_test(store)
    said = [f"Frame {q.name}" for q in queries]
    buffer = io.BytesIO()
    Image.new("RGB", (8, 8), "gray").save(buffer, "PNG")
    image = buffer.getvalue()
    bad = sorted(said)[3]

    server = talking(lambda r: b"no image" if r["prompt"] == bad else image)
    drawn = {"concurrency": 1, "unreachable_timeout": 0.2, "timeout": 10.0}
    with raises_user_error("no-response", contains=("painter", bad)):
        ranks("predict_generated_image", said, url=server.url, **drawn)
    assert len([*(store.folder / "generated_images").rglob("*.png")]) == 3
    dying = talking(lambda _: image if len(dying.asked) < 3 else 500)
    with raises_user_error("no-server", contains="images.url"):
        ranks("predict_generated_image", said, url=dying.url, **drawn)
    assert len([*(store.folder / "generated_images").rglob("*.png")]) == 5
    whole = talking(lambda _: image)
    assert ranks("predict_generated_image", said, url=whole.url, **drawn).found.all()
    assert len(whole.asked) == len(said) - 5
    chatting = talking(lambda _: 404)
    with raises_user_error("unknown-model", contains="images.model=painter"):
        ranks("predict_generated_image", said, url=chatting.url, seed=1, **drawn)


def test_a_matcher_without_a_text_tower_is_refused(ranks, clip, store, tmp_path) -> None:
    CLIPVisionModel.from_pretrained(clip.model).save_pretrained(tmp_path / "vision")
    blind = replace(clip, model=str(tmp_path / "vision"))
    with raises_user_error("wrong-model-type", contains="clip_vision_model"):
        released_encoder(blind, "fp32", tmp_path)


@pytest.fixture
def world(tmp_path, micro, store, clip) -> Callable[..., tuple[dict, dict]]:
    """Runs the command; its metrics and its report, without the times."""

    def measure(name: str = "one", **settings) -> tuple[dict, dict]:
        run = Run(name, tmp_path / name)
        run.folder.mkdir(exist_ok=True)
        cfg = TwoStageCommand(
            benchmark=micro, student=SERVED, store=str(store.folder.parent),
            matcher=MatcherConfig(retriever=clip, batch=16),
        )  # fmt: skip
        metrics = two_stage.main.__wrapped__(replace(cfg, **settings), run)
        report = json.loads((run.folder / "report.json").read_text())
        assert all(row.pop("seconds") is not None for row in report["rows"])
        return metrics, report

    return measure


def log_of(store: Store) -> Path:
    [log] = (store.folder / "texts").glob("*/texts.jsonl")
    return log


@pytest.mark.slow
def test_a_student_writes_once_for_every_matcher(world, store, micro, clip, tmp_path) -> None:
    folder = tmp_path / "sft"
    model, processor = loading.load_student(
        STUDENT, "bf16", lambda: dataset.tokenizer_corpus(store, [])
    )
    loading.save_student(model, processor, folder / "student", "bf16")
    settings = SftCommand(benchmark=micro, teacher=TeacherConfig(name="template"), student=STUDENT)
    OmegaConf.save(OmegaConf.structured(settings), folder / "config.yaml")
    (folder / "metrics.json").write_text("{}")
    routes = ["cot_text", "predict_caption", "predict_image"]
    asked = {"model": str(folder), "routes": routes}
    metrics, report = world(**asked)
    queries, database = load_standard_test(store)
    assert set(metrics) == {
        f"{r}_{m}" for r in routes for m in ("recall@1", "recall@10", "recall@50", "mrr",
                                             "median_rank")
    }  # fmt: skip
    names = dict.fromkeys(row["name"] for row in report["rows"])
    assert list(names) == [f"sft {ROUTES[r].title}, clip" for r in routes]
    assert {(r["queries"], r["frames"]) for r in report["rows"] if r["builder"] is None} == {
        (len(queries), len(database))
    }
    assert report["texts"]["caption"]["texts"] == len(database)
    text = (tmp_path / "one" / "report.txt").read_text()
    assert "Qwen3-VL-2B predict -> caption" in text
    assert "Parsed responses" in text
    matched = [json.loads(m) for m in (tmp_path / "one" / "matched.jsonl").read_text().splitlines()]
    assert len(matched) == 3 * len(queries)
    assert (tmp_path / "one" / "retrieval.png").stat().st_size > 10_000

    # Killed in the middle of a line it writes what was lost, in whatever batches.
    log = log_of(store)
    whole = log.read_text()
    torn = whole[: len(whole) // 2]
    log.write_text(torn)
    assert world("two", **asked, batch=5) == (metrics, report)
    lines = [*whole.splitlines(), torn.rpartition("\n")[2]]
    assert sorted(log.read_text().splitlines()) == sorted(lines)

    # Another matcher needs no student: there is none any more that could be loaded.
    (folder / "student" / "config.json").unlink()
    other = MatcherConfig(retriever=replace(clip, name="narrow", widths=[12]))
    again, _ = world("three", **asked, matcher=other)
    assert set(again) == set(metrics)


@pytest.mark.slow
def test_texts_are_kept_when_the_server_dies(world, store, talking) -> None:
    def say(request) -> str:
        return f"Prediction: {len(json.dumps(request))} px.\nOutcome: So it is."

    def at(server) -> ServerConfig:
        return ServerConfig(
            url=server.url, model="served", concurrency=1, unreachable_timeout=0.2, timeout=10.0
        )

    dying = talking(lambda r: say(r) if len(dying.asked) < 6 else 500)
    with raises_user_error("no-server", contains="server.url"):
        world(server=at(dying), routes=["cot_text", "predict_image"])
    kept = log_of(store).read_text()
    server = talking(say)
    _, report = world("two", server=at(server), routes=["cot_text", "predict_image"])
    queries, _ = load_standard_test(store)
    assert len(server.asked) == 2 * len(queries) - 5
    assert log_of(store).read_text().startswith(kept)
    assert report["texts"]["rationale"]["  prediction and outcome alone"] == len(queries)
    # Nothing is asked for what is there; undisturbed, the same is written.
    server.asked.clear()
    assert world("three", server=at(server), routes=["predict_image"])[1]["rows"]
    assert not server.asked
    once = sorted(log_of(store).read_text().splitlines())
    shutil.rmtree(store.folder / "texts")
    world("four", server=at(server), routes=["cot_text", "predict_image"])
    assert sorted(log_of(store).read_text().splitlines()) == once


def test_a_matcher_that_reads_no_text_is_refused(world) -> None:
    late = RetrieverConfig(name="late", model="unused", late=LateConfig(width=24))
    with raises_user_error("unsupported-matcher", contains="retriever.late"):
        world(matcher=MatcherConfig(retriever=late))


def test_a_student_without_rationales_is_told(world, micro, tmp_path) -> None:
    (tmp_path / "sft" / "student").mkdir(parents=True)
    settings = SftCommand(benchmark=micro, teacher=TeacherConfig(name="template"), student=STUDENT)
    settings.train.regime = "answer_only"
    OmegaConf.save(OmegaConf.structured(settings), tmp_path / "sft" / "config.yaml")
    (tmp_path / "sft" / "metrics.json").write_text("{}")
    with raises_user_error("unsupported-route", contains="cot_text"):
        world(model=str(tmp_path / "sft"))
