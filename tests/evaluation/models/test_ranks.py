"""Several ranks of a launcher share the items of an evaluation."""

from __future__ import annotations

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
from dynapix.conf.schema import (
    ContrastiveTrainConfig,
    EmbedderConfig,
    RetrieveCommand,
    RetrieverConfig,
    SelectCommand,
    TwoStageCommand,
)
from dynapix.data.store import Store
from dynapix.evaluation import select
from tests.children import run_child
from tests.evaluation.models import released
from tests.evaluation.models.conftest import NO_LORA, STUDENT

ROOT = Path(__file__).parents[3]
EVALUATE = """
import importlib, pickle, sys
from pathlib import Path
from dynapix.conf.runs import Run

command, settings, folder = sys.argv[1:]
cfg = pickle.loads(Path(settings).read_bytes())
main = importlib.import_module(f"dynapix.evaluation.{command}").main
sampling = ("student.temperature", "student.top_k")
main.__wrapped__(cfg, Run("run", Path(folder), sampling))
"""


def launch(*arguments: object, ranks: int = 2):
    launcher = Path(sys.executable).with_name("torchrun")
    several = [launcher, "--standalone", f"--nproc-per-node={ranks}"]
    environment = {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    return run_child(
        [*([sys.executable] if ranks == 1 else several), *arguments],
        cwd=ROOT,
        env={**os.environ, **environment},
    )


def evaluate(command: str, cfg: object, folder: Path, ranks: int = 2) -> dict:
    """Run a command in a new folder with one process or several ranks. Return its report without
    the times."""
    (folder / "run").mkdir(parents=True, exist_ok=True)
    (folder / "cfg").write_bytes(pickle.dumps(cfg))
    (folder / "evaluate.py").write_text(EVALUATE)
    program = (folder / "evaluate.py", command, folder / "cfg", folder / "run")
    ended = launch(*program, ranks=ranks)
    assert ended.returncode == 0, ended.stderr
    report = json.loads((folder / "run" / "report.json").read_text())
    for row in report["rows"]:
        row.pop("seconds", None)
    return report


def read_rows(cache: Path) -> dict[str, np.ndarray]:
    """Return the embeddings in a file by name, in the order in which they were written."""
    with closing(sqlite3.connect(cache)) as db:
        rows = db.execute("SELECT name, entries FROM embedding ORDER BY rowid").fetchall()
    return {name: np.frombuffer(entries, np.float32) for name, entries in rows}


@pytest.fixture
def clip(tmp_path: Path) -> RetrieverConfig:
    """An encoder of frames and texts, which is not trained."""
    return RetrieverConfig(
        name="clip", encoder="dual", model=str(released.clip(tmp_path / "clip")),
        widths=[24, 12], image_size=released.IMAGE_SIZE, frames=released.CLIP_FRAMES, **NO_LORA,
    )  # fmt: skip


@pytest.mark.slow
@pytest.mark.parametrize(
    ("command", "written"),
    [
        ("retrieve", {"query", "frame", "ranks.jsonl"}),
        ("two_stage", {"text", "frame", "texts.jsonl", "matched.jsonl"}),
    ],
)
def test_two_ranks_embed_what_one_process_embeds(
    command,
    written,
    micro,
    micro_store: Store,
    trained_student,
    trained_retriever,
    clip,
    tmp_path: Path,
) -> None:
    """The texts in the store and the files of the run have the same bytes. Embeddings may differ in
    the last bit, since a CPU's rounding can depend on where a tensor lies in memory."""
    shared = {"benchmark": micro, "batch": 5}
    cfg = {
        "retrieve": RetrieveCommand(**shared, retriever=clip, model=str(trained_retriever)),
        "two_stage": TwoStageCommand(
            **shared, model=str(trained_student),
            # With random weights, greedy decoding gives every response the same text.
            student=replace(STUDENT, temperature=1.0, top_k=50),
            routes=["predict_caption", "predict_image"],
            matcher=EmbedderConfig(
                retriever=clip, batch=7, train=ContrastiveTrainConfig(precision="fp32")
            ),
        ),
    }[command]  # fmt: skip
    reports, files, embeddings = [], [], []
    for ranks in (1, 2):
        folder = tmp_path / str(ranks)
        shutil.copytree(micro_store.folder, folder / "store" / "micro")
        shutil.rmtree(folder / "store" / "micro" / "embeddings", ignore_errors=True)
        here = replace(cfg, store=str(folder / "store"))
        reports.append(evaluate(command, here, folder, ranks))
        found = sorted(folder.rglob("*.jsonl"))
        files.append({str(p.relative_to(folder)): p.read_bytes() for p in found})
        embeddings.append({p.name: read_rows(p) for p in folder.rglob("*.sqlite")})
    assert reports[0] == reports[1]
    assert files[0].keys() == files[1].keys()
    assert [name for name, content in files[0].items() if files[1][name] != content] == []
    assert embeddings[0].keys() == embeddings[1].keys()
    for name, rows in embeddings[0].items():
        assert [*rows] == [*embeddings[1][name]]
        np.testing.assert_allclose(
            [*rows.values()], [*embeddings[1][name].values()], rtol=0, atol=1e-6
        )
    names = [*map(Path, files[0]), *map(Path, embeddings[0])]
    assert {path.name.partition("-")[0] for path in names} >= written


@pytest.mark.slow
def test_two_ranks_write_what_one_process_writes(
    micro, micro_store: Store, trained_student: Path, tmp_path: Path
) -> None:
    """Also if one process has finished a part of the items."""
    cfg = SelectCommand(
        benchmark=micro, store=str(micro_store.folder.parent), model=str(trained_student),
        student=STUDENT, modes=["answer", "reasoning"], limit=11, batch=3,
    )  # fmt: skip
    one, two, fresh = tmp_path / "one", tmp_path / "two" / "run", tmp_path / "fresh"
    one.mkdir()
    two.mkdir(parents=True)
    select.main.__wrapped__(cfg, Run("one", one))
    log = (one / "answers.jsonl").read_text()
    (two / "answers.jsonl").write_text("".join(log.splitlines(keepends=True)[:7]))
    report = evaluate("select", cfg, two.parent)
    assert len((two / "answers.jsonl").read_text().splitlines()) == 2 + 2 * 11
    assert report == json.loads((one / "report.json").read_text())
    evaluate("select", cfg, fresh)
    assert (fresh / "run" / "answers.jsonl").read_text() == log


@pytest.mark.slow
def test_other_evaluations_refuse_ranks(tmp_path: Path) -> None:
    ended = launch("-m", "evaluation.report", f"checkpoints={tmp_path}")
    assert ended.returncode == 1
    assert "evaluation.report uses one process, but RANK" in ended.stderr
    assert not any(tmp_path.iterdir())
