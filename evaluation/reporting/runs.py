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
"""Names of the folders below checkpoints/ whose runs a report covers."""


@dataclass(frozen=True)
class FinishedRun:
    """A finished run.

    Attributes:
        kind: Name of the command's folder, such as select.
        config: Settings of the run.
        report: Content of report.json; None for a training run.
        started: Time of the first start, in ISO format.
    """

    folder: Path
    kind: str
    name: str
    config: dict[str, Any]
    report: SelectionReport | RetrievalReport | dict[str, Any] | None
    started: str

    @property
    def title(self) -> str:
        """Path below checkpoints/, such as select/default."""
        return f"{self.kind}/{self.name}"


def gather_runs(root: Path, patterns: Sequence[str] | None) -> list[FinishedRun]:
    """Return the finished runs below `root`, oldest first.

    Args:
        patterns: Titles of runs, or glob patterns of titles, such as select/*; None for all runs.

    Raises:
        UserError: No evaluation is among the runs, a pattern matches no finished run, or a run
            cannot be read.
    """
    # The runs of a sweep are one folder deeper.
    depths = ("*/metrics.json", "*/*/metrics.json")
    files = [f for kind in KINDS for depth in depths for f in sorted(root.glob(f"{kind}/{depth}"))]
    finished = [file.parent.relative_to(root).as_posix() for file in files]
    titles = (
        finished if patterns is None else [t for p in patterns for t in _match(root, p, finished)]
    )
    runs = [_read_run(root, title) for title in dict.fromkeys(titles)]
    if all(run.kind in TRAINING_KINDS for run in runs):
        raise UserError(
            f"no finished evaluation is among the runs below {root}: first run python -m "
            "evaluation.select model=checkpoints/sft/RUN or python -m evaluation.retrieve "
            "model=checkpoints/contrastive/RUN",
            code="missing-run",
        )
    return sorted(runs, key=lambda run: (run.started, run.kind, run.name))


def _match(root: Path, pattern: str, finished: Sequence[str]) -> list[str]:
    """Return the titles in `finished` that a pattern matches. Raises UserError if none does."""
    pattern = pattern.strip("/").removeprefix(f"{root.as_posix().strip('/')}/")
    if matched := fnmatch.filter(finished, pattern):
        return matched
    if (root / pattern).is_dir():
        raise UserError(
            f"runs: {root / pattern} is not a finished run of an evaluation or a training: run its "
            "command again, which resumes the run (for a study, run python -m "
            "evaluation.study.export), or name another run",
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
    """Return the settings of the run that trained the model of an evaluation. For a two-stage run
    with an untrained model, return those of its matcher (the retriever that ranks the frames).

    Returns:
        None for a released model, and an empty dictionary if the training folder does not exist.

    Raises:
        UserError: The settings cannot be read.
    """
    model = run.config.get("model") or (run.config.get("matcher") or {}).get("model")
    if model is None:
        return None
    path = Path(str(model))
    # If the runs were moved, or the working directory is another, the model is below `root`.
    folders = [path, root / Path(*path.parts[1:])]
    found = [folder for folder in folders if (folder / "config.yaml").is_file()]
    return _read_settings(found[0]) if found else {}


@contextmanager
def reading(folder: Path, file: str = "report.json") -> Iterator[None]:
    """Turn an error in the block, which reads `file` of a run, into a UserError that names it."""
    failures = (OSError, ValueError, KeyError, TypeError, AttributeError)
    try:
        yield
    except (*failures, YAMLError, OmegaConfBaseException) as error:
        raise UserError(
            f"{folder / file} is missing, damaged or of another version: delete {folder} and run "
            "its command again, or leave the run out with runs=[...]",
            code="damaged-file",
        ) from error
