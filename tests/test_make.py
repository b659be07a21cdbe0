"""What `make paper-tiny` and `make paper` run are commands that compose, in an order that holds."""

from __future__ import annotations

import shlex
import subprocess
from pathlib import Path

import pytest

from tests.conf.test_presets import settings

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module", params=["paper-tiny", "paper"])
def lines(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The commands of a target as they would be run, with releases that are there."""
    releases = tmp_path_factory.mktemp("releases")
    for suite in ("movi_a", "physion"):
        (releases / suite).mkdir()
    said = subprocess.run(
        # The environment is taken as it is: -o makes no file anew.
        ["make", "-s", "-o", ".venv/.ready", request.param, "PY=echo python -m",
         f"RELEASES={releases}"],
        cwd=ROOT, capture_output=True, text=True, check=True,
    )  # fmt: skip
    return [line for line in said.stdout.splitlines() if "benchmarks.speed.hours" not in line]


@pytest.mark.slow
def test_every_command_composes(lines: list[str]) -> None:
    for line in lines:
        settings(line)


def test_what_is_measured_was_trained_before(lines: list[str]) -> None:
    trained = set()
    for line in lines:
        _, _, command, *overrides = shlex.split(line)
        told = dict(o.lstrip("+").split("=", 1) for o in overrides)
        for key in ("model", "matcher.model"):
            assert told.get(key) is None or told[key] in trained, line
        if command.startswith("train."):
            trained.add(f"checkpoints/{command.removeprefix('train.')}/{told['run']}")


def test_every_experiment_is_there_and_the_report_is_last(lines: list[str]) -> None:
    chain = "\n".join(lines)
    for regime in ("answer_only", "cot", "cot_no_candidate_analysis", "cot_no_match_layout"):
        assert f"train.sft +exp={regime} " in chain
    for control in ("candidate_only", "shuffled_prefix", "matched_anchor"):
        assert chain.count(f"evaluation.select +exp={control} ") == 2
    for command in ("train.contrastive", "retrieve", "similarity", "two_stage"):
        assert command in chain
    assert lines[-1] == "python -m evaluation.report"


def test_without_the_releases_nothing_is_begun(tmp_path: Path) -> None:
    said = subprocess.run(
        ["make", "-s", "-o", ".venv/.ready", "paper", "PY=echo python -m", f"RELEASES={tmp_path}"],
        cwd=ROOT, capture_output=True, text=True,
    )  # fmt: skip
    assert said.returncode != 0
    assert said.stdout.splitlines() == [
        f"error: make paper measures transfer on {tmp_path}/movi_a and {tmp_path}/physion, which "
        "are not both there: give RELEASES=FOLDER"
    ]
