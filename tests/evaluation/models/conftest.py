"""Finished runs of small models, for the tests of the evaluation commands."""

from __future__ import annotations

from pathlib import Path

import pytest
import torch

from dynapix.conf.entry import Run
from dynapix.conf.schema import (
    BenchmarkConfig,
    ContrastiveCommand,
    ContrastiveTrainConfig,
    LoraConfig,
    RetrieverConfig,
    ServerConfig,
    SftCommand,
    StudentConfig,
    TeacherConfig,
)
from dynapix.data.store import Store
from dynapix.models import loading
from dynapix.models.retriever import embedder
from dynapix.train.student import dataset
from tests.evaluation.chat_server import ChatServer
from tests.evaluation.models import released
from tests.evaluation.reporting.measured import finish
from tests.tiny_models import SMALL

NO_LORA = {"quantization": "none", "lora": LoraConfig(rank=0)}
STUDENT = StudentConfig(
    name="small", architecture=SMALL, image_size=96, max_length=1500, max_new_tokens=12, **NO_LORA
)
RETRIEVER = RetrieverConfig(
    name="small", architecture=SMALL, image_size=96, widths=[64, 32], **NO_LORA
)
SERVED = StudentConfig(name="any", model="any", image_size=96, max_length=1500, max_new_tokens=40)


def served_by(*servers: ChatServer, **changes: object) -> ServerConfig:
    """Return the settings of a client of servers."""
    settings = {"concurrency": 3, "unreachable_timeout": 5.0, "timeout": 10.0, **changes}
    return ServerConfig(url=[s.url for s in servers], model="served", **settings)


def new_run(folder: Path, *overrides: str) -> Run:
    folder.mkdir(parents=True, exist_ok=True)
    return Run(folder.name, folder, overrides)


def save_retriever(
    cfg: RetrieverConfig, folder: Path, micro: BenchmarkConfig, store: Store
) -> Path:
    """Write a finished run of train.contrastive."""
    texts = embedder.tokenizer_texts(store.retrieval("train"), cfg)
    model = embedder.load_retriever(cfg, "fp32", texts, folder / "untrained")
    # With its initial weights, the model embeds all inputs almost equally.
    noise = torch.Generator().manual_seed(0)
    for weight in model.parameters():
        weight.data += 0.1 * torch.randn(weight.shape, generator=noise)
    model.save_pretrained(str(folder / "retriever"), create_model_card=False)
    train = ContrastiveTrainConfig(precision="bf16")
    finish(folder, ContrastiveCommand(benchmark=micro, retriever=cfg, train=train))
    return folder


@pytest.fixture(scope="session")
def trained_student(tmp_path_factory, micro, micro_store) -> Path:
    """A finished run of train.sft."""
    folder = tmp_path_factory.mktemp("sft") / "run"
    model, processor = loading.load_student(
        STUDENT, "bf16", lambda: dataset.tokenizer_corpus(micro_store, [])
    )
    loading.save_student(model, processor, folder / "student", "bf16")
    settings = SftCommand(benchmark=micro, teacher=TeacherConfig(name="template"), student=STUDENT)
    finish(folder, settings, metrics={"answer_loss": 1.0, "answer_loss_at_start": 2.0})
    return folder


@pytest.fixture(scope="session")
def trained_retriever(tmp_path_factory, micro, micro_store) -> Path:
    """A finished run of train.contrastive."""
    folder = tmp_path_factory.mktemp("contrastive") / "run"
    return save_retriever(RETRIEVER, folder, micro, micro_store)


@pytest.fixture(scope="session")
def clip(tmp_path_factory) -> RetrieverConfig:
    """An encoder of frames and texts, which is not trained."""
    folder = released.clip(tmp_path_factory.mktemp("released") / "clip")
    return RetrieverConfig(
        name="clip", encoder="dual", model=str(folder), widths=[24, 12],
        image_size=released.IMAGE_SIZE, frames=released.CLIP_FRAMES, **NO_LORA,
    )  # fmt: skip
