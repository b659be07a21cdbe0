"""Makes the tiny models of tests.tiny_models available to the tests of this folder."""

from tests.tiny_models import (
    contrastive_settings,
    few_steps,
    frames,
    model,
    nf4_cfg,
    processor,
    queries,
    retriever_cfg,
    saved_base,
    student_cfg,
)

__all__ = [
    "contrastive_settings",
    "few_steps",
    "frames",
    "model",
    "nf4_cfg",
    "processor",
    "queries",
    "retriever_cfg",
    "saved_base",
    "student_cfg",
]
