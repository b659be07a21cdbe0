"""Benchmarks of other sizes have the paper's proportions."""

from __future__ import annotations

from dataclasses import asdict, replace

import pytest

from benchmarks.speed.growth import scale_preset
from dynapix.conf.compose import compose
from dynapix.conf.runs import flatten
from dynapix.conf.schema import BenchmarkConfig, BuildCommand


@pytest.fixture(scope="module")
def preset() -> BenchmarkConfig:
    return compose("data.build", BuildCommand, ["benchmark=dynapix"]).benchmark


def test_the_papers_number_of_scenes_gives_the_preset(preset) -> None:
    assert replace(scale_preset(preset.scenes), name=preset.name) == preset


def test_every_count_is_scaled(preset) -> None:
    counts = ("scenes", "test_scenes", "selection.", "retrieval.")
    own, scaled = (flatten(asdict(cfg)) for cfg in (preset, scale_preset(preset.scenes // 10)))
    for key in (k for k in own if k.startswith(counts) and own[k] and own[k] > 12):
        assert scaled[key] == pytest.approx(own[key] / 10, abs=0.5), key
