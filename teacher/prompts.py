"""Prompts for a teacher on a server.

The instructions come first and are the same for every item, so that the server can cache them.
"""

from __future__ import annotations

import json
from dataclasses import asdict
from importlib.resources import files

from conf.schema import TeacherConfig
from data.records import SelectionItem
from teacher.predicates.facts import Predicates
from teacher.sections import SECTIONS

PROMPT_VERSION = "3"

SYSTEM = (files("teacher") / "templates" / "system_prompt.txt").read_text().rstrip()


def build_messages(
    predicates: Predicates, item: SelectionItem, cfg: TeacherConfig
) -> list[dict[str, str]]:
    """Return the chat messages that request an item's rationale."""
    system = SYSTEM.format(sections=", ".join(SECTIONS), low=cfg.min_words, high=cfg.max_words)
    facts = json.dumps(asdict(predicates), separators=(",", ":"))
    user = f"Question: {item.question}\nFacts: {facts}\nAnswer to reach: {item.letter}"
    return [{"role": "system", "content": system}, {"role": "user", "content": user}]
