"""Compose a command's settings with Hydra and check them against its schema.

With `+key=` and `++key=`, Hydra accepts keys that are not in a structured schema, so the composed
settings are merged into the schema once more. Errors of Hydra and OmegaConf become a SettingsError,
whose message has one line per problem.
"""

from __future__ import annotations

import re
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields
from difflib import SequenceMatcher
from importlib.resources import files
from typing import Any

import yaml
from hydra import compose as hydra_compose
from hydra import initialize_config_module
from hydra.core.config_loader import ConfigLoader
from hydra.core.config_store import ConfigStore
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.errors import HydraException, OverrideParseException
from hydra.types import RunMode
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import OmegaConfBaseException

from dynapix.conf.errors import SettingsError
from dynapix.conf.files import expand_path, refuse_broken_link
from dynapix.conf.runs import flatten, resolve_run_name, run_name, runs_folder
from dynapix.conf.typed_text import adapt_override

for resolver in (expand_path, run_name, resolve_run_name, runs_folder):
    OmegaConf.register_new_resolver(resolver.__name__, resolver, replace=True)

CONFIG_NAMES = {"train.export": "export_model", "evaluation.study.export": "export_study"}
"""Config names of the commands whose module, like data.export, is named `export`."""
OVERLAYS = ("exp", "sweep")
"""Groups of overlays: files that change a few settings on top of a command's presets. An overlay is
added with `+`, as in `+exp=cot`, whereas a preset replaces another one, as in `student=tiny`."""


def register(command: str, schema: type) -> None:
    """Store `schema` under the name by which the defaults of `conf/<name>.yaml` refer to it."""
    ConfigStore.instance().store(name=f"{config_name(command)}_schema", node=schema)


def config_name(command: str) -> str:
    """Return the name of a command's config and of its folder of runs, such as sft for
    train.sft."""
    return CONFIG_NAMES.get(command) or command.rpartition(".")[2]


def compose(command: str, schema: type, overrides: list[str]) -> Any:
    """Compose the settings of one run as an instance of `schema`. Raises SettingsError."""
    settings, _ = compose_run(command, schema, overrides)
    return settings


def compose_run(command: str, schema: type, overrides: list[str]) -> tuple[Any, DictConfig]:
    """Compose the settings of one run as an instance of `schema`, and as a dictionary together with
    Hydra's own settings (`hydra.*`).

    Raises:
        SettingsError: The settings are invalid.
    """
    with open_hydra(command, schema):
        overrides = [adapt_override(override, schema) for override in overrides]
        refuse_empty_dicts(overrides)
        cfg = compose_config(command, overrides)
        if cfg.hydra.job.chdir:
            raise SettingsError(
                "hydra.job.chdir=true: folders of settings are relative to the folder in which the "
                "command starts; leave it out"
            )
        own = OmegaConf.masked_copy(cfg, [key for key in cfg if key != "hydra"])
        settings = validate_settings(own, schema)
        refuse_broken_link(f"{cfg.hydra.run.dir}/run.log")
        return settings, cfg


def refuse_empty_dicts(overrides: list[str]) -> None:
    """Raises SettingsError if an override contains `{}`, which Hydra merges without any effect."""

    def has_empty(value: Any) -> bool:
        return isinstance(value, dict) and (not value or any(map(has_empty, value.values())))

    for override in OverridesParser.create().parse_overrides(overrides):
        if has_empty(override.value()):
            raise SettingsError(
                f"{override.input_line}: an empty dict changes nothing, because the entries of the "
                "preset stay: set each entry that should change, as in KEY.NAME=VALUE"
            )


def list_presets(command: str, schema: type) -> dict[str, list[str]]:
    """Return the presets of each group of a command, and the overlays whose comment names the
    command."""
    with open_hydra(command, schema) as loader:
        groups = {g: loader.get_group_options(g) for g in loader.list_groups("")}
    for group in OVERLAYS:
        paths = {name: files("dynapix.conf") / group / f"{name}.yaml" for name in groups[group]}
        groups[group] = [name for name, p in paths.items() if f"{command} " in p.read_text()]
    used = {*OVERLAYS, *(field.name for field in fields(schema))}
    if "benchmark" in used:
        # A world is a group of settings inside the benchmark.
        used.add("world")
    return {group: names for group, names in groups.items() if names and group in used}


def validate_settings(cfg: DictConfig, schema: type) -> Any:
    """Convert composed settings to an instance of `schema`.

    Raises:
        OmegaConfBaseException: A key is not in the schema or has a value of the wrong type.
        SettingsError: A value is missing, or `Settings.check()` refuses it.
    """
    plain = OmegaConf.to_container(cfg, resolve=True)
    merged = OmegaConf.merge(OmegaConf.structured(schema), plain)
    if missing := sorted(OmegaConf.missing_keys(merged)):
        lines = [f"{key} is not set: give {key}=..." for key in missing]
        raise SettingsError("\n".join(lines), code="missing-setting")
    settings = OmegaConf.to_object(merged)
    if problems := settings.check():
        raise SettingsError("\n".join(problems))
    return settings


