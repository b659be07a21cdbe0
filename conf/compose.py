"""Composes a command's settings and refuses what its schema does not hold.

Hydra lets `+key=` and `++key=` past a structured schema, and names no neighbour of a mistyped key.
So every override is held against the schema first, and what Hydra composed is merged into the
schema once more.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from dataclasses import fields, is_dataclass
from typing import Any

from hydra import compose as hydra_compose
from hydra import initialize_config_module
from hydra._internal.core_plugins.basic_sweeper import BasicSweeper
from hydra.core.config_loader import ConfigLoader
from hydra.core.config_store import ConfigStore
from hydra.core.default_element import GroupDefault
from hydra.core.global_hydra import GlobalHydra
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.override_parser.types import Override
from hydra.errors import HydraException, OverrideParseException
from omegaconf import DictConfig, OmegaConf
from omegaconf.errors import ConfigAttributeError, ConfigKeyError, OmegaConfBaseException

import conf.multirun.plugins  # noqa: F401  registers the launcher that run_folder.yaml names
from conf.errors import SettingsError
from conf.keys import dict_above, has_key, keys, keys_like, nearest

OWN_NAMES = {"train.export": "export_model", "evaluation.study.export": "export_study"}
"""Commands that do not go by the last part of their name, because data.export does."""
REMOVED_KEYS: dict[str, str] = {
    "shown": "use examples instead",
    "cards": "use gpus instead",
}
"""Keys that no longer exist, each with what to do instead; the error for the key ends with it."""
OVERLAYS = ("exp", "sweep")
"""Groups that are laid over what a command has, as `+exp=cot`."""


def register(command: str, schema: type) -> None:
    """Let `conf/<name>.yaml` begin its defaults with `<name>_schema`."""
    ConfigStore.instance().store(name=f"{short(command)}_schema", node=schema)


def short(command: str) -> str:
    """sft for train.sft: the name of its config and of its folder of runs."""
    return OWN_NAMES.get(command) or command.rpartition(".")[2]


def compose(command: str, schema: type, overrides: list[str]) -> Any:
    """The settings of one run as an instance of `schema`. Raises SettingsError."""
    with _hydra(command, schema) as loader:
        _check_overrides(command, schema, _parse(overrides, loader), loader)
        return _compose_one(command, schema, overrides)


def preflight(command: str, schema: type, overrides: list[str], sweep: bool) -> None:
    """Compose and check one run, or each job of a sweep. Raises SettingsError."""
    with _hydra(command, schema) as loader:
        parsed = _parse(overrides, loader)
        for override in [] if sweep else filter(Override.is_sweep_override, parsed):
            raise SettingsError(
                f"{override.input_line} is a sweep: run it with -m, or write a list as "
                f"{_typed_key(override)}=[a,b]"
            )
        _check_overrides(command, schema, parsed, loader)
        first = _each_value(parsed)[0] if sweep else overrides
        _compose_one(command, schema, first)
        overlays = [str(o.input_line) for o in parsed if o.key_or_group == "sweep"]
        if not (sweep or overlays):
            return
        hydra = hydra_compose(short(command), first, return_hydra_config=True).hydra
        preset = [f"{key}={value}" for key, value in (hydra.sweeper.get("params") or {}).items()]
        if preset and not sweep:
            raise SettingsError(f"{' '.join(overlays)} is a sweep: run it with -m")
        if sweep:
            sweeper = hydra.runtime.choices["hydra/sweeper"]
            _check_sweep(command, schema, _parse([*preset, *overrides], loader), loader, sweeper)


def _check_sweep(
    command: str, schema: type, parsed: list[Override], loader: ConfigLoader, sweeper: str
) -> None:
    _check_overrides(command, schema, parsed, loader)
    # A search tries few of the combinations that it chooses among.
    for job in _jobs(parsed) if sweeper == "basic" else _each_value(parsed):
        _compose_one(command, schema, job)
    drawn = [o.input_line for o in parsed if o.is_interval_sweep()]
    if drawn and sweeper == "basic":
        raise SettingsError(f"{drawn[0]}: add hydra/sweeper=optuna, which draws from intervals")


def options(command: str, schema: type) -> dict[str, list[str]]:
    """The groups that a command takes, and the names to choose from in each."""
    with _hydra(command, schema) as loader:
        groups = {g: _options_in(schema, loader, g) for g in loader.list_groups("")}
        return {g: groups[g] for g in groups if groups[g] and (g in OVERLAYS or has_key(schema, g))}


def _options_in(schema: type, loader: ConfigLoader, group: str) -> list[str]:
    """A group's names, of overlays those that a schema can take."""
    names = loader.get_group_options(group)
    if group not in OVERLAYS:
        return names
    return [name for name in names if _lies_over(schema, loader, group, name)]


