"""Settings of the teacher, which narrates rationales."""

from __future__ import annotations

from dataclasses import dataclass
from typing import ClassVar

from omegaconf import MISSING

from conf.schema.checks import check_minimum, check_share
from conf.schema.servers import ServersConfig


@dataclass
class TeacherConfig(ServersConfig):
    """A model on a server, or the built-in narrator without one."""

    GROUP: ClassVar[str] = "teacher"

    name: str = MISSING
    """Name of the teacher, recorded with every rationale."""
    seed: int = 0
    """Seed of the built-in narrator's phrasing. A server does not receive it, but is asked again
    for every rationale when it changes."""
    min_words: int = 80
    """Minimum length of a rationale (words)."""
    max_words: int = 250
    """Maximum length of a rationale (words)."""
    attempts: int = 4
    """Maximum number of responses requested for an item before it is set aside."""
    fallback: bool = False
    """Let the built-in narrator narrate the items that are set aside; its rationales are marked."""
    samples: int = 3
    """Responses per request for an item whose previous response was rejected."""
    temperature: float = 0.7
    """Sampling temperature of the server's responses."""
    top_p: float = 0.8
    """Sample from the most likely tokens whose probabilities sum to this share."""
    top_k: int = 20
    """Sample from this number of most likely tokens."""
    max_tokens: int = 640
    """Maximum length of a response (tokens)."""
    grammar: bool = False
    """Constrain the server's decoding to the form of a rationale."""

    def check(self) -> list[str]:
        least = {"seed": 0, "attempts": 1, "samples": 1, "temperature": 0, "max_tokens": 1}
        problems = super().check() + check_minimum(self, "teacher.", least)
        if (self.url is None) != (self.model is None):
            problems.append("teacher.url and teacher.model: set both (a server) or neither")
        if not 0 < self.min_words <= self.max_words:
            problems.append(
                f"teacher.min_words={self.min_words} and teacher.max_words={self.max_words}: "
                "need 0 < min <= max"
            )
        if self.grammar and self.url is None:
            problems.append("teacher.grammar=true needs a server: give teacher.url=...")
        if self.fallback and self.url is None:
            problems.append("teacher.fallback=true needs a server: give teacher.url=...")
        return problems + check_share(self, "teacher.", ["top_p"])
