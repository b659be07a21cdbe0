"""Saved retrievers of several families are trained, resumed, exported and measured."""

from __future__ import annotations

import json
import shutil
from dataclasses import asdict, replace

import pytest
import torch
from sentence_transformers import SentenceTransformer

from dynapix.conf.entry import Run
from dynapix.conf.runs import open_run
from dynapix.conf.schema import (
    ContrastiveCommand,
    ExportModelCommand,
    LoraConfig,
    RetrieveCommand,
    RetrieverConfig,
    SimilarityCommand,
)
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.evaluation import retrieve, similarity
from dynapix.models.retriever.embedder import load_retriever, load_trained
from dynapix.models.retriever.inputs import embed, encode, model_inputs
from dynapix.train import contrastive, export
from tests.children import run_cards
from tests.saved_retrievers import PROMPTS, RETRIEVERS, saved_retriever
from tests.train.common.test_resume import check_same_weights, train_twice

SIZE, FRAMES = 56, 4


@pytest.fixture(scope="module", params=RETRIEVERS)
def settings(request, contrastive_settings, tmp_path_factory) -> ContrastiveCommand:
    folder = saved_retriever(request.param, tmp_path_factory.mktemp(request.param))
    cfg = RetrieverConfig(
        name=request.param, model=str(folder), quantization="none", lora=LoraConfig(rank=4),
        image_size=SIZE, frames=FRAMES, max_length=2048, widths=[24, 12],
    )  # fmt: skip
    return replace(
        contrastive_settings,
        retriever=cfg,
        train=replace(contrastive_settings.train, max_steps=2, reuse_features=True),
    )


@pytest.fixture
def reader(micro_store) -> FrameReader:
    return FrameReader(micro_store, SIZE)


def test_a_query_has_the_frames_of_its_prefix_the_question_and_the_prompt(
    settings, micro_store, reader, tmp_path
) -> None:
    cfg, query = settings.retriever, micro_store.retrieval("train")[0]
    model = load_retriever(cfg, "fp32", [], tmp_path)
    assert model.prompts == PROMPTS
    inputs, kind = model_inputs(model, [query], reader, cfg)
    [embedded] = encode(model, inputs, kind, 1)
    plain = SentenceTransformer(cfg.model, device="cpu")
    if cfg.name == "clip":
        [separate] = inputs
        # The tokenizer of the tiny model does not know the length of its text tower.
        plain[0].processing_kwargs = {"text": {"max_length": 77}}
        assert len(separate.images) == FRAMES
        images = torch.from_numpy(plain.encode(separate.images))
        prefix = torch.nn.functional.normalize(images.mean(0), dim=0)
        text = torch.from_numpy(plain.encode(f"{PROMPTS['query']}{query.question}"))
        wanted = torch.nn.functional.normalize(prefix + text, dim=0)
    else:
        features = model.preprocess(inputs, prompt=PROMPTS["query"])
        text = model.tokenizer.decode(features["input_ids"][0])
        assert text.count(" s:") == FRAMES
        # Frames are not divided into crops.
        plain[0].processor.image_processor.do_image_splitting = False
        assert text.index(PROMPTS["query"].strip()) < text.index(query.question)
        wanted = torch.from_numpy(plain.encode_query(inputs)[0])
    # New adapters change nothing: this is the saved retriever with its own pooling.
    torch.testing.assert_close(embedded, wanted, atol=1e-5, rtol=0)


@pytest.mark.slow
def test_a_run_is_resumed_exported_and_measured(
    settings, micro, micro_store, reader, tmp_path, caplog
) -> None:
    caplog.set_level("INFO")
    (tmp_path / "contrastive").mkdir()
    whole, resumed = train_twice(contrastive.main, settings, tmp_path / "contrastive", 1)
    assert "reuse_features has no effect" in caplog.text
    check_same_weights(*(f / "retriever" / "adapter_model.safetensors" for f in (whole, resumed)))

    open_run(Run("whole", whole), asdict(settings), "train.contrastive")
    (whole / "metrics.json").write_text("{}")
    queries = micro_store.standard_test()[:4]
    trained = load_trained(settings.retriever, "fp32", whole / "retriever")
    expected = torch.stack(embed(trained, queries, reader, settings.retriever, 4))
    exports = []
    for format in ("adapter", "fp32"):
        into = tmp_path / "export" / format
        into.mkdir(parents=True)
        cfg = ExportModelCommand(
            product="retriever", run="whole", format=format, store=settings.store,
            checkpoints=str(tmp_path), workers=1,
        )  # fmt: skip
        export.main.__wrapped__(cfg, Run(f"whole/{format}", into))
        saved = into / "retriever"
        again = load_trained(settings.retriever, "fp32", saved)
        assert again.prompts == PROMPTS
        embedded = torch.stack(embed(again, queries, reader, settings.retriever, 4))
        torch.testing.assert_close(embedded, expected, atol=1e-4, rtol=0)
        exports.append(saved)
    assert run_cards(exports, tmp_path).count("tensor([[") == 2
    for command, schema in ((retrieve, RetrieveCommand), (similarity, SimilarityCommand)):
        folder = tmp_path / command.__name__
        folder.mkdir()
        store = shutil.copytree(micro_store.folder, tmp_path / f"{folder.name} store" / "micro")
        command.main.__wrapped__(
            schema(
                benchmark=micro, retriever=settings.retriever, model=str(whole), batch=16,
                store=str(store.parent),
            ),
            Run(folder.name, folder),
        )  # fmt: skip
        names = {row["name"] for row in json.loads((folder / "report.json").read_text())["rows"]}
        assert {"whole", f"untrained {settings.retriever.name}"} <= names
