"""Worker pools finish every job, on this machine and on a Ray cluster, even if a worker dies."""

from __future__ import annotations

import os
import signal
from functools import partial
from pathlib import Path

import pytest

from dynapix.data.parallel import Workers
from tests.user_errors import raises_user_error


def square(number: int, marker: Path | None = None) -> int:
    """Square a number. If `marker` is given and missing, create it and kill this worker instead."""
    if marker is not None and not marker.exists():
        marker.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return number * number


def kill_worker(number: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["loky", "ray"])
def test_jobs_of_a_killed_worker_are_retried(tmp_path, engine) -> None:
    jobs = {str(k): partial(square, k) for k in range(20)}
    jobs["7"] = partial(square, 7, tmp_path / "marker")
    results = dict(Workers(2, engine).run(jobs, "squaring", "number"))
    assert (tmp_path / "marker").exists()
    assert results == {str(k): k * k for k in range(20)}


@pytest.mark.slow
def test_workers_that_keep_dying_are_an_error() -> None:
    with raises_user_error("dying-workers", contains="workers=1"):
        list(
            Workers(2).run(
                {"1": partial(kill_worker, 1), "2": partial(kill_worker, 2)}, "squaring", "number"
            )
        )


@pytest.mark.slow
@pytest.mark.parametrize("engine", ["loky", "ray"])
def test_exception_of_a_job_is_raised(engine) -> None:
    with pytest.raises(ZeroDivisionError) as raised:
        list(Workers(2, engine).run({"1": partial(divmod, 1, 0)}, "dividing", "number"))
    assert raised.type is ZeroDivisionError
