"""Work that is spread is done whole, on this machine and on a Ray cluster, also when a worker is
killed."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from conf.errors import UserError
from conf.schema import PARALLEL_BACKENDS
from data.parallel import Workers


def square(number: int, victim: Path | None = None) -> int:
    """The first worker that comes here with a `victim` that is not there leaves it, and dies."""
    if victim is not None and not victim.exists():
        victim.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def die(number: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.parametrize("engine", PARALLEL_BACKENDS)
def test_a_killed_workers_jobs_are_done_by_others(tmp_path, engine) -> None:
    jobs = {str(k): partial(square, k) for k in range(20)}
    jobs["7"] = partial(square, 7, tmp_path / "victim")
    results = dict(Workers(2, engine).run(jobs, "squaring", "number"))
    assert (tmp_path / "victim").exists()
    assert results == {str(k): k * k for k in range(20)}


@pytest.mark.slow
def test_workers_that_keep_dying_are_told() -> None:
    with pytest.raises(UserError, match=r"squaring: workers die .* try workers=1"):
        list(Workers(2).run({"1": partial(die, 1), "2": partial(die, 2)}, "squaring", "number"))


def test_a_jobs_own_fault_is_its_own() -> None:
    with pytest.raises(ZeroDivisionError):
        list(Workers(2).run({"1": partial(divmod, 1, 0)}, "dividing", "number"))
