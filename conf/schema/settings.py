"""Base class of all groups of settings, and the checks that several groups share."""

from __future__ import annotations

import operator
import os
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import field, fields
from math import isfinite
from typing import Any, get_args, get_origin, get_type_hints
from urllib.parse import urlsplit

from dynapix.conf.errors import UserError
from dynapix.conf.files import expand_path, refuse_broken_link
from dynapix.conf.runs import resolve_run_name

MISSING: Any = "???"
"""Default of a required setting. It equals `omegaconf.MISSING`, but importing the schema does not
import OmegaConf, which a minimal installation lacks."""

BOUNDS = {
    "least": (operator.ge, "{} or more"),
    "above": (operator.gt, "above {}"),
    "most": (operator.le, "at most {}"),
    "below": (operator.lt, "below {}"),
}
"""For each bound that `setting` takes, its comparison and its wording in error messages."""


def setting(default: Any, options: Sequence[str | None] = (), **bounds: float) -> Any:
    """Return the dataclass field of a setting whose values are restricted.

    Args:
        default: The default value.
        options: The valid values; empty allows any value.
        bounds: Bounds by their name in BOUNDS, such as `least=1`. null satisfies every bound.
    """
    return field(default=default, metadata={"options": options, "bounds": bounds})


def path(default: Any) -> Any:
    """Return the dataclass field of a setting that names a file, a folder, or perhaps a model on
    the hub. A leading `~` is the home folder."""
    return field(default=default, metadata={"is_path": True})


class Settings:
    """Base of a group of settings: a dataclass whose fields are settings or nested groups."""

    def __post_init__(self) -> None:
        for entry in fields(self):
            value = getattr(self, entry.name)
            if entry.metadata.get("is_path") and value is not None:
                setattr(self, entry.name, expand_path(value))

    def check(self, group: str = "") -> list[str]:
        """Return one message per problem in this group and in its nested groups.

        Args:
            group: Prefix of this group's keys as the user types them, such as ``"train."``.
        """
        problems = []
        for entry in fields(self):
            key, value = f"{group}{entry.name}", getattr(self, entry.name)
            if isinstance(value, Settings):
                problems += value.check(f"{key}.")
            elif isinstance(value, dict):
                for name, nested in value.items():
                    if isinstance(nested, Settings):
                        problems += nested.check(f"{key}.{name}.")
            else:
                problems += _check_value(key, value, **entry.metadata)
        return [*problems, *self.find_problems(group)]

    def find_problems(self, group: str) -> Iterable[str]:
        """Return one message per further problem, such as settings that exclude each other.
        Subclasses override this method."""
        return ()


def from_dict(schema: type, values: Mapping[str, Any]) -> Any:
    """Return an instance of a settings class from nested dicts, the inverse of `asdict`."""
    hints = get_type_hints(schema)
    arguments = {}
    for name, value in values.items():
        kind = hints[name]
        if get_origin(kind) is dict:
            nested = get_args(kind)[1]
            arguments[name] = {key: from_dict(nested, inner) for key, inner in value.items()}
        elif isinstance(value, Mapping):
            arguments[name] = from_dict(kind, value)
        else:
            arguments[name] = value
    return schema(**arguments)


def _check_value(
    key: str,
    value: Any,
    options: Sequence[str | None] = (),
    bounds: Mapping[str, float] = {},
    is_path: bool = False,
) -> list[str]:
    if is_path and value is not None:
        try:
            refuse_broken_link(value)
        except UserError as error:
            return [f"{key}={value}: {error}"]
    if options and value not in options:
        return [f"{key}={value}: the options are {', '.join(o or 'null' for o in options)}"]
    numbers = value if isinstance(value, list) else [value]
    if any(isinstance(number, float) and not isfinite(number) for number in numbers):
        return [f"{key}={value}: give finite numbers"]
    if value is None or all(BOUNDS[name][0](value, bound) for name, bound in bounds.items()):
        return []
    wanted = " and ".join(BOUNDS[name][1].format(bound) for name, bound in bounds.items())
    return [f"{key}={value} must be {wanted}"]


def is_url(text: str) -> bool:
    """Return whether `text` is a complete http or https address."""
    try:
        parts = urlsplit(text)
        return parts.scheme in ("http", "https") and parts.port != 0 and " " not in text
    except ValueError:
        return False


def check_choices(name: str, chosen: Sequence[str] | None, options: Sequence[str]) -> list[str]:
    """Check that a list is not empty, repeats no value and contains only options; None passes."""
    if chosen is None or (chosen and len(set(chosen)) == len(chosen) and set(chosen) <= {*options}):
        return []
    return [f"{name}={chosen}: give one or more of {', '.join(options)}, each once"]


def check_run(run: str, folder: str) -> list[str]:
    """Check that `run` is the name of a run in `folder`, or the path of a folder inside it."""
    name = resolve_run_name(run, folder)
    if not os.path.isabs(name) and name.split(os.sep)[0] not in (".", ".."):
        return []
    return [
        f"run={run} is not a run in {folder}: give its name or its folder, and "
        "checkpoints=FOLDER if the runs are elsewhere"
    ]
