"""Several ranks of a launcher share the work of an evaluation."""

from __future__ import annotations

import importlib
import json
import os
import pickle
import shutil
import sqlite3
import sys
from contextlib import closing
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from dynapix.conf.runs import Run
from dynapix.conf.schema import EmbedderConfig, RetrieveCommand, SelectCommand, TwoStageCommand
from tests.children import run_child
from tests.evaluation.models.conftest import STUDENT

ROOT = Path(__file__).parents[3]
Job = tuple[str, object, Path]
LAUNCHED = """
import pickle, sys
from pathlib import Path
from dynapix.models import distributed
from tests.evaluation.models.test_ranks import evaluate

jobs = pickle.loads(Path(sys.argv[1]).read_bytes())
end_ranks = distributed.end_ranks
# A process can start the communication of ranks once, so it ends after the last command.
distributed.end_ranks = lambda: None
evaluate(jobs[:-1])
distributed.end_ranks = end_ranks
evaluate(jobs[-1:])
"""


def evaluate(jobs: list[Job]) -> None:
    """Run commands, each with its settings and in its folder."""
    for command, cfg, folder in jobs:
        main = importlib.import_module(f"dynapix.evaluation.{command}").main
        main.__wrapped__(cfg, Run("run", folder, ("student.temperature", "student.top_k")))


def evaluate_on_two_ranks(jobs: list[Job], folder: Path) -> None:
    (folder / "jobs").write_bytes(pickle.dumps(jobs))
    (folder / "evaluate.py").write_text(LAUNCHED)
    launcher = [Path(sys.executable).with_name("torchrun"), "--standalone", "--nproc-per-node=2"]
    environment = {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    command = [*launcher, folder / "evaluate.py", folder / "jobs"]
    run_child(command, check=True, cwd=ROOT, env={**os.environ, **environment})


def read_results(root: Path) -> dict[str, object]:
    """Return the reports without the times, the embeddings in the order in which they were
    written, and the bytes of the other results."""
    found: dict[str, object] = {}
    for path in sorted(root.rglob("*")):
        name = str(path.relative_to(root))
        if path.name == "report.json":
            found[name] = json.loads(path.read_text())
            for row in found[name]["rows"]:
                row.pop("seconds", None)
        elif path.suffix == ".sqlite":
            with closing(sqlite3.connect(path)) as db:
                rows = db.execute("SELECT name, entries FROM embedding ORDER BY rowid").fetchall()
            found[f"{name} names"] = [row for row, _ in rows]
            found[name] = np.array([np.frombuffer(entries, np.float32) for _, entries in rows])
        elif path.suffix == ".jsonl":
            found[name] = path.read_bytes()
    return found


@pytest.mark.slow
def test_two_ranks_write_what_one_process_writes(
    micro, micro_store, trained_student, trained_retriever, clip, tmp_path
) -> None:
    """Also if one process has finished a part of the answers. Embeddings may differ in the last
    bit, since a CPU's rounding can depend on where a tensor lies in memory."""
    # With random weights, greedy decoding gives every response the same text.
    student = replace(STUDENT, temperature=1.0, top_k=50)
    shared = {"benchmark": micro, "student": student, "model": str(trained_student)}
    commands = {
        "select": SelectCommand(**shared, modes=["answer", "reasoning"], limit=7, batch=3),
        "retrieve": RetrieveCommand(benchmark=micro, model=str(trained_retriever), batch=5),
        "two_stage": TwoStageCommand(
            **shared, batch=5, routes=["predict_caption", "predict_image"],
            matcher=EmbedderConfig(retriever=clip, batch=7),
        ),
    }  # fmt: skip

    def prepare(root: Path) -> list[Job]:
        shutil.copytree(micro_store.folder, root / "store" / "micro")
        shutil.rmtree(root / "store" / "micro" / "embeddings", ignore_errors=True)
        for name in commands:
            (root / name).mkdir()
        store = str(root / "store")
        return [(name, replace(cfg, store=store), root / name) for name, cfg in commands.items()]

    one, two = tmp_path / "one", tmp_path / "two"
    evaluate(prepare(one))
    jobs = prepare(two)
    log = (one / "select" / "answers.jsonl").read_text().splitlines(keepends=True)
    (two / "select" / "answers.jsonl").write_text("".join(log[:5]))
    evaluate_on_two_ranks(jobs, two)
    expected, found = read_results(one), read_results(two)
    assert found.keys() == expected.keys()
    for name, result in found.items():
        if isinstance(result, np.ndarray):
            np.testing.assert_allclose(result, expected[name], rtol=0, atol=1e-6)
        else:
            assert result == expected[name], name
    written = {Path(name).name.partition("-")[0] for name in found}
    assert written >= {"query", "frame", "text", "ranks.jsonl", "texts.jsonl", "matched.jsonl"}


def test_other_evaluations_refuse_ranks(tmp_path) -> None:
    launched = {"LOCAL_RANK": "0", "RANK": "0", "WORLD_SIZE": "2"}
    command = [sys.executable, "-m", "evaluation.report", f"checkpoints={tmp_path}"]
    ended = run_child(command, cwd=ROOT, env={**os.environ, **launched})
    assert ended.returncode == 1
    assert ended.stderr.endswith("[unsupported-ranks]\n")
