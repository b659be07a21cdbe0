"""Settings of runs that train the student of another run further."""

from __future__ import annotations

from dataclasses import asdict, fields, replace
from pathlib import Path

import yaml

from conf.errors import UserError
from conf.files import write_text
from conf.runs import rank
from conf.schema import DistillCommand, ReinforceCommand, SftCommand, StudentConfig
from models.resolved import check_base
from models.trained_runs import STUDENT_SETTINGS, check_sees_frames, trained_settings


def source_settings(model: str | None) -> tuple[Path, SftCommand]:
    """Return the folder and the settings of the run whose student is trained further.

    Raises:
        UserError: The run is missing or cannot be read, its student does not write rationales about
            frames, or its base has changed.
    """
    if model is None:
        raise UserError(
            "model is missing: give the folder of a run of train.sft, such as "
            "model=checkpoints/sft/exp-cot",
            code="missing-run",
        )
    source = Path(model)
    trained = trained_settings(source, SftCommand, "student")
    check_sees_frames(source, trained.train.facts)
    if trained.train.regime == "answer_only":
        raise UserError(
            f"model={source} was trained with train.regime=answer_only and writes no rationales: "
            "give a run of another regime, such as one of train.sft +exp=cot",
            code="untrained-mode",
        )
    check_base(source, trained.student)
    return source, trained


def continued_settings(
    trained: SftCommand, student: StudentConfig, cfg: DistillCommand | ReinforceCommand
) -> SftCommand:
    """Return the settings of the student of a run that continues another one: those of the other
    run, with the training settings of this run where both have them.

    Args:
        trained: Settings of the other run.
        student: Settings of its student, with the resolved commit.
    """
    names = {f.name for f in fields(trained.train)} & {f.name for f in fields(cfg.train)}
    train = replace(trained.train, **{name: getattr(cfg.train, name) for name in names})
    return replace(trained, student=student, train=train, seed=cfg.seed)


def write_settings(folder: Path, settings: SftCommand) -> None:
    """Write the settings of a run's student, on the main rank."""
    if rank() == 0:
        text = yaml.safe_dump(asdict(settings), sort_keys=False)
        write_text(folder / STUDENT_SETTINGS, text)
