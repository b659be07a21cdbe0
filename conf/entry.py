"""Starts a command: checks its settings, opens its run folder, says its errors as sentences."""

from __future__ import annotations

import errno
import functools
import logging
import os
import re
import shutil
import sys
import time
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
from conf.runs import Run, lock_folder, open_run, rank, run_name, world_size, write_json

Metrics = dict[str, float]
Main = Callable[[Any, Run], Metrics | None]

GRACE = 3.0
"""Seconds that the main rank has to say what went wrong before another one does."""
LEFT_ALONE = r"gloo.*(by peer|[Bb]roken pipe)"
"""What a rank that waits for the others raises where one of them ended."""
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
        _print(help_text(name, schema, args.overrides))
        return
    if not (args.hydra_help or args.info or args.shell_completion):
        sweep = args.multirun or "hydra.mode=MULTIRUN" in args.overrides
        if sweep and world_size() > 1:
            raise UserError("a sweep starts processes of its own: start it with python, not ranks")
        preflight(name, schema, args.overrides, sweep)

    def task(cfg: DictConfig) -> Metrics | None:
        with _sentences(HydraConfig.get().run.dir):
            return _run(name, schema, main, cfg)

    # Hydra takes the job's name from here, and the launcher the module that a child process runs.
    task.__module__ = name
    # Hydra would print its own, shortened report of an error and swallow the error.
    os.environ["HYDRA_FULL_ERROR"] = "1"
    hydra.main(version_base="1.3", config_path="pkg://conf", config_name=short(name))(task)()


def _print(text: str) -> None:
    """Print to whoever reads it, as far as they do: `| head` reads a few lines."""
    try:
        print(text, flush=True)
    except BrokenPipeError:
        # Python would try the rest again as it ends.
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


def _run(name: str, schema: type, main: Main, cfg: DictConfig) -> Metrics | None:
    settings = strict(cfg, schema)
    task = HydraConfig.get()
    overrides = list(task.overrides.task)
    folder = Path(os.path.relpath(task.runtime.output_dir))
    run = Run(run_name(settings.run, overrides), folder, tuple(overrides))
    if rank() > 0:
        logging.disable(logging.WARNING)
        # The main rank holds the folder for all.
        return main(settings, run)
    in_use = (
        f"{run.folder} is in use: another process of this command writes there. Wait for it, or "
        "choose another folder with run=NAME"
    )
    with lock_folder(run.folder, in_use):
        open_run(run, asdict(settings), name, overrides)
        metrics = main(settings, run)
        if metrics is not None:
            write_json(run.folder / "metrics.json", metrics)
    return metrics


@contextmanager
def _sentences(folder: str = ".") -> Iterator[None]:
    """End with a sentence where a user can help it; any other error is a bug, with its traceback.

    A full disk may name no file, and some libraries report it as an error of their own: `folder`
    is where it is looked for. What ends several ranks is said by one of them.
    """
    try:
        yield
    except UserError as error:
        _let_main_speak()
        for line in str(error).splitlines():
            print(f"error: {line}  [{error.code}]", file=sys.stderr)
        _leave(2 if isinstance(error, SettingsError) else 1)
    except KeyboardInterrupt:
        _let_main_speak()
        print("interrupted; run the same command again to go on", file=sys.stderr)
        _leave(130)
    except OSError as error:
        if error.errno not in CANNOT_WRITE:
            raise
        _cannot_write(str(error.filename or folder), str(error.strerror))
    except Exception as error:
        if world_size() > 1 and re.search(LEFT_ALONE, str(error)):
            _leave(1)
        if not _full(folder):
            raise
        _cannot_write(folder, os.strerror(errno.ENOSPC))


def _leave(code: int) -> NoReturn:
    """End at once where there are several ranks: an orderly end waits for what others still send,
    and it is by the end of one that the launcher knows to end all."""
    if world_size() > 1:
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(code)
    sys.exit(code)


def _let_main_speak() -> None:
    """What is wrong on all ranks is said by the main one, with whose end the launcher ends the
    others; only what went wrong on this one alone is still to be said after a while."""
    if rank() != 0:
        time.sleep(GRACE)
        # The main one's progress bar stands in the line.
        print(file=sys.stderr)


def _cannot_write(where: str, why: str) -> NoReturn:
    _let_main_speak()
    print(
        f"error: {where}: {why}; once that is mended, the same command goes on where it was",
        file=sys.stderr,
    )
    _leave(1)


def _full(folder: str) -> bool:
    return os.path.exists(folder) and shutil.disk_usage(folder).free < NOTHING_LEFT
