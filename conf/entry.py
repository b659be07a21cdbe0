"""Entry point of commands: check the settings, open the run folder, call `main`, write metrics."""

from __future__ import annotations

import functools
import logging
import os
import sys
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any

try:
    import hydra
except ModuleNotFoundError as error:
    raise SystemExit(
        f"error: commands need {error.name}: pip install -e '.[simulate]'  [missing-package]"
    ) from None
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from hydra.errors import HydraException
from omegaconf import DictConfig

from conf.compose import check_run_settings, config_name, register, validate_settings
from conf.errors import SettingsError, UserError
from conf.failures import report_failures
from conf.files import write_json
from conf.help import help_text
from conf.multirun.sweep import run_sweep
from conf.runs import Run, lock_folder, open_run, rank, run_name, world_size

Metrics = dict[str, float]
Main = Callable[[Any, Run], Metrics | None]

HYDRA_MODES = ("run", "multirun", "cfg", "info", "shell_completion")
"""Hydra's command-line options, without `--`, that exclude each other."""


def command(name: str, schema: type) -> Callable[[Main], Callable[[], None]]:
    """Return a decorator that turns `main(cfg, run)` into the command `python -m name`.

    The undecorated `main` receives its settings as an instance of `schema` and returns metrics. The
    metrics are written to metrics.json in the run's folder, and this file marks the run as
    finished. If `main` returns None, no file is written and the run stays unfinished. The
    decorator's result takes no arguments; its attribute `__wrapped__` is the undecorated `main`.
    """

    def decorate(main: Main) -> Callable[[], None]:
        @functools.wraps(main)
        def start() -> None:
            with report_failures():
                _start(name, schema, main)

        return start

    return decorate


def _start(name: str, schema: type, main: Main) -> None:
    """Read the command line: print the help, run a sweep, or check all settings and start Hydra."""
    register(name, schema)
    args = get_args_parser().parse_intermixed_args()
    # Hydra's own parser accepts overrides only behind the options.
    options = [argument for argument in sys.argv[1:] if argument not in args.overrides]
    sys.argv[1:] = [*options, *args.overrides]
    if args.help:
        print(help_text(name, schema, args.overrides))
        return
    modes = [f"--{mode}" for mode in HYDRA_MODES if getattr(args, mode)]
    if len(modes) > 1:
        raise SettingsError(f"{modes[0]} with {modes[1]}: give one of them", "conflicting-options")
    if args.resolve and not args.cfg:
        raise SettingsError("--resolve: add --cfg job to print settings", "conflicting-options")
    if args.multirun or "hydra.mode=MULTIRUN" in args.overrides:
        if world_size() > 1:
            raise UserError(
                "a sweep starts its own processes: run it with python, not with torchrun or "
                "another launcher of several ranks",
                code="sweep-with-ranks",
            )
        run_sweep(name, schema, args.overrides)
        return
    if not (args.hydra_help or args.info or args.shell_completion):
        check_run_settings(name, schema, args.overrides)

    def task(cfg: DictConfig) -> Metrics | None:
        with report_failures(HydraConfig.get().run.dir):
            return _run(name, schema, main, cfg)

    # Hydra uses the last part of the function's module as hydra.job.name, which names the folder of
    # the command's runs.
    task.__module__ = name
    # Without this variable Hydra catches exceptions and prints its own shortened traceback.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    start = hydra.main(version_base="1.3", config_path="pkg://conf", config_name=config_name(name))
    try:
        start(task)()
    except HydraException as error:
        # The settings have been checked, so an option such as --config-dir is wrong.
        raise SettingsError(str(error).strip().partition("\n")[0]) from error


def _run(name: str, schema: type, main: Main, cfg: DictConfig) -> Metrics | None:
    """Run one job: lock and open its folder, call `main`, write its metrics."""
    settings = validate_settings(cfg, schema)
    hydra_cfg = HydraConfig.get()
    overrides = list(hydra_cfg.overrides.task)
    folder = Path(os.path.relpath(hydra_cfg.runtime.output_dir))
    run = Run(run_name(settings.run, overrides), folder, tuple(overrides))
    if rank() > 0:
        # Only the main rank locks and opens the folder. The other ranks log only errors.
        logging.disable(logging.WARNING)
        return main(settings, run)
    busy = (
        f"{run.folder} is in use by another process of this command: wait for it, or choose "
        "another folder with run=NAME"
    )
    with lock_folder(run.folder, busy):
        open_run(run, asdict(settings), name)
        metrics = main(settings, run)
        if metrics is not None:
            write_json(run.folder / "metrics.json", metrics)
    return metrics
