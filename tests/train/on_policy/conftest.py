"""A student to train further."""

from __future__ import annotations

import json
from dataclasses import asdict, replace
from pathlib import Path

import pytest

from dynapix.conf.entry import Run
from dynapix.conf.runs import open_run
from dynapix.conf.schema import SftCommand
from dynapix.train import sft


def finish_run(settings: SftCommand, folder: Path) -> Path:
    """Train a student, as the command does."""
    # The tokenizer was not trained on rationales.
    settings = replace(settings, student=replace(settings.student, max_length=4000))
    run = Run(folder.name, folder)
    open_run(run, asdict(settings), "train.sft")
    metrics = sft.main.__wrapped__(settings, run)
    (folder / "metrics.json").write_text(json.dumps(metrics))
    return folder


@pytest.fixture(scope="session")
def student(few_steps, tmp_path_factory) -> Path:
    return finish_run(few_steps(max_steps=1), tmp_path_factory.mktemp("student"))
