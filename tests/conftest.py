"""Shared fixtures: a small benchmark that is simulated, built and rendered once per session."""

from __future__ import annotations

import os
import shutil
import sys
from pathlib import Path

import pytest

from dynapix.conf.schema import BenchmarkConfig, Quota, RetrievalTrackConfig, SelectionConfig
from dynapix.data.build import ensure_benchmark
from dynapix.data.items.recipes import CELLS
from dynapix.data.store import Store, open_store


def micro_config(**changes: object) -> BenchmarkConfig:
    """A config with ten scenes at the tiny preset's frame size, and a few items per cell."""
    few = Quota(train=2, test=1)
    settings = {
        "name": "micro",
        "scenes": 10,
        "width": 192,
        "height": 128,
        "selection": SelectionConfig(
            **{family: dict.fromkeys(cells, few) for family, cells in CELLS.items()}, matched=few
        ),
        "retrieval": RetrievalTrackConfig(
            builders={str(k): Quota(train=4, test=2) for k in range(1, 7)},
            counterfactual=Quota(train=4, test=2),
            hard_negatives=2,
            database=60,
            source=160,
            counterfactual_source=60,
        ),
    }
    return BenchmarkConfig(**{**settings, **changes})


# `make test-integrations` names this folder, whose tests need an environment of their own.
collect_ignore = (
    [] if any("integrations" in argument for argument in sys.argv) else ["integrations"]
)

LONGEST = (
    "train/common/test_ranks.py",
    "teacher/test_serve.py",
    "evaluation/models/test_vllm.py",
    "train/common/test_resume.py",
    "evaluation/reporting/test_report.py",
    "conf/test_sweep.py",
)
"""Files that take longest. They start first, so that no process has to wait for one at the end."""


def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    order = {Path(__file__).parent / name: k for k, name in enumerate(LONGEST)}
    items.sort(key=lambda item: order.get(item.path, len(order)))


@pytest.fixture(scope="session")
def micro() -> BenchmarkConfig:
    return micro_config()


def pytest_addoption(parser: pytest.Parser) -> None:
    parser.addoption(
        "--benchmark",
        type=Path,
        help="folder of a built benchmark, such as store/tiny-above, that the tests of built "
        "benchmarks use instead of the small one",
    )


@pytest.fixture(scope="session")
def benchmark_store(request: pytest.FixtureRequest) -> Store:
    """The benchmark that `--benchmark` names, otherwise the small one."""
    folder = request.config.getoption("--benchmark")
    return open_store(folder) if folder else request.getfixturevalue("micro_store")


@pytest.fixture(scope="session")
def micro_store(tmp_path_factory: pytest.TempPathFactory, micro: BenchmarkConfig) -> Store:
    # The first process of pytest-xdist builds the benchmark; the others wait for it and copy it.
    shared = tmp_path_factory.getbasetemp()
    if "PYTEST_XDIST_WORKER" in os.environ:
        shared = shared.parent
    built = ensure_benchmark(micro, shared / "built", workers=2)
    folder = tmp_path_factory.mktemp("store") / "micro"
    shutil.copytree(built.folder, folder)
    return open_store(folder)
