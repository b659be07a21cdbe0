"""Entry point of commands: check the settings, open the run folder, call `main`, write metrics."""

from __future__ import annotations

import argparse
import functools
import logging
import os
from collections.abc import Callable
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

try:
    from hydra.core.utils import configure_log
except ModuleNotFoundError as error:
    raise SystemExit(
        f"error: commands need {error.name}: pip install -e '.[simulate]'  [missing-package]"
    ) from None
from omegaconf import DictConfig, OmegaConf

from dynapix.conf.compose import compose_run
from dynapix.conf.errors import SettingsError, UserError
from dynapix.conf.failures import open_closed_streams, report_failures
from dynapix.conf.files import write_json
from dynapix.conf.help import help_text
from dynapix.conf.multirun.sweep import run_sweep
from dynapix.conf.runs import Run, lock_folder, open_run, rank, run_name, world_size

Main = Callable[[Any, Run], dict[str, float] | None]


def command(name: str, schema: type, ranks: bool = False) -> Callable[[Main], Callable[[], None]]:
    """Return a decorator that turns `main(cfg, run)` into the command `python -m name`.

    The undecorated `main` receives its settings as an instance of `schema` and returns metrics. The
    metrics are written to metrics.json in the run's folder, and this file marks the run as
    finished. If `main` returns None, no file is written and the run stays unfinished. The
    decorator's result takes no arguments; its attribute `__wrapped__` is the undecorated `main`.

    Args:
        ranks: Whether `main` can be run by several ranks of a launcher such as torchrun.
    """

    def decorate(main: Main) -> Callable[[], None]:
        @functools.wraps(main)
        def start() -> None:
            open_closed_streams()
            # A log that cannot be written, as on a full disk, prints no tracebacks.
            logging.raiseExceptions = False
            with report_failures():
                if world_size() > 1 and not ranks:
                    raise UserError(
                        f"{name} uses one process, but RANK and WORLD_SIZE={world_size()} are set: "
                        "run it with python, not with torchrun or another launcher of several "
                        "ranks, and unset these variables",
                        code="unsupported-ranks",
                    )
                _start(name, schema, main)

        return start

    return decorate


class Parser(argparse.ArgumentParser):
    """Parses a command line. Raises SettingsError for an option that does not exist."""

    def __init__(self, name: str) -> None:
        super().__init__(prog=f"python -m {name}", add_help=False, allow_abbrev=False)
        self.add_argument("overrides", nargs="*")
        for option in ("help", "multirun"):
            self.add_argument(f"--{option}", f"-{option[0]}", action="store_true")
        self.add_argument("--cfg", "-c", choices=("job", "hydra", "all"))
        self.add_argument("--package", "-p")
        self.add_argument("--resolve", action="store_true")

    def error(self, message: str) -> NoReturn:
        raise SettingsError(
            f"{message}: the options are --help, -m for a sweep, and --cfg job|hydra|all with "
            "--package KEY and --resolve; settings are given as KEY=VALUE",
            code="unsupported-option",
        )


def _start(name: str, schema: type, main: Main) -> None:
    """Read the command line: print the help or the settings, run a sweep, or run `main`."""
    args = Parser(name).parse_intermixed_args()
    if args.help:
        print(help_text(name, schema, args.overrides))
        return
    if args.multirun and args.cfg:
        raise SettingsError("-m with --cfg: give one of them", "conflicting-options")
    if (args.resolve or args.package) and not args.cfg:
        raise SettingsError(
            "--resolve and --package need --cfg job, which prints settings", "conflicting-options"
        )
    if args.multirun:
        if world_size() > 1:
            raise UserError(
                "a sweep starts its own processes: run it with python, not with torchrun or "
                "another launcher of several ranks",
                code="sweep-with-ranks",
            )
        run_sweep(name, schema, args.overrides)
        return
    if presets := [o for o in args.overrides if o.startswith("+sweep=")]:
        raise SettingsError(f"{presets[0]} is a sweep: run it with -m", code="needs-multirun")
    settings, cfg = compose_run(name, schema, args.overrides)
    if args.cfg:
        print(format_settings(cfg, args.cfg, args.package, args.resolve), end="")
        return
    folder = Path(os.path.relpath(cfg.hydra.run.dir))
    with report_failures(cfg.hydra.run.dir):
        folder.mkdir(parents=True, exist_ok=True)
        configure_log(cfg.hydra.job_logging, cfg.hydra.verbose)
        overrides = tuple(cfg.hydra.overrides.task)
        _run(name, main, settings, Run(run_name(settings.run, list(overrides)), folder, overrides))


def format_settings(cfg: DictConfig, kind: str, package: str | None, resolve: bool) -> str:
    """Return the settings of a run (job), those of Hydra (hydra) or both (all) as YAML.

    Args:
        package: Key of the only group of settings to return.
        resolve: Whether references to other settings are replaced by their values.

    Raises:
        SettingsError: There is no such group.
    """
    keys = [key for key in cfg if kind == "all" or (key == "hydra") == (kind == "hydra")]
    shown = OmegaConf.masked_copy(cfg, keys)
    if package not in (None, "_global_"):
        shown = OmegaConf.select(cfg, package)
        if not OmegaConf.is_config(shown):
            raise SettingsError(f"--package {package} is no group of settings", "unknown-key")
    return OmegaConf.to_yaml(shown, resolve=resolve)


def _run(name: str, main: Main, settings: Any, run: Run) -> None:
    """Run one job: lock and open its folder, call `main`, write its metrics."""
    if rank() > 0:
        # Only the main rank locks and opens the folder. The other ranks log only errors.
        logging.disable(logging.WARNING)
        main(settings, run)
        return
    busy = (
        f"{run.folder} is in use by another process of this command: wait for it, or choose "
        "another folder with run=NAME"
    )
    with lock_folder(run.folder, busy):
        open_run(run, asdict(settings), name)
        metrics = main(settings, run)
        if metrics is not None:
            write_json(run.folder / "metrics.json", metrics)
