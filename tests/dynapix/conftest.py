"""The benchmark `micro` as the library loads it."""

from __future__ import annotations

import pytest

import dynapix


@pytest.fixture(scope="module")
def bench(micro_store) -> dynapix.Benchmark:
    return dynapix.load(micro_store.folder)
