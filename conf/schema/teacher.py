"""Who narrates, and how it is asked."""

from __future__ import annotations

from dataclasses import dataclass

from omegaconf import MISSING

from conf.schema.checks import is_url, too_small


@dataclass
class TeacherConfig:
    name: str = MISSING
    """Recorded with every rationale."""
    url: str | None = None
    """An OpenAI-compatible server, such as http://127.0.0.1:8000/v1; null for the built-in
    narrator."""
    model: str | None = None
    """The model's name at the server."""
    seed: int = 0
    """Of the built-in narrator's phrasings; with a server, a label of one narration."""
    min_words: int = 80
    max_words: int = 250
    attempts: int = 4
    """Answers asked for at most for an item before it is set aside."""
    temperature: float = 0.7
    top_p: float = 0.8
    top_k: int = 20
    max_tokens: int = 640
    concurrency: int = 128
    """Requests in flight."""
    timeout: float = 120.0
    """Seconds that one request may take."""
    patience: float = 600.0
    """Seconds to wait for a server that is down before giving up."""

    def check(self) -> list[str]:
        problems = too_small(
            self,
            "teacher.",
            {
                "seed": 0,
                "attempts": 1,
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
        if self.url is not None and not is_url(self.url):
            problems.append(
                f"teacher.url={self.url} is no address of a server, such as "
                "http://127.0.0.1:8000/v1"
            )
        if not 0 < self.top_p <= 1:
            problems.append(f"teacher.top_p={self.top_p} must be above 0 and at most 1")
        return problems
