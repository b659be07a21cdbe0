"""The commands of `make paper-tiny` and `make paper` have valid settings and a valid order."""

from __future__ import annotations

from pathlib import Path

import pytest

from dynapix.conf.compose import compose
from tests.children import run_child
from tests.conf.schemas import SCHEMAS, distinct, parse_line

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
    return done.stdout.splitlines()


@pytest.mark.slow
def test_settings_of_every_command_are_valid(lines: list[str]) -> None:
    for command, overrides in distinct(parse_line(line) for line in lines):
        compose(command, SCHEMAS[command], overrides)


def test_every_experiment_runs_after_its_training_and_the_report_is_last(lines: list[str]) -> None:
    trained = set()
    for command, overrides in map(parse_line, lines):
        settings = dict(o.lstrip("+").split("=", 1) for o in overrides)
        for key in ("model", "matcher.model"):
            assert settings.get(key) is None or settings[key] in trained, (command, settings)
        if command.startswith("train."):
            trained.add(f"checkpoints/{command.removeprefix('train.')}/{settings['run']}")
    text = "\n".join(lines)
    for regime in ("answer_only", "cot", "cot_no_candidate_analysis", "cot_no_match_layout"):
        assert f"train.sft +exp={regime} " in text
    for control in ("candidate_only", "shuffled_prefix", "matched_anchor"):
        bases = 5 if "student=qwen3_vl_2b" in text else 1
        assert text.count(f"evaluation.select +exp={control} ") == 2 + bases
    assert text.count(" prompt_regime=cot_no_match_layout modes=[reasoning]") == 3
    for command in ("train.contrastive", "retrieve", "similarity", "two_stage"):
        assert command in text
    assert lines[-1] == "python -m evaluation.report"
    if "benchmark=dynapix " in text:
        check_paper(lines)


def check_paper(lines: list[str]) -> None:
    """Check the rows of the paper: Table 2 has six scorers and five generative models, and Table 3
    six embedders and three two-stage rows."""
    text = "\n".join(lines)
    scorers = ("clip", "languagebind", "siglip2", "vlm2vec", "qwen3_vl_emb_2b", "qwen3_vl_emb_8b")
    for scorer in scorers:
        for command in ("similarity", "retrieve"):
            line = f"python -m evaluation.{command} benchmark=dynapix retriever={scorer}"
            assert lines.count(line) == 1
    bases = ("2b", "8b", "8b_thinking")
    for base in (*(f"qwen3_vl_{size}" for size in bases), "qwen3_5_27b", "qwen3_6_27b"):
        assert f"evaluation.select benchmark=dynapix student={base} modes=" in text
    assert "evaluation.two_stage benchmark=dynapix student=qwen3_vl_8b routes=[cot_text] " in text
    predict = "student=qwen3_vl_2b routes=[predict_caption,predict_image] "
    assert f"evaluation.two_stage benchmark=dynapix {predict}" in text


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
