"""The phrases of phrases.yaml, and the compass directions."""

from __future__ import annotations

import re
from collections import defaultdict
from importlib.resources import files

import yaml

from dynapix.teacher.predicates.facts import COMPASS

COARSE = "~"
"""Prefix of a value that the text states only roughly. "Leftward" has the value "~west": true for
west, unknown for northwest and southwest, and false for the other directions."""
ENDINGS = ("", "ern", "ward", "wards", "erly", "bound", "wardly")
"""Endings of a compass direction, as in "eastward" and "eastbound"."""

Phrase = tuple[tuple[str, ...], str, str]
"""The words of a phrase, the name of its tag, and the value of the tag ("" if it has none)."""


def _read_phrases() -> dict[str, list[Phrase]]:
    source = (files("dynapix.teacher.reading") / "phrases.yaml").read_text(encoding="utf-8")
    phrases: dict[str, list[Phrase]] = defaultdict(list)
    for tag, listed in yaml.safe_load(source).items():
        values = listed if isinstance(listed, dict) else {"": listed}
        for value, text in values.items():
            for phrase in text.split(";"):
                words = tuple(phrase.split())
                phrases[words[0]].append((words, tag, value))
    for direction in COMPASS:
        for ending in ENDINGS:
            joined = direction + ending
            split = re.sub("^(north|south)(?=east|west)", r"\1 ", joined)
            for word in {joined, split}:
                words = tuple(word.split())
                phrases[words[0]].append((words, "direction", direction))
    return {first: sorted(found, key=lambda p: -len(p[0])) for first, found in phrases.items()}


PHRASES_BY_FIRST_WORD = _read_phrases()
"""All phrases by their first word, the longest first."""
