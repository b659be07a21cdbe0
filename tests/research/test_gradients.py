"""Ranks average what they share."""

from __future__ import annotations

import os
import sys
from pathlib import Path

from tests.children import run_child

ROOT = Path(__file__).parents[2]
AVERAGE = """
import torch
from dynapix.conf.runs import rank
from dynapix.models.distributed import end_ranks
from research.tiny_base.training import average_gradients

gradients = [[[2.0, 4.0], None, None], [[4.0, 8.0], [1.0, 3.0], None]][rank()]
parameters = [torch.nn.Parameter(torch.zeros(2)) for _ in gradients]
for parameter, gradient in zip(parameters, gradients):
    parameter.grad = None if gradient is None else torch.tensor(gradient)
average_gradients(parameters)
print([None if p.grad is None else p.grad.tolist() for p in parameters], flush=True)
end_ranks()
"""


def test_ranks_average_their_gradients(tmp_path: Path) -> None:
    """A gradient that one of two ranks lacks counts as 0; one that both lack stays None."""
    script = tmp_path / "average.py"
    script.write_text(AVERAGE)
    launcher = Path(sys.executable).with_name("torchrun")
    environment = {"PYTHONPATH": str(ROOT), "CUDA_VISIBLE_DEVICES": "", "OMP_NUM_THREADS": "1"}
    ended = run_child(
        [launcher, "--standalone", "--nproc-per-node=2", script],
        cwd=ROOT,
        env={**os.environ, **environment},
    )
    assert ended.returncode == 0, ended.stderr
    # The ranks can write into the same line.
    assert ended.stdout.count("[[3.0, 6.0], [0.5, 1.5], None]") == 2, ended.stdout
