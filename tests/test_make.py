"""The commands of `make paper-tiny` and `make paper` have valid settings and a valid order."""

from __future__ import annotations

import shlex
from pathlib import Path

import pytest

from tests.children import run_child
from tests.conf.test_presets import compose_line

ROOT = Path(__file__).parent.parent


@pytest.fixture(scope="module", params=["paper-tiny", "paper"])
def lines(request: pytest.FixtureRequest, tmp_path_factory: pytest.TempPathFactory) -> list[str]:
    """The commands of a make target, which `PY=echo python -m` prints instead of running."""
    releases = tmp_path_factory.mktemp("releases")
    for suite in ("movi_a", "physion"):
        (releases / suite).mkdir()
    done = run_child(
        # With -o, make treats the environment as up to date and does not create it.
        ["make", "-s", "-o", ".venv/.ready", request.param, "PY=echo python -m",
         f"RELEASES={releases}"],
        cwd=ROOT, check=True,
    )  # fmt: skip
    return [line for line in done.stdout.splitlines() if "benchmarks.speed.hours" not in line]


@pytest.mark.slow
def test_settings_of_every_command_are_valid(lines: list[str]) -> None:
    for line in lines:
        compose_line(line)


def test_a_model_is_trained_before_it_is_evaluated(lines: list[str]) -> None:
    trained = set()
    for line in lines:
        _, _, command, *overrides = shlex.split(line)
        settings = dict(o.lstrip("+").split("=", 1) for o in overrides)
        for key in ("model", "matcher.model"):
            assert settings.get(key) is None or settings[key] in trained, line
        if command.startswith("train."):
            trained.add(f"checkpoints/{command.removeprefix('train.')}/{settings['run']}")


def test_every_experiment_runs_and_the_report_is_last(lines: list[str]) -> None:
    text = "\n".join(lines)
    for regime in ("answer_only", "cot", "cot_no_candidate_analysis", "cot_no_match_layout"):
        assert f"train.sft +exp={regime} " in text
    for control in ("candidate_only", "shuffled_prefix", "matched_anchor"):
        assert text.count(f"evaluation.select +exp={control} ") == 2
    for command in ("train.contrastive", "retrieve", "similarity", "two_stage"):
        assert command in text
    assert lines[-1] == "python -m evaluation.report"


def test_missing_releases_stop_the_target(tmp_path: Path) -> None:
    done = run_child(
        ["make", "-s", "-o", ".venv/.ready", "paper", "PY=echo python -m", f"RELEASES={tmp_path}"],
        cwd=ROOT,
    )  # fmt: skip
    assert done.returncode != 0
    assert done.stdout.splitlines() == [
        f"error: make paper needs the releases {tmp_path}/movi_a and {tmp_path}/physion: "
        "give their parent folder as RELEASES=FOLDER"
    ]
