"""Find the product (student or retriever) of a training run or an export, and its settings."""

from __future__ import annotations

import json
import logging
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from dynapix.conf.errors import UserError
from dynapix.conf.files import read_json
from dynapix.conf.runs import TRAINER_FOLDERS
from dynapix.conf.schema import BenchmarkConfig
from dynapix.models.resolved_settings import read_resolved, with_resolved_commit

log = logging.getLogger(__name__)

EXPORT = "export.json"
"""A file that only the folders that `train.export` writes contain."""

STUDENT_SETTINGS = "student.yaml"
"""A file in runs of train.distill and train.reinforce: the settings of the trained student, in the
form of those of train.sft."""

EVALUATION_SETTINGS = {
    "student": ("temperature", "top_p", "top_k", "max_new_tokens", "max_length"),
    "retriever": ("widths", "max_length"),
    "train": ("precision",),
}
"""Settings of a training run that an evaluation may override, by group. They change neither the
trained weights nor the model's input."""

Command = TypeVar("Command")


def run_title(folder: Path) -> str:
    """Return a run's name in tables: its folder's name, SWEEP/NUMBER for a job of a sweep, or "RUN
    FORMAT" for an export."""
    if (folder / EXPORT).exists():
        record = read_export_record(folder)
        return f"{record['run']} {record['format']}"
    return f"{folder.parent.name}/{folder.name}" if folder.name.isdigit() else folder.name


def locate_run(model: str, checkpoints: Path) -> Path | None:
    """Return the folder of the run that the setting `model` of an evaluation names; None if there
    is none. If the runs were moved, or the working directory is another, it is below
    `checkpoints`, in KIND/NAME or KIND/SWEEP/NUMBER."""
    path = Path(model)
    moved = (checkpoints.joinpath(*path.parts[k:]) for k in range(1, len(path.parts) - 1))
    return next((f for f in (path, *moved) if (f / "config.yaml").is_file()), None)


def read_export_record(folder: Path) -> dict[str, Any]:
    """Return the record of an export: the exported `run`, the `format`, and the SHA-256 of the
    adapters (`weights`).

    Raises:
        UserError: The file is missing or damaged.
    """
    try:
        record = json.loads((folder / EXPORT).read_text())
        return {name: record[name] for name in ("run", "format", "weights")}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{folder / EXPORT} is missing or damaged: delete {folder} and export again",
            code="damaged-file",
        ) from error


def product_folder(folder: Path, product: str) -> Path:
    """Return the folder of the weights and processor of a run; an export is itself this folder."""
    return folder if (folder / EXPORT).exists() else folder / product


def settings_file(folder: Path) -> Path:
    """Return the file with the settings of a trained model: student.yaml of a run of train.distill
    or train.reinforce, which takes most settings from another run, or else config.yaml."""
    path = folder / STUDENT_SETTINGS
    return path if path.exists() else folder / "config.yaml"


def read_trained_settings(
    folder: Path, schema: type[Command], product: str, key: str = "model"
) -> Command:
    """Return the settings of a finished training run or of an export.

    The precision and the commit of the base are those in the run's resolved.yaml.

    Args:
        product: student or retriever.
        key: The setting with which the user named the folder.

    Raises:
        UserError: `folder` is not the folder of a run or an export of this product, the run is not
            finished, or its settings are damaged.
    """
    record, config = folder / "run.json", settings_file(folder)
    command = read_json(record).get("command", "train.") if record.exists() else "train."
    saved = read_settings(config) if config.exists() and command.startswith("train.") else {}
    if product not in saved:
        raise UserError(
            f"{key}={folder} is no run that trained a {product}, and no export of one: give a "
            f"folder such as checkpoints/{TRAINER_FOLDERS[product]}/RUN, and give a base as "
            f"{product}.model={folder}",
            code="missing-run",
        )
    finished = (folder / "metrics.json").exists() and (folder / product).is_dir()
    if not finished and not (folder / EXPORT).exists():
        raise UserError(
            f"{key}={folder} is not finished: run its command again to resume it",
            code="unfinished-run",
        )
    settings = read_settings(config, schema)
    setattr(settings, product, with_resolved_commit(folder, getattr(settings, product)))
    settings.train.precision = read_resolved(folder).get("precision", settings.train.precision)
    return settings


def read_settings(config: Path, schema: type | None = None, group: str | None = None) -> Any:
    """Return a file of settings as a dict, which is empty if the file has another form; or, with a
    schema, the whole or one `group` as an instance of the schema."""
    try:
        saved = OmegaConf.load(config)
        if schema is None:
            return OmegaConf.to_container(saved) if OmegaConf.is_dict(saved) else {}
        part = saved[group] if group else saved
        return OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), part))
    except (YAMLError, OmegaConfBaseException, ValueError) as error:
        first = str(error).partition("\n")[0]
        raise UserError(
            f"{config} is damaged or of another version of DynaPix ({first}): train again, or "
            "restore the file",
            code="damaged-file",
        ) from error


