"""A served student and a trained retriever, and their results in `evaluation`."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path

import pytest

from dynapix.conf.compose import compose
from dynapix.conf.entry import Run
from dynapix.conf.files import read_json_lines, write_json
from dynapix.conf.runs import open_run
from dynapix.conf.schema import (
    ContrastiveCommand,
    ContrastiveTrainConfig,
    ExportModelCommand,
    RetrieveCommand,
    SelectCommand,
    ServerConfig,
    SftCommand,
)
from dynapix.data.store import Store
from dynapix.evaluation import retrieve, select
from dynapix.train import contrastive, export, sft
from tests.teacher.server_process import ROOT, transformers_server

HARNESSES = ROOT / ".venv-harnesses" / "bin"


@dataclass(frozen=True)
class Served:
    """A student on a server.

    Attributes:
        model: Its name on the server.
        texts: Its responses in answer mode, by item id, that `evaluation.select` measured.
        accuracy: The macro accuracy that `evaluation.select` measured.
        weights: Folder of the student's merged weights.
    """

    url: str
    model: str
    store: Store
    texts: dict[str, str]
    accuracy: float
    weights: Path


@pytest.fixture(scope="session")
def served(micro, micro_store, tmp_path_factory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("served")
    overrides = ["student=tiny", "+exp=answer_only", "train.precision=fp32"]
    settings = compose("train.sft", SftCommand, overrides)
    train = replace(settings.train, max_steps=8, batch=8, evaluations=1, generated_items=0)
    shared = {"store": str(micro_store.folder.parent), "checkpoints": str(folder), "workers": 1}
    settings = replace(settings, benchmark=micro, train=train, run="answers", **shared)
    trained = Run("answers", folder / "sft" / "answers")
    open_run(trained, asdict(settings), "train.sft")
    write_json(trained.folder / "metrics.json", sft.main.__wrapped__(settings, trained))
    exported = ExportModelCommand(**{**shared, "run": "answers", "format": "fp32"})
    into = folder / "export_model"
    into.mkdir()
    export.main.__wrapped__(exported, Run("answers", into))
    server = transformers_server(into / "student", folder)
    server.start()
    name = str(into / "student")
    command = SelectCommand(
        benchmark=micro, student=settings.student, model=str(trained.folder),
        server=ServerConfig(url=server.url, model=name), modes=["answer"], **shared,
    )  # fmt: skip
    run = folder / "select" / "answers"
    run.mkdir(parents=True)
    metrics = select.main.__wrapped__(command, Run("answers", run))
    rows = [row for row in read_json_lines(run / "answers.jsonl") if "item_id" in row]
    texts = {row["item_id"]: row["text"] for row in rows}
    # The student chooses several letters, so that equal answers are no accident.
    assert len(set(texts.values())) > 1
    yield Served(server.url, name, micro_store, texts, metrics["answer_macro"], into / "student")
    server.stop()


@pytest.fixture
def run_harness(tmp_path) -> Callable[..., str]:
    """Runs a program of `.venv-harnesses` in an empty folder, and returns what it prints."""

    def run(*command: str, **environment: str) -> str:
        path = Path(HARNESSES / command[0])
        done = subprocess.run(
            [path, *command[1:]], cwd=tmp_path, env={**os.environ, **environment}, text=True,
            stdout=subprocess.PIPE, stderr=subprocess.STDOUT, timeout=300,
        )  # fmt: skip
        assert done.returncode == 0, done.stdout
        return done.stdout

    return run


@pytest.fixture(scope="session")
def ranked(micro, micro_store, tmp_path_factory) -> Path:
    """The folder of a trained retriever, which `evaluation.retrieve` measured in `ranked`."""
    folder = tmp_path_factory.mktemp("ranked")
    train = ContrastiveTrainConfig(max_steps=2, batch=8, precision="fp32", evaluations=1)
    shared = {"store": str(micro_store.folder.parent), "checkpoints": str(folder), "workers": 1}
    # The harness runs in another folder than this one.
    base = Path(
        compose("train.contrastive", ContrastiveCommand, ["retriever=tiny"]).retriever.model
    )
    overrides = ["retriever=tiny", f"retriever.model={base.absolute()}", "retriever.image_size=96"]
    preset = compose("train.contrastive", ContrastiveCommand, overrides).retriever
    settings = ContrastiveCommand(benchmark=micro, retriever=preset, train=train, **shared)
    trained = Run("moving", folder / "contrastive" / "moving")
    open_run(trained, asdict(settings), "train.contrastive")
    write_json(trained.folder / "metrics.json", contrastive.main.__wrapped__(settings, trained))
    command = RetrieveCommand(
        benchmark=micro, retriever=preset, model=str(trained.folder), **shared
    )
    run = trained.folder / "ranked"
    run.mkdir()
    retrieve.main.__wrapped__(command, Run("ranked", run))
    return trained.folder
