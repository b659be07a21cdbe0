"""The finished runs that a report covers, read from their folders."""

from __future__ import annotations

import fnmatch
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
from evaluation.metrics.results import RetrievalReport, SelectionReport, from_json

SELECTION_KINDS, RETRIEVAL_KINDS = ("select", "similarity"), ("retrieve", "two_stage")
STUDY_KINDS, TRAINING_KINDS = ("export_study",), ("sft", "contrastive")
REPORT_TYPES = {
    **dict.fromkeys(SELECTION_KINDS, SelectionReport),
    **dict.fromkeys(RETRIEVAL_KINDS, RetrievalReport),
    **dict.fromkeys(STUDY_KINDS, dict[str, Any]),
}
KINDS = (*REPORT_TYPES, *TRAINING_KINDS)
"""Folders below checkpoints/ with runs that a report covers."""


@dataclass(frozen=True)
class FinishedRun:
    """A finished run.

    Attributes:
        kind: The folder of its command, such as select.
        config: Its settings.
        report: Its report.json; None for a training run.
        started: When it was first started, in ISO format.
    """

    folder: Path
    kind: str
    name: str
    config: dict[str, Any]
    report: SelectionReport | RetrievalReport | dict[str, Any] | None
    started: str

    @property
    def title(self) -> str:
        return f"{self.kind}/{self.name}"


def gather_runs(root: Path, patterns: Sequence[str] | None) -> list[FinishedRun]:
    """Return the finished runs below `root`, oldest first.

    Args:
        patterns: Folders or patterns of folders below `root`, such as select/*; None for all.

    Raises:
        UserError: No evaluation has finished, a pattern matches no finished run, or a run cannot be
            read.
    """
    # A sweep's jobs are one folder deeper.
    depths = ("*/metrics.json", "*/*/metrics.json")
    folders = [p.parent for k in KINDS for d in depths for p in sorted(root.glob(f"{k}/{d}"))]
    finished = [folder.relative_to(root).as_posix() for folder in folders]
    chosen = (
        finished if patterns is None else [t for p in patterns for t in _match(root, p, finished)]
    )
    runs = [_read_run(root, title) for title in dict.fromkeys(chosen)]
    if all(run.kind in TRAINING_KINDS for run in runs):
        raise UserError(
            f"no evaluation has finished below {root}: run python -m evaluation.select "
            "model=checkpoints/sft/RUN or python -m evaluation.retrieve "
            "model=checkpoints/contrastive/RUN first",
            code="missing-run",
        )
    return sorted(runs, key=lambda run: (run.started, run.kind, run.name))


def _match(root: Path, pattern: str, finished: Sequence[str]) -> list[str]:
    """Return the `finished` runs that a pattern matches."""
    pattern = pattern.strip("/").removeprefix(f"{root.as_posix().strip('/')}/")
    if matched := fnmatch.filter(finished, pattern):
        return matched
    if (root / pattern).is_dir():
        raise UserError(
            f"runs: {root / pattern} is not a finished run of an evaluation or a training: run its "
            "command again, which resumes it (or python -m evaluation.study.export, if it is a "
            "study), or name another run",
            code="unfinished-run",
        )
    similar = get_close_matches(pattern, finished, 3, 0.3) or finished[:3]
    hint = f"; existing runs: {', '.join(similar)}" if similar else ""
    raise UserError(f"runs: {pattern} matches no run below {root}{hint}", code="missing-run")


def _read_run(root: Path, title: str) -> FinishedRun:
    kind, _, name = title.partition("/")
    folder, report = root / title, None
    with reading(folder, "run.json"):
        record = json.loads((folder / "run.json").read_text())
        started = min(map(str, [record["started"], *record["earlier_starts"]]))
    if kind in REPORT_TYPES:
        with reading(folder):
            report = from_json(REPORT_TYPES[kind], json.loads((folder / "report.json").read_text()))
    return FinishedRun(folder, kind, name, _read_settings(folder), report, started)


def _read_settings(folder: Path) -> dict[str, Any]:
    with reading(folder, "config.yaml"):
        return dict(OmegaConf.to_container(OmegaConf.load(folder / "config.yaml")))


def training_settings(run: FinishedRun, root: Path) -> dict[str, Any] | None:
    """Return the settings of the training of a run's model, or else of its matcher.

    Returns:
        None for a released model, and an empty dictionary if the training folder is gone.

    Raises:
        UserError: The settings cannot be read.
    """
    model = run.config.get("model") or (run.config.get("matcher") or {}).get("model")
    if model is None:
        return None
    path = Path(str(model))
    # If the runs have moved, or the report runs in another folder, the model is below `root`.
    folders = [path, root / Path(*path.parts[1:])]
    found = [folder for folder in folders if (folder / "config.yaml").is_file()]
    return _read_settings(found[0]) if found else {}


@contextmanager
def reading(folder: Path, file: str = "report.json") -> Iterator[None]:
    """Turn a failure to read or interpret a file of a run into a UserError that names the file."""
    failures = (OSError, ValueError, KeyError, TypeError, AttributeError)
    try:
        yield
    except (*failures, YAMLError, OmegaConfBaseException) as error:
        raise UserError(
            f"{folder / file} is missing, damaged or of another version: delete {folder} and run "
            "its command again, or leave the run out with runs=[...]",
            code="damaged-file",
        ) from error
