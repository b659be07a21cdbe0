"""Starts a command: checks its settings, opens its run folder, says its errors as sentences."""

from __future__ import annotations

import errno
import functools
import os
import shutil
import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import Any, NoReturn

import hydra
from hydra._internal.utils import get_args_parser
from hydra.core.hydra_config import HydraConfig
from omegaconf import DictConfig

from conf.compose import preflight, register, short, strict
from conf.errors import SettingsError, UserError
from conf.help import help_text
from conf.runs import Run, open_run, run_name, write_json

Metrics = dict[str, float]
Main = Callable[[Any, Run], Metrics | None]

NOTHING_LEFT = 1 << 20
"""Free bytes under which a disk counts as full."""
CANNOT_WRITE = (
    errno.ENOSPC,
    errno.EDQUOT,
    errno.EROFS,
    errno.EACCES,
    errno.EPERM,
    errno.ENOTDIR,
    errno.EISDIR,
    errno.EEXIST,
    errno.ENAMETOOLONG,
)


def command(name: str, schema: type) -> Callable[[Main], Callable[[], None]]:
    """Make `main(cfg, run)` the command of the module `name`, with its settings in `schema`.

    `main` gets an instance of `schema`. The metrics it returns are written to the run's
    metrics.json, whose presence says that the run is finished. The function itself stays at hand
    as `main.__wrapped__`.
    """

    def decorate(main: Main) -> Callable[[], None]:
        @functools.wraps(main)
        def start() -> None:
            with _sentences():
                _start(name, schema, main)

        return start

    return decorate


def _start(name: str, schema: type, main: Main) -> None:
    register(name, schema)
    args = get_args_parser().parse_args()
    if args.help:
        print(help_text(name, schema, args.overrides))
        return
    if not (args.hydra_help or args.info or args.shell_completion):
        sweep = args.multirun or "hydra.mode=MULTIRUN" in args.overrides
        preflight(name, schema, args.overrides, sweep)

    def task(cfg: DictConfig) -> Metrics | None:
        with _sentences(HydraConfig.get().run.dir):
            return _run(name, schema, main, cfg)

    # Hydra takes the job's name from here, and the launcher the module that a child process runs.
    task.__module__ = name
    # Hydra would print its own, shortened report of an error and swallow the error.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    hydra.main(version_base="1.3", config_path="pkg://conf", config_name=short(name))(task)()


def _run(name: str, schema: type, main: Main, cfg: DictConfig) -> Metrics | None:
    settings = strict(cfg, schema)
    task = HydraConfig.get()
    overrides = list(task.overrides.task)
    run = Run(run_name(settings.run, overrides), Path(os.path.relpath(task.runtime.output_dir)))
    open_run(run, asdict(settings), name, overrides)
    metrics = main(settings, run)
    if metrics is not None:
        write_json(run.folder / "metrics.json", metrics)
    return metrics


@contextmanager
def _sentences(folder: str = ".") -> Iterator[None]:
    """End with a sentence where a user can help it; any other error is a bug, with its traceback.

    A full disk may name no file, and some libraries report it as an error of their own: `folder`
    is where it is looked for.
    """
    try:
        yield
    except UserError as error:
        for line in str(error).splitlines():
            print(f"error: {line}", file=sys.stderr)
        sys.exit(2 if isinstance(error, SettingsError) else 1)
    except KeyboardInterrupt:
        print("interrupted; run the same command again to go on", file=sys.stderr)
        sys.exit(130)
    except OSError as error:
        if error.errno not in CANNOT_WRITE:
            raise
        _cannot_write(str(error.filename or folder), str(error.strerror))
    except Exception:
        if not _full(folder):
            raise
        _cannot_write(folder, os.strerror(errno.ENOSPC))


def _cannot_write(where: str, why: str) -> NoReturn:
    print(
        f"error: {where}: {why}; once that is mended, the same command goes on where it was",
        file=sys.stderr,
    )
    sys.exit(1)


def _full(folder: str) -> bool:
    return os.path.exists(folder) and shutil.disk_usage(folder).free < NOTHING_LEFT
