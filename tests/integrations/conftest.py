"""A served student and a trained retriever, and their results in `evaluation`."""

from __future__ import annotations

import os
import subprocess
from collections.abc import Callable, Iterator
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from types import ModuleType

import pytest

from dynapix.conf.compose import compose
from dynapix.conf.entry import Run
from dynapix.conf.files import read_json_lines, write_json
from dynapix.conf.runs import open_run
from dynapix.conf.schema import (
    CommandConfig,
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


def run_main(module: ModuleType, settings: CommandConfig, folder: Path) -> dict[str, float]:
    """Run a command in a folder of runs of its own, and return its metrics."""
    run = Run(folder.name, folder)
    open_run(run, asdict(settings), module.__name__.removeprefix("dynapix."))
    metrics = module.main.__wrapped__(settings, run)
    write_json(folder / "metrics.json", metrics)
    return metrics


@pytest.fixture(scope="session")
def served(micro, micro_store, tmp_path_factory) -> Iterator[Served]:
    folder = tmp_path_factory.mktemp("served")
    overrides = ["student=tiny", "+exp=answer_only", "train.precision=fp32"]
    settings = compose("train.sft", SftCommand, overrides)
    train = replace(settings.train, max_steps=8, batch=8, evaluations=1, generated_items=0)
    shared = {"store": str(micro_store.folder.parent), "checkpoints": str(folder), "workers": 1}
    settings = replace(settings, benchmark=micro, train=train, run="answers", **shared)
    run_main(sft, settings, trained := folder / "sft" / "answers")
    exported = ExportModelCommand(**{**shared, "run": "answers", "format": "fp32"})
    run_main(export, exported, folder / "export_model")
    weights = folder / "export_model" / "student"
    server = transformers_server(weights, folder)
    server.start()
    command = SelectCommand(
        benchmark=micro, student=settings.student, model=str(trained), modes=["answer"],
        server=ServerConfig(url=server.url, model=str(weights)), **shared,
    )  # fmt: skip
    metrics = run_main(select, command, run := folder / "select" / "answers")
    rows = [row for row in read_json_lines(run / "answers.jsonl") if "item_id" in row]
    texts = {row["item_id"]: row["text"] for row in rows}
    # The student chooses several letters, so that equal answers are no accident.
    assert len(set(texts.values())) > 1
    yield Served(server.url, str(weights), micro_store, texts, metrics["answer_macro"], weights)
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
    base = compose("train.contrastive", ContrastiveCommand, ["retriever=tiny"]).retriever.model
    overrides = ["retriever=tiny", f"retriever.model={Path(base).absolute()}"]
    overrides.append("retriever.image_size=96")
    preset = compose("train.contrastive", ContrastiveCommand, overrides).retriever
    settings = ContrastiveCommand(benchmark=micro, retriever=preset, train=train, **shared)
    run_main(contrastive, settings, trained := folder / "contrastive" / "moving")
    command = RetrieveCommand(benchmark=micro, retriever=preset, model=str(trained), **shared)
    run_main(retrieve, command, trained / "ranked")
    return trained
