"""Word lists of the number detection, read from lexicon.yaml."""

from __future__ import annotations

from importlib.resources import files
from types import SimpleNamespace

import yaml

_LISTS = yaml.safe_load((files("teacher.numbers") / "lexicon.yaml").read_text(encoding="utf-8"))
LEXICON = SimpleNamespace(**{name: dict.fromkeys(text.split()) for name, text in _LISTS.items()})
"""Each list as the keys of a dictionary, a set that keeps the order of the file."""
