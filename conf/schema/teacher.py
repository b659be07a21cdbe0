"""Who narrates, and how it is asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from omegaconf import MISSING

from conf.schema.checks import too_small
from conf.schema.servers import ServersConfig


@dataclass
class TeacherConfig(ServersConfig):
    """Without a server it is the built-in narrator."""

    GROUP: ClassVar[str] = "teacher"

    name: str = MISSING
    """Recorded with every rationale."""
    seed: int = 0
    """Of the built-in narrator's phrasings; with a server, a label of one narration."""
    min_words: int = 80
    max_words: int = 250
    attempts: int = 4
    """Answers asked for at most for an item before it is set aside."""
    fallback: bool = False
    """Whether the built-in narrator tells the items that are set aside, marked as its own."""
    samples: int = 3
    """Answers that one request asks for, for an item whose answer before was rejected."""
    temperature: float = 0.7
    top_p: float = 0.8
    top_k: int = 20
    max_tokens: int = 640
    grammar: bool = False
    """Whether the server may write only what has a rationale's form."""

    def check(self) -> list[str]:
        least = {"seed": 0, "attempts": 1, "samples": 1, "temperature": 0, "max_tokens": 1}
        problems = super().check() + too_small(self, "teacher.", least)
        if (self.url is None) != (self.model is None):
            problems.append("teacher.url and teacher.model go together: set both or neither")
        if not 0 < self.min_words <= self.max_words:
            problems.append(
                f"teacher.min_words={self.min_words} and teacher.max_words={self.max_words}: "
                "need 0 < min <= max"
            )
        if self.grammar and self.url is None:
            problems.append("teacher.grammar=true needs a server: give teacher.url=...")
        if self.fallback and self.url is None:
            problems.append("teacher.fallback=true needs a server, for whose items it stands in")
        if not 0 < self.top_p <= 1:
            problems.append(f"teacher.top_p={self.top_p} must be above 0 and at most 1")
        return problems