def _lies_over(schema: type, loader: ConfigLoader, group: str, overlay: str) -> bool:
    """Whether a schema has the keys that an overlay sets, chooses presets for, or sweeps over."""
    told = loader.repository.load_config(f"{group}/{overlay}")
    chosen = [d.group.lstrip("/") for d in told.defaults_list if isinstance(d, GroupDefault)]
    own = OmegaConf.to_container(told.config)
    swept = own.pop("hydra", {}).get("sweeper", {}).get("params", {})
    return all(has_key(schema, key) for key in (*chosen, *_dotted(own), *swept))


def _dotted(settings: dict[str, Any]) -> Iterator[str]:
    """The keys of nested settings, as a command line has them."""
    for key, value in settings.items():
        if isinstance(value, dict):
            yield from (f"{key}.{name}" for name in _dotted(value))
        else:
            yield key


def strict(cfg: DictConfig, schema: type) -> Any:
    """The composed settings as an instance of `schema`.

    Raises SettingsError for keys that the schema does not hold, wrong types, missing values, and
    whatever the dataclasses' own `check()` finds.
    """
    try:
        plain = OmegaConf.to_container(cfg, resolve=True)
        merged = OmegaConf.merge(OmegaConf.structured(schema), plain)
    except OmegaConfBaseException as error:
        raise SettingsError(_omegaconf_problem(error, schema)) from error
    if missing := sorted(OmegaConf.missing_keys(merged)):
        raise SettingsError("\n".join(f"{key} is not set: give {key}=..." for key in missing))
    settings = OmegaConf.to_object(merged)
    if problems := list(_checked(settings)):
        raise SettingsError("\n".join(problems))
    return settings


@contextmanager
def _hydra(command: str, schema: type) -> Iterator[ConfigLoader]:
    register(command, schema)
    with initialize_config_module("conf", job_name=short(command), version_base="1.3"):
        yield GlobalHydra.instance().config_loader()


def _parse(overrides: list[str], loader: ConfigLoader) -> list[Override]:
    try:
        return OverridesParser.create(config_loader=loader).parse_overrides(overrides)
    except OverrideParseException as error:
        reason = str(error).partition("\n")[0]
        raise SettingsError(f"{error.override} cannot be read: {reason}") from error


def _check_overrides(
    command: str, schema: type, overrides: Iterable[Override], loader: ConfigLoader
) -> None:
    problems = []
    for override in overrides:
        if not override.is_hydra_override():
            problems += _override_problems(command, schema, override, loader)
    if problems:
        raise SettingsError("\n".join(problems))


def _override_problems(
    command: str, schema: type, override: Override, loader: ConfigLoader
) -> list[str]:
    key = override.key_or_group
    # `student={...}` sets values below student, `student=tiny` chooses a preset.
    chosen = [] if isinstance(override._value, dict) else _chosen(override)
    options = loader.get_group_options(key)
    fitting = ", ".join(_options_in(schema, loader, key)) if options else ""
    told = f"the options are {fitting}" if fitting else f"{command} takes none"
    if options and override._value is None and not override.is_delete():
        return [f"{override.input_line} chooses nothing: {told}"]
    if options and chosen and not override.is_delete():
        root = (override.package or key).partition(".")[0]
        if root not in OVERLAYS and not has_key(schema, root):
            return [f"{_typed_key(override)}: {command} takes no {root}"]
        if root not in OVERLAYS and override.is_add():
            return [f"{override.input_line}: a {root} is chosen already, leave out the +"]
        if root in OVERLAYS and not (override.is_add() or override.is_force_add()):
            return [f"{override.input_line}: lay it over with a +, as +{override.input_line}"]
        return [
            f"{_typed_key(override)}={name}: no such {key}, {told}"
            for name in chosen
            if name not in options
        ]
    if has_key(schema, key) or key in OVERLAYS:
        return []
    if key in REMOVED_KEYS:
        return [f"{_typed_key(override)}: this key was removed; {REMOVED_KEYS[key]}"]
    guess = nearest(key, [*keys_like(schema, key), *OVERLAYS])
    hint = f", did you mean {'+' if guess in OVERLAYS else ''}{guess}?" if guess else ""
    return [f"{_typed_key(override)}: {command} has no such key{hint}"]


