"""Other trainers build from exported rows the prompts of our own students and retrievers."""

from __future__ import annotations

import json
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from datasets import Dataset, load_dataset
from PIL import Image
from sentence_transformers import SentenceTransformer, SentenceTransformerTrainer
from sentence_transformers import SentenceTransformerTrainingArguments as TrainingArguments
from sentence_transformers.sentence_transformer.losses import MultipleNegativesRankingLoss
from sentence_transformers.sentence_transformer.modules import Pooling, Transformer
from transformers import AutoModelForImageTextToText, AutoProcessor
from trl import SFTConfig, SFTTrainer
from trl.trainer.sft_trainer import DataCollatorForVisionLanguageModeling

from dynapix.conf.compose import compose
from dynapix.conf.schema import ExportCommand
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.store import Store
from dynapix.models.retriever.inputs import preprocess, query_messages
from dynapix.models.student.collator import encode
from dynapix.models.student.prompts import show_frames_as_images
from dynapix.teacher.narrate import ensure_rationales
from dynapix.train.common.training_rows import ensure_rows
from dynapix.train.student.dataset import supervised_items
from tests.user_errors import raises_user_error

pytestmark = pytest.mark.slow
BASE = "checkpoints/bases/tiny"


@pytest.fixture(scope="module")
def export(micro_store: Store, tmp_path_factory) -> Any:
    """Exports rows of a format and returns the settings."""
    root = tmp_path_factory.mktemp("rows")

    def run(kind: str) -> ExportCommand:
        cfg = compose("data.export", ExportCommand, [f"format={kind}", f"folder={root / kind}"])
        ensure_rows(cfg, micro_store)
        return cfg

    return run


def load_rows(folder: str, cache: Path) -> Dataset:
    return load_dataset("imagefolder", data_dir=folder, split="train", cache_dir=str(cache))


def own_prompts(store: Store, cfg: ExportCommand, processor: Any) -> dict[tuple[str, str], list]:
    """The ids of the prompts and responses by item and mode, with the clip as images."""
    rationales = {r.item_id: r for r in ensure_rationales(store, cfg.teacher)}
    items, regime = store.training_items(), cfg.train.regime
    frames, ids = FrameReader(store, cfg.student.image_size), {}
    for mode, supervised in supervised_items(store, items, rationales, regime, cfg.teacher).items():
        for item in supervised[:3]:
            sample = show_frames_as_images(item.render(frames, cfg.student.frames))
            ids[item.item.item_id, mode] = encode(sample, processor, None).input_ids
    return ids


def test_trl_reads_the_same_tokens_and_trains(micro_store, export, tmp_path) -> None:
    cfg = export("trl")
    rows = load_rows(cfg.folder, tmp_path)
    processor = AutoProcessor.from_pretrained(BASE)
    collate = DataCollatorForVisionLanguageModeling(processor, completion_only_loss=True)
    own = own_prompts(micro_store, cfg, processor)
    chosen = [row for row in rows if (row["item_id"], row["mode"]) in own]
    assert len(chosen) == len(own) == 6
    for row in chosen:
        expected = own[row["item_id"], row["mode"]]
        batch = collate([row])
        # TRL ends a response with the template's line break, which no model has to write.
        assert batch["input_ids"][0].tolist()[: len(expected)] == expected
        assert len(batch["input_ids"][0]) <= len(expected) + 1
        assert batch["labels"][0][batch["labels"][0] != -100].numel() < 400

    trainer = SFTTrainer(
        model=AutoModelForImageTextToText.from_pretrained(BASE),
        args=SFTConfig(
            str(tmp_path / "out"), max_steps=2, per_device_train_batch_size=2, max_length=None,
            report_to=[], save_strategy="no", use_cpu=True, bf16=False,
        ),
        train_dataset=rows.select(range(4)),
        processing_class=processor,
    )  # fmt: skip
    assert 0 < trainer.train().training_loss < 5


def test_the_rows_of_text_formats_have_a_placeholder_for_each_image(micro_store, export) -> None:
    processor = AutoProcessor.from_pretrained(BASE)
    own = None
    for kind, column, speaker in (
        ("swift", "messages", "role"),
        ("sharegpt", "conversations", "from"),
    ):
        cfg = export(kind)
        own = own or own_prompts(micro_store, cfg, processor)
        lines = (Path(cfg.folder) / "train.jsonl").read_text().splitlines()
        for row in map(json.loads, lines):
            question, response = row[column]
            assert {question[speaker], response[speaker]} in (
                {"user", "assistant"},
                {"human", "gpt"},
            )
            text = question["content" if kind == "swift" else "value"]
            assert text.count("<image>") == len(row["images"])
            assert all((Path(cfg.folder) / name).exists() for name in row["images"])
            if expected := own.get((row["item_id"], row["mode"])):
                # As these trainers do, replace each placeholder by the model's own.
                vision = "<|vision_start|><|image_pad|><|vision_end|>"
                prompt = f"<|im_start|>user\n{text.replace('<image>', vision)}<|im_end|>\n"
                images = [Image.open(Path(cfg.folder) / name) for name in row["images"]]
                ids = processor(text=[f"{prompt}<|im_start|>assistant\n"], images=[images])
                assert ids["input_ids"][0] == expected[: len(ids["input_ids"][0])]


def test_sentence_transformers_reads_the_same_tokens_and_trains(
    micro_store, export, tmp_path
) -> None:
    cfg = export("embedding")
    rows = load_dataset(cfg.folder, split="train", cache_dir=str(tmp_path / "cache"))
    model = SentenceTransformer(
        modules=[Transformer(BASE), Pooling(192, "lasttoken")], device="cpu"
    )
    queries = micro_store.retrieval("train", "future")
    frames = FrameReader(micro_store, cfg.student.image_size)
    assert len(rows) == len(queries)
    for k in range(3):
        own = query_messages(queries[k], frames, cfg.student.frames)
        theirs = model.preprocess([rows[k]["query"]])
        assert torch.equal(preprocess(model, [own], "query")["input_ids"], theirs["input_ids"])
        target = queries[k].target
        pixels = frames.array(target.scene_id, target.frame)
        assert np.array_equal(np.asarray(rows[k]["positive"]), pixels)
    trainer = SentenceTransformerTrainer(
        model,
        TrainingArguments(str(tmp_path / "out"), max_steps=2, per_device_train_batch_size=2,
                          report_to=[], use_cpu=True),
        rows,
        loss=MultipleNegativesRankingLoss(model),
    )  # fmt: skip
    assert trainer.train().training_loss > 0


def test_rows_have_images_and_are_of_one_benchmark() -> None:
    refused = partial(compose, "data.export", ExportCommand)
    for override in ("images=false", "also=[small]"):
        with raises_user_error("invalid-setting", contains="format=trl"):
            refused(["format=trl", override])
