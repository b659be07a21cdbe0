"""End a command after an error: a message for what the user can correct, a traceback for a bug."""

from __future__ import annotations

import errno
import logging
import os
import re
import select
import shutil
import signal
import sys
import time
from collections.abc import Iterator
from contextlib import contextmanager
from importlib.util import find_spec
from typing import NoReturn

from dynapix.conf.errors import SettingsError, UserError
from dynapix.conf.runs import rank, world_size

MAIN_RANK_GRACE = 3.0
"""Time (s) that other ranks wait before they print an error, so that the main rank prints first."""
PEER_ENDED = r"gloo.*(by peer|[Bb]roken pipe)"
"""Pattern of the error that a rank gets when it communicates with a rank that has ended."""
FAILED_WRITE = r"PytorchStreamWriter|unexpected pos|\(os error (27|28|122)\)"
"""Pattern of the messages of torch and safetensors for a file that they cannot write. torch's
message gives no cause."""
FULL_DISK_BYTES = 1 << 20
"""Free space below which a disk counts as full."""
FILE_ERRORS = {
    "ENOSPC", "EDQUOT", "EFBIG", "EROFS", "EACCES", "EPERM", "ENOTDIR", "EISDIR", "EEXIST",
    "ENAMETOOLONG", "ELOOP",
}  # fmt: skip
"""Names in `errno` of the errors of reading and writing that the user can correct."""


@contextmanager
def report_failures(folder: str = ".") -> Iterator[None]:
    """Exit with a message after a UserError, an interruption, an error of a file or an import of a
    package that is not installed. Exit without one if nobody reads the output any more, as after
    `| head`.

    Any other exception is a bug and keeps its traceback. With several ranks, one rank prints.

    Args:
        folder: The folder that the block writes to. If its disk is full, any exception counts as a
            failed write, because some libraries raise errors of their own.
    """
    try:
        yield
        sys.stdout.flush()
    except UserError as error:
        lines = [f"error: {line}  [{error.code}]" for line in str(error).splitlines()]
        _exit(2 if isinstance(error, SettingsError) else 1, "\n".join(lines))
    except ModuleNotFoundError as error:
        package = (error.name or "").partition(".")[0]
        if not package or find_spec(package):
            raise
        _exit(
            1,
            f"error: this command needs the package {package}: pip install -e '.[all]'  "
            "[missing-package]",
        )
    except KeyboardInterrupt:
        _exit(130, "interrupted; run the same command again to resume")
    except BrokenPipeError:
        if not _output_is_closed():
            raise
        _end_process(128 + signal.SIGPIPE)
    except OSError as error:
        if not _is_file_error(error):
            raise
        _exit_after_file_error(str(error.filename or folder), str(error.strerror))
    except Exception as error:
        # A library such as logging may raise an error of its own from that of the file.
        if isinstance(cause := error.__cause__, OSError) and _is_file_error(cause):
            _exit_after_file_error(str(cause.filename or folder), str(cause.strerror))
        if world_size() > 1 and re.search(PEER_ENDED, str(error)):
            _end_process(1)
        if os.path.exists(folder) and shutil.disk_usage(folder).free < FULL_DISK_BYTES:
            _exit_after_file_error(folder, os.strerror(errno.ENOSPC))
        if not re.search(FAILED_WRITE, str(error)):
            raise
        _exit_after_file_error(folder, f"a file was not written ({error})")


def open_closed_streams() -> None:
    """Open the standard streams that are closed, as after `>&-`, such that output is discarded.

    Otherwise the next file that is opened has the descriptor of a stream, to which child processes
    write their output.
    """
    for name, mode in (("stdin", "r"), ("stdout", "w"), ("stderr", "w")):
        if getattr(sys, name) is None:
            handle = os.open(os.devnull, os.O_RDWR)
            os.set_inheritable(handle, True)
            setattr(sys, name, os.fdopen(handle, mode))


def _is_file_error(error: OSError) -> bool:
    return errno.errorcode.get(error.errno) in FILE_ERRORS


def _output_is_closed() -> bool:
    """Return whether the reader of standard output, such as `head`, has ended. If so, discard the
    rest of the output, which Python would otherwise try to write at its exit."""
    poll = select.poll()
    poll.register(sys.stdout.fileno(), select.POLLOUT)
    if is_closed := any(event & select.POLLERR for _, event in poll.poll(0)):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())
    return is_closed


def _exit_after_file_error(path: str, reason: str) -> NoReturn:
    hint = "fix this and run the same command again to resume"
    _exit(1, f"error: {path}: {reason}; {hint}  [file-error]")


def _exit(status: int, message: str) -> NoReturn:
    """Print a message and exit; ranks other than the main rank do so after a delay.

    If all ranks have the error, the main rank prints it first, and its exit makes the launcher end
    the others. If only another rank has the error, that rank prints it after the delay.
    """
    if rank() != 0:
        time.sleep(MAIN_RANK_GRACE)
        # The cursor may be at the end of the main rank's progress bar: start a new line.
        print(file=sys.stderr)
    _close_progress_bars()
    print(message, file=sys.stderr)
    _end_process(status)


def _close_progress_bars() -> None:
    """Print open progress bars for the last time, so that a message begins on a new line."""
    if "tqdm" in sys.modules:
        for bar in [*sys.modules["tqdm"].tqdm._instances]:
            bar.close()


def _end_process(status: int) -> NoReturn:
    if world_size() > 1:
        # A normal exit would wait for messages of the other ranks, which wait for this rank.
        logging.shutdown()
        sys.stdout.flush()
        sys.stderr.flush()
        os._exit(status)
    sys.exit(status)
