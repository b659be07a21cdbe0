"""Exceptions that a command reports by their message, without a traceback."""

from __future__ import annotations

from importlib import import_module
from types import ModuleType


class UserError(Exception):
    """A problem that the user can solve, such as a missing file or an unreachable server.

    Args:
        message: What is wrong, where, and what to do about it; one line per problem.
        code: A short, stable name of the problem in kebab case, such as ``missing-run``. Scripts
            and tests rely on the code, never on the wording of the message.
    """

    def __init__(self, message: str, code: str = "user-error") -> None:
        # Both arguments are in `args`, so that the exception survives pickling between processes.
        super().__init__(message, code)
        self.message = message
        self.code = code

    def __str__(self) -> str:
        return self.message


class SettingsError(UserError):
    """A mistake in a command's settings. Most are detected before its `main` is called."""

    def __init__(self, message: str, code: str = "invalid-setting") -> None:
        super().__init__(message, code)


def import_extra(name: str, setting: str) -> ModuleType:
    """Import the package that the extra (the optional dependencies) of the same name installs.

    Raises:
        UserError: The package is not installed; the message names the `setting` that needs it.
    """
    try:
        return import_module(name)
    except ImportError as error:
        raise UserError(
            f"{setting} needs {name}: pip install -e '.[{name}]'", code="missing-package"
        ) from error
