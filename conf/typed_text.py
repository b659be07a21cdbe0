"""Texts that look like numbers: a setting that is a text keeps what the user typed.

Hydra's grammar and YAML read `1e-4`, `2026_11_29` and `true` as a number or a truth value, before
they know that a setting is a text: the name `1e-4` would become `0.0001`.
"""

from __future__ import annotations

import re
from collections.abc import Iterator
from dataclasses import is_dataclass
from functools import cache
from typing import Any, get_args, get_origin, get_type_hints

import yaml
from hydra._internal.core_plugins.importlib_resources_config_source import (
    ImportlibResourcesConfigSource,
)
from hydra._internal.sources_registry import SourcesRegistry
from hydra.core.override_parser.overrides_parser import OverridesParser
from hydra.core.plugins import Plugins
from hydra.plugins.config_source import ConfigResult
from omegaconf import OmegaConf
from omegaconf._utils import get_yaml_loader

from dynapix.conf.schema.settings import Settings

# A word between the brackets and commas of a value. Quoted texts and ranges match without a word.
WORDS = re.compile(
    r""""(?:\\.|[^"\\])*"|'(?:\\.|[^'\\])*'|(?:range|interval|tag)\(.*\)"""
    r"|(?P<before>^\s*|[\[,(]\s*)(?P<word>[^\s\[\](){},'\"]+)(?=\s*(?:[\]),]|$))"
)
ENTRIES = re.compile(r"(?P<key>\w+)(?P<colon>\s*:\s*)(?P<value>\[[^\]]*\]|[^\[\]{},]+)")
"""The entries of a dict whose values are lists or single words."""
TEXT_TAG, NULL_TAG = "tag:yaml.org,2002:str", "tag:yaml.org,2002:null"


def is_text(hint: Any) -> bool:
    """Return whether a setting of this type is a text, a list of texts, or null."""
    if get_origin(hint) is dict:
        return False
    return hint is str or any(map(is_text, get_args(hint)))


@cache
def text_keys() -> set[str]:
    """Return the names of all settings that are texts. OmegaConf converts the text of a setting
    that has such a name and another type."""
    hints = [get_type_hints(schema) for schema in _subclasses(Settings) if is_dataclass(schema)]
    return {name for own in hints for name, hint in own.items() if is_text(hint)}


def _subclasses(kind: type) -> Iterator[type]:
    for each in kind.__subclasses__():
        yield each
        yield from _subclasses(each)


def quote_texts(value: str, hint: Any) -> str:
    """Return the value of an override in which the texts that Hydra would read as numbers are
    quoted, as are paths that begin with `~`.

    Args:
        hint: The type of the setting.
    """
    if is_text(hint):
        return WORDS.sub(_quote, value)
    if value.lstrip().startswith("{"):
        return ENTRIES.sub(_quote_entry, value)
    return value


def _quote(match: re.Match[str]) -> str:
    word = match["word"]
    if word is None or not (word.startswith("~") or _is_number(word)):
        return match[0]
    return f"{match['before']}'{word}'"


def _is_number(word: str) -> bool:
    try:
        return isinstance(OverridesParser.create().parse_rule(word, "primitive"), int | float)
    except Exception:  # Hydra refuses the word, and names the override in its error.
        return False


def _quote_entry(match: re.Match[str]) -> str:
    hint = str if match["key"] in text_keys() else None
    return f"{match['key']}{match['colon']}{quote_texts(match['value'], hint)}"


class PresetLoader(get_yaml_loader()):  # type: ignore[misc]
    """Loads YAML as OmegaConf does, except that texts keep what was typed."""

    def construct_mapping(self, node: yaml.MappingNode, deep: bool = False) -> dict[Any, Any]:
        for key, value in node.value:
            if isinstance(key.value, str) and key.value in text_keys():
                for each in value.value if isinstance(value, yaml.SequenceNode) else [value]:
                    if isinstance(each, yaml.ScalarNode) and each.tag != NULL_TAG:
                        each.tag = TEXT_TAG
        return super().construct_mapping(node, deep=deep)


class PresetSource(ImportlibResourcesConfigSource):
    """Reads the files of settings in conf/, also those that begin with a byte-order mark."""

    def _read_config(self, res: Any) -> ConfigResult:
        text = res.read_text(encoding="utf-8-sig")
        return ConfigResult(
            config=OmegaConf.create(yaml.load(text, PresetLoader) or {}),
            path=f"{self.scheme()}://{self.path}",
            provider=self.provider,
            header=self._get_header_dict(text),
        )


def register_presets() -> None:
    """Let Hydra read the files of settings with `PresetSource`."""
    # Hydra registers its own reader when it loads its plugins.
    Plugins.instance()
    SourcesRegistry.instance().types[PresetSource.scheme()] = PresetSource
