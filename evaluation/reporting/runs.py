"""The finished runs that a report covers, read from their folders."""

from __future__ import annotations

import fnmatch
import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import yaml

from dynapix.conf.errors import UserError
from dynapix.evaluation.metrics.results import (
    RetrievalReport,
    SelectionReport,
    StudyReport,
    from_json,
)
from dynapix.evaluation.reporting.run_responses import Responses, read_responses, reading
from dynapix.models.trained_runs import locate_run, settings_file

SELECTION_KINDS, RETRIEVAL_KINDS = ("select", "similarity"), ("retrieve", "two_stage")
STUDY_KINDS, TRAINING_KINDS = ("export_study",), ("sft", "distill", "reinforce", "contrastive")
REPORT_TYPES = {
    **dict.fromkeys(SELECTION_KINDS, SelectionReport),
    **dict.fromkeys(RETRIEVAL_KINDS, RetrievalReport),
    **dict.fromkeys(STUDY_KINDS, StudyReport),
}
YamlLoader = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
"""The loader in C, if PyYAML has it, is ten times as fast."""
KINDS = (*REPORT_TYPES, *TRAINING_KINDS)
"""Names of the folders below checkpoints/ whose runs a report covers."""


@dataclass(frozen=True)
class FinishedRun:
    """A finished run.

    Attributes:
        kind: Name of the command's folder, such as select.
        config: Settings of the run.
        training: Settings of the run that trained the evaluated model, or for a two-stage run with
            an untrained model, that trained its matcher (the retriever that ranks the frames); None
            for a released model, and an empty dictionary if that run's folder does not exist.
        recipe: Settings of the run whose model is evaluated, as its command got them; empty if
            there is none. For a student of `train.distill` or `train.reinforce`, `training` has
            those of the student's first training instead.
        report: Content of report.json; None for a training run.
        started: Time of the first start, in ISO format.
    """

    folder: Path
    title: str
    kind: str
    name: str
    config: dict[str, Any]
    training: dict[str, Any] | None
    recipe: dict[str, Any]
    report: SelectionReport | RetrievalReport | StudyReport | None
    started: str
    responses: Mapping[str, Responses] = field(default_factory=dict, repr=False)


def gather_runs(
    root: Path, saved: Path, patterns: Sequence[str] | None
) -> tuple[list[FinishedRun], list[str]]:
    """Return the finished runs below `root` and the results in `saved`, oldest first.

    Args:
        saved: Folder of the results of `dynapix.Result.save` and `dynapix.RetrievalScores.save`.
        patterns: Titles of runs, or glob patterns of titles, such as select/*; None for all runs.

    Returns:
        The runs, and a sentence for each run that is left out because it cannot be read.

    Raises:
        UserError: No evaluation is among the runs, a pattern matches no finished run, or a run that
            a pattern names cannot be read.
    """
    if saved.exists() and not saved.is_dir():
        raise UserError(f"saved={saved} is no folder: give that of saved results", "missing-run")
    # The runs of a sweep are one folder deeper.
    depths = ("*/metrics.json", "*/*/metrics.json")
    files = [f for kind in KINDS for depth in depths for f in sorted(root.glob(f"{kind}/{depth}"))]
    folders = {f.parent.relative_to(root).as_posix(): f.parent for f in files}
    folders |= {f.parent.as_posix(): f.parent for f in sorted(saved.glob("*/metrics.json"))}
    titles = list(folders)
    if patterns is not None:
        titles = [title for p in patterns for title in _match(root, p, titles)]
    runs, left_out = [], []
    for title in dict.fromkeys(titles):
        try:
            runs.append(_read_run(folders[title], title, root))
        except UserError as error:
            if patterns is not None:
                raise
            left_out.append(f"{title} is left out: {error}")
    if all(run.kind in TRAINING_KINDS for run in runs):
        reasons = "".join(f"\n{sentence}" for sentence in left_out)
        raise UserError(
            f"no finished evaluation is among the runs below {root}: first run python -m "
            "evaluation.select model=checkpoints/sft/RUN or python -m evaluation.retrieve "
            f"model=checkpoints/contrastive/RUN{reasons}",
            code="missing-run",
        )
    return sorted(runs, key=lambda run: (run.started, run.kind, run.name)), left_out


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


def _read_run(folder: Path, title: str, root: Path) -> FinishedRun:
    kind, _, name = title.partition("/")
    with reading(folder, "run.json"):
        record = json.loads((folder / "run.json").read_text())
        started = min(map(str, [record["started"], *record["earlier_starts"]]))
        # Results that were saved from Python name the command whose files they have.
        kind = record.get("kind", kind)
    report, responses = None, {}
    if kind in REPORT_TYPES:
        with reading(folder):
            report = from_json(REPORT_TYPES[kind], json.loads((folder / "report.json").read_text()))
    if kind in SELECTION_KINDS:
        responses = read_responses(folder, kind, report)
    settings = _read_settings(folder)
    training, recipe = _training_settings(settings, root)
    return FinishedRun(
        folder, title, kind, name, settings, training, recipe, report, started, responses
    )


def _read_settings(folder: Path, file_name: str = "config.yaml") -> dict[str, Any]:
    with reading(folder, file_name), open(folder / file_name, "rb") as file:
        try:
            return dict(yaml.load(file, Loader=YamlLoader))
        except yaml.YAMLError as error:
            raise ValueError(str(error)) from error


def _training_settings(
    settings: Mapping[str, Any], root: Path
) -> tuple[dict[str, Any] | None, dict[str, Any]]:
    """Return `training` and `recipe` of the model of an evaluation; see `FinishedRun`."""
    model = settings.get("model") or (settings.get("matcher") or {}).get("model")
    if model is None:
        return None, {}
    if (folder := locate_run(str(model), root)) is None:
        return {}, {}
    recipe = _read_settings(folder)
    file = settings_file(folder).name
    return (recipe if file == "config.yaml" else _read_settings(folder, file)), recipe
