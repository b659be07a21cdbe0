"""Fixtures of a student and a retriever that are small enough to train in seconds."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import pytest
import torch
from torch import nn
from transformers import PreTrainedModel, ProcessorMixin

from dynapix.conf.schema import (
    ArchitectureConfig,
    BenchmarkConfig,
    ContrastiveCommand,
    ContrastiveTrainConfig,
    LoraConfig,
    RetrieverConfig,
    SftCommand,
    SftTrainConfig,
    StudentConfig,
    TeacherConfig,
)
from dynapix.data.frames.frame_cache import FrameReader
from dynapix.data.records import RetrievalQuery
from dynapix.data.store import Store
from dynapix.models.tiny_qwen3_vl import build_model, build_processor
from dynapix.train.student import dataset
from dynapix.train.student.trainer import token_mean

SMALL = ArchitectureConfig(
    hidden=64,
    layers=2,
    heads=2,
    kv_heads=2,
    feed_forward=128,
    vision_hidden=64,
    vision_layers=2,
    vision_heads=2,
    vision_feed_forward=128,
)


@pytest.fixture(scope="session")
def student_cfg() -> StudentConfig:
    return StudentConfig(
        name="small", architecture=SMALL, quantization="none", lora=LoraConfig(rank=0),
        image_size=96,
        max_length=1500,
    )  # fmt: skip


@pytest.fixture(scope="session")
def retriever_cfg() -> RetrieverConfig:
    return RetrieverConfig(
        name="small", architecture=SMALL, quantization="none", lora=LoraConfig(rank=0),
        image_size=96, widths=[64, 32], query_instruction="Retrieve images or text.",
        frame_instruction="Represent the user's input.",
    )  # fmt: skip


@pytest.fixture(scope="session")
def processor(micro_store: Store) -> ProcessorMixin:
    return build_processor(dataset.tokenizer_corpus(micro_store, []), 1024, 96, 16)


@pytest.fixture
def model(processor: ProcessorMixin) -> PreTrainedModel:
    return build_model(SMALL, len(processor.tokenizer))


@pytest.fixture(scope="session")
def saved_base(tmp_path_factory: pytest.TempPathFactory, processor: ProcessorMixin) -> str:
    """The folder of a base with random weights."""
    folder = tmp_path_factory.mktemp("base")
    build_model(SMALL, len(processor.tokenizer)).save_pretrained(folder)
    processor.save_pretrained(folder)
    return str(folder)


@pytest.fixture(scope="session")
def nf4_cfg(saved_base: str) -> StudentConfig:
    return StudentConfig(
        name="nf4",
        model=saved_base,
        image_size=96,
        max_length=1500,
        max_new_tokens=8,
        lora=LoraConfig(rank=4),
    )


def randomize_adapters(model: nn.Module, std: float) -> None:
    """Randomize LoRA's B matrices, which are zero at first, so that adapters change the outputs."""
    for name, weight in model.named_parameters():
        if "lora_B" in name:
            nn.init.normal_(weight, std=std)


Gradients = dict[str, torch.Tensor]


def collect_gradients(model: nn.Module) -> Gradients:
    return {n: p.grad.clone() for n, p in model.named_parameters() if p.grad is not None}


def loss_and_gradients(model: nn.Module, batch: dict[str, Any]) -> tuple[torch.Tensor, Gradients]:
    """Return the loss and all gradients, with the same dropout in each call."""
    model.zero_grad()
    torch.manual_seed(1)
    inputs = {name: value for name, value in batch.items() if name != "labels"}
    loss = token_mean(model(**inputs), batch["labels"])
    loss.backward()
    return loss.detach(), collect_gradients(model)


def assert_equal_gradients(found: Gradients, expected: Gradients) -> None:
    assert found.keys() == expected.keys()
    for name, gradient in expected.items():
        assert (found[name] - gradient).norm() <= 1e-4 * gradient.norm() + 1e-7, name


@pytest.fixture(scope="session")
def frames(micro_store: Store) -> FrameReader:
    return FrameReader(micro_store, 96)


@pytest.fixture(scope="session")
def few_steps(
    micro: BenchmarkConfig, micro_store: Store, nf4_cfg: StudentConfig
) -> Callable[..., SftCommand]:
    """A function that returns settings of `train.sft` for a few steps.

    Its arguments replace settings of the group `train`.
    """

    def settings(**overrides: object) -> SftCommand:
        few = SftTrainConfig(
            lr=1e-3, max_steps=4, batch=2, micro_batch=2, precision="fp32", evaluations=2,
            gradient_checkpointing=False, validation_items=2, generated_items=0,
        )  # fmt: skip
        return SftCommand(
            benchmark=micro,
            store=str(micro_store.folder.parent),
            workers=1,
            teacher=TeacherConfig(name="template"),
            student=nf4_cfg,
            train=replace(few, **overrides),
        )

    return settings


@pytest.fixture(scope="session")
def contrastive_settings(
    micro: BenchmarkConfig, micro_store: Store, retriever_cfg: RetrieverConfig
) -> ContrastiveCommand:
    """Settings of `train.contrastive` for a few steps of a small retriever."""
    train = ContrastiveTrainConfig(
        lr=1e-3, max_steps=4, batch=4, mini_batch=2, precision="fp32",
        gradient_checkpointing=False, evaluations=2, validation_queries=4,
    )  # fmt: skip
    return ContrastiveCommand(
        benchmark=micro,
        store=str(micro_store.folder.parent),
        workers=1,
        retriever=retriever_cfg,
        train=train,
    )


@pytest.fixture(scope="session")
def queries(micro_store: Store) -> list[RetrievalQuery]:
    """Ten queries, some of which share a prefix or a frame."""
    queries = micro_store.retrieval("train")[:6]
    longer = [
        replace(
            q,
            query_id=f"{q.query_id} longer",
            question=f"{q.question} Or else, which frame comes before that?",
            target=q.hard_negatives[0],
            hard_negatives=(q.target, queries[0].target),
        )
        for q in queries[1:5]
    ]
    return [*queries, *longer]