def resolve_model(
    cfg: Any,
    benchmark: BenchmarkConfig,
    schema: type[Command],
    product: str,
    overrides: Sequence[str] = (),
    key: str = "model",
) -> tuple[Path | None, Any]:
    """Return the folder that `cfg.model` names and the settings of its run.

    If `cfg.model` is None, return None and `cfg` itself, which has the settings of a preset.
    Neither the run nor its base may have been trained on test scenes of the benchmark.

    Args:
        benchmark: The benchmark on which the model is evaluated.
        overrides: The overrides of the command line. Those of `EVALUATION_SETTINGS` replace
            settings of the run.

    Raises:
        UserError: As `read_trained_settings` and `check_unseen`; or an override changes another
            setting of the model or its training, which the run has fixed.
    """
    if cfg.model is None:
        _check_base_unseen(getattr(cfg, product).model, benchmark)
        return None, cfg
    folder = Path(cfg.model)
    settings = read_trained_settings(folder, schema, product, key)
    if product == "student":
        check_sees_frames(folder, settings.train.facts, key)
    check_unseen(f"{key}={folder}", settings.benchmark, benchmark)
    if settings.benchmark.store_name != benchmark.store_name:
        log.warning(
            "%s was trained on %s and is evaluated on %s: benchmark= and world= choose another",
            folder, settings.benchmark.store_name, benchmark.store_name,
        )  # fmt: skip
    _check_base_unseen(getattr(settings, product).model, benchmark)
    _apply_overrides(settings, cfg, product, overrides, key)
    return folder, settings


def _check_base_unseen(base: str | None, tested: BenchmarkConfig) -> None:
    """As `check_unseen`, for a base whose folder records the settings of its training."""
    config = Path(base or "") / "config.yaml"
    if base is None or not config.exists() or "benchmark" not in read_settings(config):
        return
    trained = read_settings(config, BenchmarkConfig, "benchmark")
    check_unseen(f"the base {base}", trained, tested)


def _apply_overrides(
    settings: Any, cfg: Any, product: str, overrides: Sequence[str], key: str
) -> None:
    prefix = key.removesuffix("model")
    groups = (product, "train")
    options = [f"{prefix}{group}.{name}" for group in groups for name in EVALUATION_SETTINGS[group]]
    for override in overrides:
        typed = override.lstrip("+~").partition("=")[0]
        group, _, setting = typed.removeprefix(prefix).partition(".")
        preset = typed == prefix.removesuffix(".")
        if typed in options:
            setattr(getattr(settings, group), setting, getattr(getattr(cfg, group), setting))
        elif preset or (typed.startswith(prefix) and group in groups):
            raise UserError(
                f"{typed} has no effect with {key}={cfg.model}, which is evaluated as it was "
                f"trained: leave it out; the settings that can be given are {', '.join(options)}",
                code="unused-setting",
            )


def check_unseen(model: str, trained: BenchmarkConfig, tested: BenchmarkConfig) -> None:
    """Check that no scene on which a model was trained is in the test split of a benchmark.

    Two benchmarks have the same scenes if they simulate one world with one seed, or read one
    release. Worlds that differ only in their look have the same scenes. If their splits have one
    seed, a greater test share adds test scenes and removes none.

    Args:
        model: The model's name in the error message.

    Raises:
        UserError: Training scenes may be among the test scenes.
    """
    scenes = ["simulator", "folder"] + ["seed"] * (trained.simulator == "bullet")
    if any(getattr(trained, key) != getattr(tested, key) for key in scenes):
        return
    look = dict.fromkeys(("name", "light", "floor", "background", "speed_bounds"))
    if replace(trained.world, **look) != replace(tested.world, **look):
        return
    if trained.seed != tested.seed or tested.test_share > trained.test_share:
        raise UserError(
            f"{model} was trained with benchmark.seed={trained.seed} and "
            f"benchmark.test_share={trained.test_share}; with benchmark.seed={tested.seed} and "
            f"benchmark.test_share={tested.test_share}, the test split may contain scenes that it "
            "was trained on: set both as in training, or simulate other scenes with another "
            "benchmark.seed",
            code="training-scenes-tested",
        )


def check_sees_frames(folder: Path, facts: bool, key: str = "model") -> None:
    """Raise UserError if a student was trained on facts (`train.facts`) instead of frames."""
    if facts:
        raise UserError(
            f"{key}={folder} was trained with train.facts=true, on facts instead of frames: it can "
            "only be the teacher of train.distill, as teacher_model",
            code="facts-instead-of-frames",
        )


def modes_of_regime(regime: str) -> list[str]:
    """Return the modes (reasoning, answer) in which a regime trains students to answer items."""
    return ["answer"] if regime == "answer_only" else ["reasoning", "answer"]


def check_modes(folder: Path, regime: str, modes: Sequence[str]) -> None:
    """Raise UserError if a student is evaluated in a mode that it was not trained in."""
    trained = modes_of_regime(regime)
    if not set(modes) <= set(trained):
        raise UserError(
            f"model={folder} was trained in {' and '.join(trained)} mode only "
            f"(train.regime={regime}), not in {' and '.join(modes)} mode: "
            f"set modes=[{','.join(trained)}]",
            code="untrained-mode",
        )
