"""Several ranks of a launcher share the items of an evaluation."""

from __future__ import annotations

import json
import os
import pickle
import sys
from pathlib import Path

import pytest

from conf.runs import Run
from conf.schema import SelectCommand
from data.store import Store
from evaluation import select
from tests.children import run_child
from tests.evaluation.models.conftest import STUDENT

ROOT = Path(__file__).parents[3]
EVALUATE = """
import pickle, sys
from pathlib import Path
from conf.runs import Run
from evaluation import select

cfg = pickle.loads(Path(sys.argv[1]).read_bytes())
select.main.__wrapped__(cfg, Run("two", Path(sys.argv[2])))
"""


def launch(*arguments: object):
    launcher = Path(sys.executable).with_name("torchrun")
    environment = {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    return run_child(
        [launcher, "--standalone", "--nproc-per-node=2", *arguments],
        cwd=ROOT,
        env={**os.environ, **environment},
    )


@pytest.mark.slow
def test_two_ranks_write_what_one_process_writes(
    micro, micro_store: Store, trained_student: Path, tmp_path: Path
) -> None:
    """Also if one process has finished a part of the items."""
    cfg = SelectCommand(
        benchmark=micro, store=str(micro_store.folder.parent), model=str(trained_student),
        student=STUDENT, modes=["answer", "reasoning"], limit=11, batch=3,
    )  # fmt: skip
    one, two = tmp_path / "one", tmp_path / "two"
    one.mkdir()
    two.mkdir()
    select.main.__wrapped__(cfg, Run("one", one))
    log = (one / "answers.jsonl").read_text()
    (two / "answers.jsonl").write_text("".join(log.splitlines(keepends=True)[:7]))
    (tmp_path / "cfg").write_bytes(pickle.dumps(cfg))
    (tmp_path / "evaluate.py").write_text(EVALUATE)
    ended = launch(tmp_path / "evaluate.py", tmp_path / "cfg", two)
    assert ended.returncode == 0, ended.stderr
    assert len((two / "answers.jsonl").read_text().splitlines()) == 2 + 2 * 11
    reports = [json.loads((folder / "report.json").read_text()) for folder in (one, two)]
    assert reports[0] == reports[1]
    fresh = tmp_path / "fresh"
    fresh.mkdir()
    ended = launch(tmp_path / "evaluate.py", tmp_path / "cfg", fresh)
    assert (fresh / "answers.jsonl").read_text() == log


@pytest.mark.slow
def test_other_evaluations_refuse_ranks(tmp_path: Path) -> None:
    ended = launch("-m", "evaluation.retrieve", f"checkpoints={tmp_path}")
    assert ended.returncode == 1
    assert "evaluation.retrieve uses one process, but RANK" in ended.stderr
    assert not any(tmp_path.iterdir())
