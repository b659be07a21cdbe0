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


def gather_runs(root: Path, patterns: Sequence[str] | None) -> list[FinishedRun]:
    """The finished runs below `root`, oldest first.

    Args:
        patterns: Folders or patterns of folders below `root`, such as select/*; None for all.

    Raises:
        UserError: nothing is measured, a pattern names no run, or a run cannot be read.
    """
    finished = [
        path.parent
        for kind in KINDS
        # A sweep's jobs are one folder deeper.
        for path in sorted([*root.glob(f"{kind}/*/metrics.json"),
                            *root.glob(f"{kind}/*/*/metrics.json")])
    ]  # fmt: skip
    folders = finished
    if patterns is not None:
        folders = [folder for p in patterns for folder in _match(root, p, finished)]
    runs = [_read_run(root, folder) for folder in dict.fromkeys(folders)]
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
        kind, *name = folders[0].relative_to(root).parts
        if kind == "study" and name:
            raise UserError(
                f"runs: {folders[0]} is a study: export its votes with python -m "
                f"evaluation.study.export run={'/'.join(name)}, and name that run below "
                f"{root / 'export_study'}",
                code="unfinished-run",
            )
        raise UserError(
            f"runs: {folders[0]} is not a finished run of an evaluation or a training: run its "
            "command again, which resumes it, or name another run",
            code="unfinished-run",
        )
    names = [path.relative_to(root).as_posix() for path in finished]
    similar = get_close_matches(pattern, names, 3, 0.3) or names[:3]
    hint = f"; existing runs: {', '.join(similar)}" if similar else ""
    raise UserError(f"runs: {pattern} matches no run below {root}{hint}", code="missing-run")


def _read_run(root: Path, folder: Path) -> FinishedRun:
    kind, *name = folder.relative_to(root).parts
    config, report = read_settings(folder, "measure again"), {}
    with reading(folder, "run.json"):
        record = json.loads((folder / "run.json").read_text())
        started = min(map(str, [record["started"], *record["earlier_starts"]]))
    if kind not in TRAINING_KINDS:
        with reading(folder):
            report = dict(json.loads((folder / "report.json").read_text()))
    return FinishedRun(folder, kind, "/".join(name), config, report, started)


def read_settings(folder: Path, remedy: str) -> dict[str, Any]:
    """A run's config.yaml.

    Raises:
        UserError: it is missing or damaged; `remedy` says what to do once it is deleted.
    """
    path = folder / "config.yaml"
    try:
        settings = OmegaConf.to_container(OmegaConf.load(path))
        if not isinstance(settings, dict):
            raise YAMLError("no settings")
    except (OSError, YAMLError, OmegaConfBaseException) as error:
        raise UserError(
            f"{path} is missing or damaged: delete {folder} and {remedy}, or leave the run out "
            "with runs=[...]",
            code="damaged-file",
        ) from error
    return settings


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
    for folder in (path, root / Path(*path.parts[1:])):
        if (folder / "config.yaml").is_file():
            return read_settings(folder, "train again")
    return {}


@contextmanager
def reading(folder: Path, file: str = "report.json") -> Iterator[None]:
    """Report any failure to read or to interpret a file of a run as a UserError that names it."""
    try:
        yield
    except (OSError, ValueError, KeyError, TypeError, AttributeError) as error:
        raise UserError(
            f"{folder / file} is missing, damaged or of another version: delete {folder} and "
            "measure again",
            code="damaged-file",
        ) from error


def json_lines(path: Path) -> Iterator[dict[str, Any]]:
    """The objects in a file of JSON lines; torn lines are skipped."""
    with open(path, encoding="utf-8", errors="replace") as file:
        for line in file:
            try:
                row = json.loads(line)
            except ValueError:
                continue
            if isinstance(row, dict):
                yield row