def _chosen(override: Override) -> list[str]:
    """The names that a group override chooses, each of a sweep's included."""
    if override.is_discrete_sweep():
        return [str(value) for value in override.sweep_string_iterator()]
    value = override.value()
    return [str(name) for name in value] if isinstance(value, list) else [str(value)]


def _typed_key(override: Override) -> str:
    return str(override.input_line).partition("=")[0]


def _jobs(overrides: list[Override]) -> list[list[str]]:
    """Each job of a sweep over every combination; the start of an interval stands for it."""
    drawn = [o for o in overrides if o.is_interval_sweep()]
    [jobs] = BasicSweeper.split_arguments([o for o in overrides if o not in drawn], None)
    return [[*job, *(_values(o)[0] for o in drawn)] for job in jobs]


def _each_value(overrides: list[Override]) -> list[list[str]]:
    """As few jobs as have each value of a sweep in one of them, both ends of an interval too."""
    values = {o.get_key_element(): _values(o) for o in overrides}
    return [
        [lines[number % len(lines)] for lines in values.values()]
        for number in range(max(map(len, values.values()), default=1))
    ]


def _values(override: Override) -> list[str]:
    key = override.get_key_element()
    if override.is_interval_sweep():
        interval = override.value()
        return [f"{key}={interval.start}", f"{key}={interval.end}"]
    if override.is_sweep_override():
        return [f"{key}={value}" for value in override.sweep_string_iterator()]
    return [str(override.input_line)]


def _compose_one(command: str, schema: type, overrides: list[str]) -> Any:
    try:
        return strict(hydra_compose(short(command), overrides), schema)
    except HydraException as error:
        raise SettingsError(_hydra_problem(error, schema)) from error
    except OmegaConfBaseException as error:
        raise SettingsError(_omegaconf_problem(error, schema)) from error
    except (AssertionError, AttributeError) as error:
        raise SettingsError(
            f"{_below_null(command, overrides)}: cannot be set below a key that is null here, "
            "choose a preset that has it"
        ) from error


def _below_null(command: str, overrides: list[str]) -> str:
    """The overrides at which OmegaConf 2.3 fails, without a word, because they lie below a
    dataclass that a preset has set to null."""

    def fails(override: str) -> bool:
        try:
            hydra_compose(short(command), [*choices, override])
        except (AssertionError, AttributeError):
            return True
        return False

    dotted = [o for o in overrides if "." in o.partition("=")[0]]
    choices = [o for o in overrides if o not in dotted]
    return " ".join([o for o in dotted if fails(o)] or dotted)


def _hydra_problem(error: HydraException, schema: type) -> str:
    text = " ".join(str(error).partition("Config search path")[0].split())
    text = text.partition(" full_key:")[0].removeprefix("Error merging override ")
    cause = error.__cause__
    if not isinstance(cause, OmegaConfBaseException):
        return text
    typed = text.partition("=")[0]
    if spot := _new_name(cause, typed.lstrip("+"), schema):
        above, _, name = spot.rpartition(".")
        return f"{spot}: no such name yet, add it as +{above}={{{name}: {{...}}}}"
    problem = _omegaconf_problem(cause, schema)
    return f"{text}: {problem.removeprefix(f'{typed}: ')}"


def _new_name(cause: OmegaConfBaseException, typed: str, schema: type) -> str | None:
    """The name that an override would have added to a dict of settings, with the keys above it."""
    if isinstance(cause, ConfigAttributeError | ConfigKeyError):
        parent = cause.full_key.rpartition(".")[0]
        return cause.full_key if dict_above(schema, cause.full_key) == parent else None
    if "is not a subclass" in str(cause) and (above := dict_above(schema, typed)):
        name = typed.removeprefix(f"{above}.").partition(".")[0]
        return f"{above}.{name}"
    return None


def _omegaconf_problem(error: OmegaConfBaseException, schema: type) -> str:
    text, key = str(error).partition("\n")[0], error.full_key
    if not isinstance(error, ConfigAttributeError | ConfigKeyError):
        return f"{key}: {text}" if key else text
    if key in REMOVED_KEYS:
        return f"{key}: this key was removed; {REMOVED_KEYS[key]}"
    guess = None if dict_above(schema, key) else nearest(key, keys(schema))
    return f"{key}: no such key{f', did you mean {guess}?' if guess else ''}"


def _checked(settings: Any) -> Iterator[str]:
    """What `check()` finds, of the nested dataclasses first."""
    for field in fields(settings):
        value = getattr(settings, field.name)
        if is_dataclass(value):
            yield from _checked(value)
    if hasattr(settings, "check"):
        yield from settings.check()
