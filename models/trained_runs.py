"""Find what a training run wrote, and the settings it was trained with."""

from __future__ import annotations

import json
from collections.abc import Sequence
from pathlib import Path
from typing import Any, TypeVar

from omegaconf import OmegaConf
from omegaconf.errors import OmegaConfBaseException
from yaml import YAMLError

from conf.errors import UserError
from conf.schema import BenchmarkConfig
from models.resolved import pin_base, resolved_precision

EXPORT = "export.json"
"""Stands in a folder that `train.export` wrote, and there only."""

MEASURED_BY = {
    "student": ("temperature", "top_p", "top_k", "max_new_tokens", "max_length"),
    "retriever": ("widths", "max_length"),
    "train": ("precision",),
}
"""The settings of a run that a measurement may give otherwise, by their group: they change neither
what was trained nor what it is shown."""

Command = TypeVar("Command")


def run_title(folder: Path) -> str:
    """A run's name for a table; a sweep's job goes by the sweep and its number, an export by its
    run and format."""
    if (folder / EXPORT).exists():
        record = export_record(folder)
        return f"{record['run']} {record['format']}"
    return f"{folder.parent.name}/{folder.name}" if folder.name.isdigit() else folder.name


def export_record(folder: Path) -> dict[str, Any]:
    """What `train.export` noted of an export: its `run`, its `format`, the SHA-256 of the
    adapters that it is of as `weights`, and what was `measured` of it.

    Raises:
        UserError: the note is not whole.
    """
    try:
        record = json.loads((folder / EXPORT).read_text())
        return {name: record[name] for name in ("run", "format", "weights", "measured")}
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise UserError(
            f"{folder / EXPORT} is missing or damaged: delete {folder} and export again"
        ) from error


def product_folder(folder: Path, product: str) -> Path:
    """Where the weights and the processor of a run's `product` (student, retriever) are; an export
    is that folder itself."""
    return folder if (folder / EXPORT).exists() else folder / product


def trained_settings(
    folder: Path, schema: type[Command], product: str, key: str = "model"
) -> Command:
    """The settings of a finished training run or of an export's, as its command's dataclass.

    `key` is the one by which the user named the folder.

    Raises:
        UserError: `folder` is no run folder, holds no finished `product` (student, retriever), or
            settings that cannot be read.
    """
    config = folder / "config.yaml"
    try:
        there = OmegaConf.load(config)
        if (folder / product / EXPORT).exists():
            raise UserError(f"{key}={folder} holds an export: give {key}={folder / product}")
        if not OmegaConf.is_dict(there) or product not in there:
            raise UserError(f"{key}={folder} trained no {product}: it is another command's")
        if not (folder / EXPORT).exists() and not _finished(folder, product):
            raise UserError(
                f"{key}={folder} is not finished: run its command again to go on with it"
            )
        settings = OmegaConf.to_object(OmegaConf.merge(OmegaConf.structured(schema), there))
    except FileNotFoundError as error:
        raise UserError(
            f"{key}={folder} is no run folder of a trained {product}: {config} is missing; give "
            "the folder that the training command named, below checkpoints/"
        ) from error
    except (YAMLError, OmegaConfBaseException) as error:
        first = str(error).partition("\n")[0]
        raise UserError(
            f"{config} is damaged or of another version of DynaPix ({first}); train again"
        ) from error
    setattr(settings, product, pin_base(folder, getattr(settings, product)))
    settings.train.precision = resolved_precision(folder, settings.train.precision)
    return settings


def resolve_model(
    cfg: Any,
    benchmark: BenchmarkConfig,
    schema: type[Command],
    product: str,
    overrides: Sequence[str] = (),
    key: str = "model",
) -> tuple[Path | None, Any]:
    """The folder that `cfg.model` names and the settings of what was trained there, to be measured
    on a benchmark; None and `cfg` itself, which has a preset's, where it names none. Of what the
    user typed as `overrides`, the settings in `MEASURED_BY` hold instead of the run's.

    Raises:
        UserError: what `settings_of` and `check_unseen` raise; other settings of the model are
            given beside the run, whose own they are.
    """
    if cfg.model is None:
        return None, cfg
    folder = Path(cfg.model)
    settings = trained_settings(folder, schema, product, key)
    check_unseen(f"{key}={folder}", settings.benchmark, benchmark)
    _lay_over(settings, cfg, product, overrides, key)
    return folder, settings


def _lay_over(settings: Any, cfg: Any, product: str, overrides: Sequence[str], key: str) -> None:
    above = key.removesuffix("model")
    for override in overrides:
        typed = override.lstrip("+~").partition("=")[0]
        group, _, setting = typed.removeprefix(above).partition(".")
        preset = typed == above.removesuffix(".")
        if not preset and (not typed.startswith(above) or group not in (product, "train")):
            continue
        if preset or setting not in MEASURED_BY[group]:
            free = [f"{above}{g}.{name}" for g in (product, "train") for name in MEASURED_BY[g]]
            raise UserError(
                f"{typed} does nothing beside {key}={cfg.model}, which is measured as it was "
                f"trained: leave it out; what may be given is {', '.join(free)}"
            )
        setattr(getattr(settings, group), setting, getattr(getattr(cfg, group), setting))


def check_unseen(model: str, trained: BenchmarkConfig, asked: BenchmarkConfig) -> None:
    """Hold a benchmark to the one that `model`, as it is called, was trained on. What both simulate
    by one seed are the same scenes, as are what they read of one release; a split by one seed tests
    the same of them, and more where it tests a greater share.

    Raises:
        UserError: scenes of training may be among those that are tested.
    """
    scenes = (
        "simulator",
        "standin",
        "folder",
        *(("seed",) if trained.simulator == "bullet" else ()),
    )
    if any(getattr(trained, key) != getattr(asked, key) for key in scenes):
        return
    if trained.seed != asked.seed or asked.test_share > trained.test_share:
        raise UserError(
            f"{model} was trained with benchmark.seed={trained.seed} and "
            f"benchmark.test_share={trained.test_share}, and may have seen scenes that a split by "
            f"benchmark.seed={asked.seed} and benchmark.test_share={asked.test_share} tests: give "
            "those of the training"
        )


def modes_of(regime: str) -> list[str]:
    """The modes in which students of a regime are trained to answer."""
    return {"describe": [], "answer_only": ["answer"]}.get(regime, ["reasoning", "answer"])


def check_modes(folder: Path, regime: str, modes: Sequence[str]) -> None:
    """Raises UserError where a student is asked in a mode that it was not trained in."""
    trained = modes_of(regime)
    if set(modes) <= set(trained):
        return
    if not trained:
        raise UserError(
            f"model={folder} was trained to describe, as a base is, and never to choose: ask it as "
            f"a base with student.model={product_folder(folder, 'student')}"
        )
    raise UserError(
        f"model={folder} was trained in {' and '.join(trained)} mode alone "
        f"(train.regime={regime}), and is asked in {' and '.join(modes)} mode: give "
        f"modes=[{','.join(trained)}]"
    )


def _finished(folder: Path, product: str) -> bool:
    return (folder / "metrics.json").exists() and (folder / product).is_dir()