@contextmanager
def open_hydra(command: str, schema: type) -> Iterator[ConfigLoader]:
    """Initialise Hydra for a command; in the block, its errors become a SettingsError."""
    register(command, schema)
    # A running command composes the settings of further benchmarks.
    running = GlobalHydra.instance().hydra
    GlobalHydra.instance().clear()
    try:
        with initialize_config_module(
            "dynapix.conf", job_name=config_name(command), version_base="1.3"
        ):
            try:
                yield GlobalHydra.instance().config_loader()
            except (HydraException, OmegaConfBaseException) as error:
                raise _settings_error(command, error) from error
            except yaml.YAMLError as error:
                problem = " ".join(str(error).split())
                raise SettingsError(f"a file of settings is no valid YAML: {problem}") from error
    finally:
        GlobalHydra.instance().hydra = running


def compose_config(command: str, overrides: list[str], mode: RunMode = RunMode.RUN) -> DictConfig:
    """Compose the settings of a command together with Hydra's own (`hydra.*`).

    Raises:
        SettingsError: The value of a group of presets is not a name, or a key is inside a group
            that is null. Hydra's errors for these two cases name no key.
    """
    hydra = GlobalHydra.instance().hydra
    try:
        return hydra.compose_config(config_name(command), overrides, mode, from_shell=False)
    except UnicodeDecodeError as error:
        raise SettingsError(f"a file of settings is no UTF-8 text: {error}") from error
    except ValueError as error:
        parts = {o: o.lstrip("+").partition("=") for o in overrides}
        unnamed = " ".join(
            override
            for override, (key, _, value) in parts.items()
            if hydra.config_loader.get_group_options(key)
            and not isinstance(yaml.safe_load(value), str)
        )
        raise SettingsError(f"{unnamed}: give the name of a preset") from error
    except (AssertionError, AttributeError) as error:
        nested = " ".join(o for o in overrides if "." in o.partition("=")[0])
        raise SettingsError(
            f"{nested}: the group above one of these keys is null; choose a preset that sets it"
        ) from error


def _settings_error(command: str, error: Exception) -> SettingsError:
    """Return a SettingsError with a one-line message for an error of Hydra or OmegaConf."""
    if isinstance(error, OverrideParseException):
        return SettingsError(
            f"{error.override}: give KEY=VALUE without spaces, and put quotes around a value with "
            """special characters, as in 'run="a=b"'"""
        )
    cause = error.__cause__ if isinstance(error.__cause__, OmegaConfBaseException) else error
    text = " ".join(str(error).partition("Config search path")[0].split())
    unknown = re.search(r"Key '.*' (?:is )?not in .*\s+full_key: (\S+)", str(cause)) or re.match(
        r"Could not override '(?!exp'|sweep')(\S+)'. No match", text
    )
    if unknown:
        preset = re.match(r"In '\S+': |", text)[0]
        return SettingsError(preset + _unknown_key(command, unknown[1]), code="unknown-key")
    text = re.sub(r" (full_key:|See https).*", "", text).removeprefix("Error merging override ")
    text = text.replace(" Available options", "; available options")
    if hint := _type_hint(str(cause)):
        return SettingsError(f"{text}: {hint}")
    if cause is not error:
        return SettingsError(f"{text}: {str(cause).splitlines()[0]}")
    key = getattr(error, "override", None) or getattr(error, "full_key", None)
    return SettingsError(f"{key}: {text}" if key else text)


def _type_hint(message: str) -> str | None:
    """Return what to give instead of a value whose type OmegaConf refuses with a message."""
    if "is not a ListConfig, list or tuple" in message:
        return "give a list, such as [VALUE]"
    if "is not a subclass of" in message:
        return "this is a group of settings: set one of them with GROUP.NAME=VALUE"
    return None


def _unknown_key(command: str, key: str) -> str:
    if key.partition(".")[0] == "world":
        return (
            f"{command} has no key {key}: give benchmark.{key}, or begin your file in conf/world/ "
            "with the line # @package benchmark.world, without a byte-order mark before it"
        )
    if key.startswith("hydra."):
        return f"Hydra has no key {key}"
    defaults = flatten(OmegaConf.to_container(hydra_compose(config_name(command))))
    # A group such as `student` is a key too.
    paths = (dotted.split(".") for dotted in defaults)
    known = {".".join(path[:end]) for path in paths for end in range(1, len(path) + 1)}
    guess = nearest_key(key, known | {*OVERLAYS})
    hint = f"; did you mean {'+' if guess in OVERLAYS else ''}{guess}?" if guess else ""
    return f"{command} has no key {key}{hint}"


def nearest_key(key: str, known: Iterable[str]) -> str | None:
    """Return the known key most similar to `key`, or None if none is similar enough.

    The similarity of the last parts counts twice, so that `lr` suggests `train.lr`.
    """

    def similarity(other: str) -> float:
        last_parts = key.rpartition(".")[2], other.rpartition(".")[2]
        whole, last = (SequenceMatcher(None, *pair).ratio() for pair in ((key, other), last_parts))
        return whole + 2 * last

    best = max(sorted(known), key=similarity)
    return best if similarity(best) > 1.8 else None
