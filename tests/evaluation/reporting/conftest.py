"""Finished runs on the benchmark `micro`, which are written once."""

from __future__ import annotations

import shutil
from collections.abc import Callable
from functools import partial
from pathlib import Path

import pytest

from tests.evaluation.reporting.measured import (
    always_a,
    retrieve_run,
    right,
    run_report,
    select_run,
    similarity_run,
    trained_student,
)

HOSTILE = "</script><script>document.title='taken'</script><img src=x onerror=alert(1)>\nAnswer: B"


@pytest.fixture(scope="session")
def measured(tmp_path_factory, micro, micro_store) -> Path:
    """checkpoints/ with runs of a released base, of students of three regimes (two of them respond
    with `HOSTILE`), of an embedder on items, and of a retriever, directly and in two stages."""
    root = tmp_path_factory.mktemp("checkpoints")
    select_run(root, micro_store, micro, "base", always_a, mode="record")
    for regime in ("answer_only", "cot", "cot_no_candidate_analysis"):
        trained_student(root, micro, regime, regime)
        mode = "answer" if regime == "answer_only" else "reasoning"
        respond = right if regime == "cot" else lambda item: HOSTILE
        select_run(root, micro_store, micro, regime, respond, model=regime, mode=mode)
    similarity_run(root, micro_store, micro, "clip")
    retrieve_run(root, micro_store, micro, "emb")
    retrieve_run(root, micro_store, micro, "emb", kind="two_stage")
    return root


@pytest.fixture(scope="session")
def unchanged(measured, micro_store, tmp_path_factory) -> Path:
    """The report on `measured`, with 12 items."""
    root = tmp_path_factory.mktemp("unchanged") / "checkpoints"
    shutil.copytree(measured, root)
    return run_report(root, micro_store.folder.parent, items=12)


@pytest.fixture
def runs(measured, tmp_path) -> Path:
    """A copy of `measured` that a test may change."""
    shutil.copytree(measured, tmp_path / "checkpoints")
    return tmp_path / "checkpoints"


@pytest.fixture
def report(runs, micro_store) -> Callable[..., Path]:
    """Return a function that reports `runs` with given settings and returns the report's folder."""
    return partial(run_report, runs, micro_store.folder.parent)
