"""The finished runs that a report covers, read from their folders."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from conf.errors import UserError

SELECTION_KINDS, RETRIEVAL_KINDS = ("select", "similarity"), ("retrieve", "two_stage")
STUDY_KINDS, TRAINING_KINDS = ("export_study",), ("sft", "contrastive")
KINDS = (*SELECTION_KINDS, *RETRIEVAL_KINDS, *STUDY_KINDS, *TRAINING_KINDS)
"""Folders below checkpoints/ with runs that a report covers."""


@dataclass(frozen=True)
class FinishedRun:
    """A finished run.

    Attributes:
        kind: The folder of its command, such as select.
        config: Its settings.
        report: Its report.json; empty for a training run.
        started: When it was first started, in ISO format.
    """

    folder: Path
    kind: str
    name: str
    config: dict[str, Any]
    report: dict[str, Any]
    started: str

    @property
    def title(self) -> str:
        return f"{self.kind}/{self.name}"


def gather_runs(root: Path, patterns: Sequence[str] | None) -> list[FinishedRun]:
    """The finished runs below `root`, oldest first.

    Args:
        patterns: Folders or patterns of folders below `root`, such as select/*; None for all.

    Raises:
        UserError: nothing is measured, a pattern names no run, or a run cannot be read.
    """
    # A sweep's jobs are one folder deeper.
    depths = ("*/metrics.json", "*/*/metrics.json")
    finished = [p.parent for k in KINDS for d in depths for p in sorted(root.glob(f"{k}/{d}"))]
    chosen = (
        finished if patterns is None else [f for p in patterns for f in _match(root, p, finished)]
    )
    runs = [_read_run(root, folder) for folder in dict.fromkeys(chosen)]
    if all(run.kind in TRAINING_KINDS for run in runs):
        raise UserError(
            f"no evaluation has finished below {root}: run python -m evaluation.select "
            "model=checkpoints/sft/RUN or python -m evaluation.retrieve "
            "model=checkpoints/contrastive/RUN first",
            code="missing-run",
        )
    return sorted(runs, key=lambda run: (run.started, run.kind, run.name))


def _match(root: Path, pattern: str, finished: Sequence[Path]) -> list[Path]:
    """The `finished` runs that a pattern names."""
    pattern = pattern.strip("/").removeprefix(f"{root.as_posix().strip('/')}/")
    try:
        folders = [path for path in root.glob(pattern) if path.is_dir()]
    except (ValueError, NotImplementedError) as error:
        raise UserError(
            f"runs: {pattern} is not a valid pattern of folders below {root}: {error}",
            code="invalid-setting",
        ) from error
    if matched := [path for path in folders if path in finished]:
        return sorted(matched)
    if folders:
        raise UserError(
            f"runs: {folders[0]} is not a finished run of an evaluation or a training: run its "
            "command again, which resumes it (or python -m evaluation.study.export, if it is a "
            "study), or name another run",
            code="unfinished-run",
        )
    names = [path.relative_to(root).as_posix() for path in finished]
    similar = get_close_matches(pattern, names, 3, 0.3) or names[:3]
    hint = f"; existing runs: {', '.join(similar)}" if similar else ""
    raise UserError(f"runs: {pattern} matches no run below {root}{hint}", code="missing-run")


def _read_run(root: Path, folder: Path) -> FinishedRun:
    kind, *name = folder.relative_to(root).parts
    report = {}
    with reading(folder, "run.json"):
        record = json.loads((folder / "run.json").read_text())
        started = min(map(str, [record["started"], *record["earlier_starts"]]))
    if kind not in TRAINING_KINDS:
        with reading(folder):
            report = dict(json.loads((folder / "report.json").read_text()))
    return FinishedRun(folder, kind, "/".join(name), _read_settings(folder), report, started)


def _read_settings(folder: Path) -> dict[str, Any]:
    with reading(folder, "config.yaml"):
        return dict(OmegaConf.to_container(OmegaConf.load(folder / "config.yaml")))


def training_settings(run: FinishedRun, root: Path) -> dict[str, Any] | None:
    """The settings by which the model of an evaluation, or else its matcher, was trained.

    Returns:
        None for a released model, and an empty dictionary if the training folder is gone.

    Raises:
        UserError: the settings cannot be read.
    """
    model = run.config.get("model") or (run.config.get("matcher") or {}).get("model")
    if model is None:
        return None
    with reading(run.folder, "config.yaml"):
        path = Path(model)
    # If the runs have moved, or the report runs in another folder, the model is below `root`.
    folders = [path, root / Path(*path.parts[1:])]
    found = [folder for folder in folders if (folder / "config.yaml").is_file()]
    return _read_settings(found[0]) if found else {}


@contextmanager
def reading(folder: Path, file: str = "report.json", remedy: str = "") -> Iterator[None]:
    """Report any failure to read or to interpret a file of a run as a UserError that names it.

    Args:
        remedy: What to do, if not to run the command again.
    """
    failures = (OSError, ValueError, KeyError, TypeError, AttributeError)
    try:
        yield
    except (*failures, YAMLError, OmegaConfBaseException) as error:
        remedy = remedy or f"delete {folder} and run its command again"
        raise UserError(
            f"{folder / file} is missing, damaged or of another version: {remedy}, or leave the "
            "run out with runs=[...]",
            code="damaged-file",
        ) from error
