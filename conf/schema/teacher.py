"""Who narrates, and how it is asked."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

from omegaconf import MISSING

from conf.schema.checks import is_url, too_small


@dataclass
class TeacherConfig:
    name: str = MISSING
    """Recorded with every rationale."""
    url: Any = None
    """An OpenAI-compatible server, such as http://127.0.0.1:8000/v1, or a list of several that
    serve the same model; null for the built-in narrator."""
    model: str | None = None
    """The model's name at the server."""
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
    concurrency: int = 128
    """Requests in flight, over all servers; 128 keep one busy."""
    timeout: float = 120.0
    """Seconds that one request may take."""
    patience: float = 600.0
    """Seconds to wait while no server can be asked before giving up."""

    @property
    def urls(self) -> list[str]:
        """The servers' addresses; none for the built-in narrator."""
        if self.url is None:
            return []
        return list(self.url) if isinstance(self.url, list) else [self.url]

    def check(self) -> list[str]:
        problems = too_small(
            self,
            "teacher.",
            {
                "seed": 0,
                "attempts": 1,
                "samples": 1,
                "temperature": 0,
                "max_tokens": 1,
                "concurrency": 1,
                "timeout": 1,
                "patience": 0,
            },
        )
        if (self.url is None) != (self.model is None):
            problems.append("teacher.url and teacher.model go together: set both or neither")
        if not 0 < self.min_words <= self.max_words:
            problems.append(
                f"teacher.min_words={self.min_words} and teacher.max_words={self.max_words}: "
                "need 0 < min <= max"
            )
        if self.url == []:
            problems.append("teacher.url=[] names no server: give one, or null for none")
        for url in self.urls:
            if not isinstance(url, str) or not is_url(url):
                problems.append(
                    f"teacher.url={url} is no address of a server, such as http://127.0.0.1:8000/v1"
                )
        if self.grammar and self.url is None:
            problems.append("teacher.grammar=true needs a server: give teacher.url=...")
        if self.fallback and self.url is None:
            problems.append("teacher.fallback=true needs a server, for whose items it stands in")
        if not 0 < self.top_p <= 1:
            problems.append(f"teacher.top_p={self.top_p} must be above 0 and at most 1")
        return problems
