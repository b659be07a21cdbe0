"""The runs that a report is over, read from their folders."""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from conf.errors import UserError

CHOICES, RANKINGS = ("select", "similarity"), ("retrieve", "two_stage")
STUDIES, TRAININGS = ("export_study",), ("sft", "contrastive")
KINDS = (*CHOICES, *RANKINGS, *STUDIES, *TRAININGS)
"""Folders below checkpoints/ that hold runs of which a report tells."""


@dataclass(frozen=True)
class Finished:
    """A finished run: its folder, the command's folder that it is in (`kind`), its settings, its
    report.json, which a training run has none of, and when it was first started."""

    folder: Path
    kind: str
    name: str
    config: dict[str, Any]
    report: dict[str, Any]
    began: str


def gather(root: Path, patterns: Sequence[str] | None) -> list[Finished]:
    """The finished runs below `root` that a pattern, such as select/*, names; all where it is null.
    Oldest first.

    Raises:
        UserError: nothing is measured, a pattern names no run, or a run cannot be read.
    """
    found = [run for kind in KINDS for run in _runs(root, kind)]
    if patterns is not None:
        found = [run for pattern in patterns for run in _named(root, pattern, found)]
    runs = [_read(root, folder) for folder in dict.fromkeys(found)]
    if all(run.kind in TRAININGS for run in runs):
        raise UserError(
            f"nothing is measured below {root}: run python -m evaluation.select "
            "model=checkpoints/sft/RUN or python -m evaluation.retrieve "
            "model=checkpoints/contrastive/RUN first"
        )
    return sorted(runs, key=lambda run: (run.began, run.kind, run.name))


def _runs(root: Path, kind: str) -> list[Path]:
    """A command's finished runs, a sweep's jobs among them."""
    done = [*root.glob(f"{kind}/*/metrics.json"), *root.glob(f"{kind}/*/*/metrics.json")]
    return [path.parent for path in sorted(done)]


def _named(root: Path, pattern: str, finished: Sequence[Path]) -> list[Path]:
    """The runs that a pattern names, which are looked for among the `finished` ones."""
    pattern = pattern.strip("/").removeprefix(f"{root.as_posix().strip('/')}/")
    try:
        folders = [path for path in root.glob(pattern) if path.is_dir()]
    except (ValueError, NotImplementedError) as error:
        raise UserError(
            f"runs: {pattern} is no pattern of folders below {root}: {error}"
        ) from error
    chosen = [path for path in folders if path in finished]
    if chosen:
        return sorted(chosen)
    if folders:
        kind, *name = folders[0].relative_to(root).parts
        if kind == "study" and name:
            raise UserError(
                f"runs: {folders[0]} is a study, whose votes are reported once they are counted: "
                f"run python -m evaluation.study.export run={'/'.join(name)}, and name its run "
                f"below {root / 'export_study'}"
            )
        raise UserError(
            f"runs: {folders[0]} is no finished run of an evaluation or of training: run its "
            "command again to go on with it, or name another one"
        )
    there = [path.relative_to(root).as_posix() for path in finished]
    near = get_close_matches(pattern, there, 3, 0.3) or there[:3]
    told = f"; there are {', '.join(near)}" if near else ""
    raise UserError(f"runs: {pattern} names no run below {root}{told}")


def _read(root: Path, folder: Path) -> Finished:
    kind, *name = folder.relative_to(root).parts
    if not (folder / "config.yaml").exists():
        raise UserError(
            f"{folder / 'config.yaml'} is missing, so nobody knows what {folder} measured: delete "
            "that folder and measure again, or leave it out with runs=[...]"
        )
    settings = _settings(folder / "config.yaml", f"delete {folder} and measure again")
    report = {} if kind in TRAININGS else _report(folder)
    return Finished(folder, kind, "/".join(name), settings, report, _began(folder))


def _began(folder: Path) -> str:
    try:
        record = json.loads((folder / "run.json").read_text())
        return min(str(at) for at in [record["started"], *record["earlier_starts"]])
    except (OSError, ValueError, TypeError, KeyError) as error:
        raise unreadable(folder, "run.json") from error


def _settings(config: Path, mend: str) -> dict[str, Any]:
    try:
        settings = OmegaConf.to_container(OmegaConf.load(config))
        if not isinstance(settings, dict):
            raise YAMLError("it holds no settings")
    except (YAMLError, OmegaConfBaseException) as error:
        raise UserError(f"{config} is damaged: {mend}") from error
    return settings


def _report(folder: Path) -> dict[str, Any]:
    try:
        found = json.loads((folder / "report.json").read_text())
        return dict(found)
    except (OSError, ValueError, TypeError) as error:
        raise unreadable(folder) from error


def unreadable(folder: Path, file: str = "report.json") -> UserError:
    return UserError(
        f"{folder / file} is missing, damaged or of another version: delete {folder} "
        "and measure again"
    )


def json_lines(path: Path) -> Iterator[dict[str, Any]]:
    """The objects in a file of JSON lines, none where it is missing; lines that a kill tore are
    passed over."""
    if not path.exists():
        return
    with open(path, encoding="utf-8", errors="replace") as file:
        for line in file:
            try:
                row = json.loads(line)
            except ValueError:
                continue
            if isinstance(row, dict):
                yield row


def training_of(run: Finished, root: Path) -> dict[str, Any] | None:
    """The settings that the model of an evaluation was trained by, or else its matcher; None where
    both are as they were released, and empty where the folder is gone.

    Raises:
        UserError: they cannot be read.
    """
    model = run.config.get("model") or (run.config.get("matcher") or {}).get("model")
    if model is None:
        return None
    if not isinstance(model, str):
        raise unreadable(run.folder, "config.yaml")
    # Where the runs were moved, or are reported from another folder, it is below `root`.
    for folder in (Path(model), root / Path(*Path(model).parts[1:])):
        if (folder / "config.yaml").is_file():
            return _settings(folder / "config.yaml", "train again")
    return {}
