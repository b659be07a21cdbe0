"""Runs over the small benchmark, measured once."""

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
    """checkpoints/ with a released base, students of three regimes (two with hostile responses), a
    similarity scorer, and a retriever that is measured directly and in two stages."""
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


@pytest.fixture
def runs(measured, tmp_path) -> Path:
    """A copy to damage."""
    shutil.copytree(measured, tmp_path / "checkpoints")
    return tmp_path / "checkpoints"


@pytest.fixture
def report(runs, micro_store) -> Callable[..., Path]:
    """Report these runs with some settings, and return the report's folder."""
    return partial(run_report, runs, micro_store.folder.parent)
