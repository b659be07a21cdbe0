"""Settings of OpenAI-compatible servers, which serve the teacher or the model to measure."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any, ClassVar

from dynapix.conf.schema.settings import MISSING, Settings, is_url, path, setting

NARRATOR_WORDS = (80, 250)
"""Minimum and maximum number of words of the built-in narrator's rationales."""


@dataclass
class ServersConfig(Settings):
    """Settings that `server` and `teacher` share. All addresses serve the same model."""

    GROUP: ClassVar[str]
    """Key of this group of settings, which error messages name."""

    url: Any = None
    """Address of an OpenAI-compatible server, such as http://127.0.0.1:8000/v1, or a list of
    addresses of servers of the same model; null uses no server."""
    model: str | None = path(None)
    """Name of the model on the server."""
    concurrency: int = setting(128, least=1)
    """Number of concurrent requests, over all servers; 128 requests saturate one vLLM server."""
    timeout: float = setting(120.0, least=1)
    """Timeout of a request (s)."""
    unreachable_timeout: float = setting(600.0, least=0)
    """Time (s) after which the command gives up if no server has responded."""

    @property
    def urls(self) -> list[str]:
        """Addresses of the servers; empty if no server is used."""
        if self.url is None:
            return []
        return list(self.url) if isinstance(self.url, list) else [self.url]

    def find_problems(self, group: str) -> Iterator[str]:
        if self.url == []:
            yield f"{group}url=[] is empty: give an address, or null for no server"
        for url in self.urls:
            if not isinstance(url, str) or not is_url(url):
                yield f"{group}url={url} is not a URL, such as http://127.0.0.1:8000/v1"


@dataclass
class ServerConfig(ServersConfig):
    """Servers of the model to measure."""

    GROUP: ClassVar[str] = "server"

    model: str | None = path(None)
    """Name of the model or of an adapter on the server; null uses student.model."""
    concurrency: int = setting(32, least=1)
    """Number of concurrent requests, over all servers; each contains the frames of one item."""
    timeout: float = setting(600.0, least=1)
    """Timeout of a request (s); a response with thinking takes minutes."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        if self.model is not None and self.url is None:
            yield f"{group}model={self.model} without a server: give {group}url=..."


@dataclass
class TeacherServerConfig(ServersConfig):
    """Servers of the teacher of `train.distill`, which return the log-probabilities of prompts."""

    GROUP: ClassVar[str] = "teacher_server"

    model: str | None = path(None)
    """Name of the teacher on the server. It needs the student's tokenizer."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        if (self.model is None) != (self.url is None):
            given, missing = ("url", "model") if self.model is None else ("model", "url")
            yield (
                f"{group}{given}={getattr(self, given)} without {group}{missing}: give the address "
                "of the teacher's server and its name on it"
            )


@dataclass
class SamplingServerConfig(ServersConfig):
    """Servers that sample the responses of the student in training."""

    GROUP: ClassVar[str] = "sampling_server"

    model: str = "student"
    """Start of the names under which the servers load the student's adapters. Each step has a name
    of its own. The servers serve the student's base."""
    concurrency: int = setting(32, least=1)
    """Number of concurrent requests of each process; each contains the frames of one item."""
    timeout: float = setting(600.0, least=1)
    """Timeout of a request (s)."""


@dataclass
class TeacherConfig(ServersConfig):
    """The teacher: a model on servers or, without a server, the built-in narrator."""

    GROUP: ClassVar[str] = "teacher"

    name: str = MISSING
    """Name of the teacher, recorded with every rationale."""
    seed: int = setting(0, least=0)
    """Seed of the built-in narrator's choice of phrases. It is not sent to a server, but changing
    it requests every rationale again."""
    predicates: str = setting("paper", options=("paper", "relational"))
    """Vocabulary of the facts: that of the paper, or with relations between objects too."""
    grounding: str = setting("oracle", options=("oracle", "extrapolated", "shuffled"))
    """Facts of the rationales: those of the simulator; those of the same prefix with a future at
    constant velocity; or those of another scene. The answers are right in each case. Only the first
    are validated against the simulator's record."""
    sufficient: bool = False
    """Reject rationales whose prediction fits a distractor as well."""
    strict: bool = True
    """Reject rationales with a sentence that the reader of claims cannot read. Otherwise, nobody
    checks what such a sentence states."""
    min_words: int = NARRATOR_WORDS[0]
    """Minimum length of a rationale (words)."""
    max_words: int = NARRATOR_WORDS[1]
    """Maximum length of a rationale (words)."""
    attempts: int = setting(4, least=1)
    """Maximum number of responses for an item. If the validator rejects all of them, the item is
    set aside: it gets no rationale."""
    fallback: bool = False
    """Let the built-in narrator write the rationales of items that are set aside, and mark them."""
    samples: int = setting(3, least=1)
    """Number of responses per request for an item whose previous response was rejected."""
    temperature: float = setting(0.7, least=0)
    """Sampling temperature of the server's responses."""
    top_p: float = setting(0.8, above=0, most=1)
    """Sample from the smallest set of most likely tokens whose total probability reaches this."""
    top_k: int = setting(20, least=-1)
    """Sample from this number of most likely tokens."""
    max_tokens: int = setting(640, least=1)
    """Maximum length of a response (tokens)."""
    grammar: bool = False
    """Constrain the server's decoding to the form of a rationale."""
    form: str = setting("free", options=("free", "cited"))
    """Form of a server's responses: free text, or sentences with slots that code fills with the
    facts that they cite."""

    def find_problems(self, group: str) -> Iterator[str]:
        yield from super().find_problems(group)
        if (self.url is None) != (self.model is None):
            yield (
                f"{group}url={self.url} and {group}model={self.model}: set both, to use a server, "
                "or neither"
            )
        if not 0 < self.min_words <= self.max_words:
            yield (
                f"{group}min_words={self.min_words} and {group}max_words={self.max_words}: "
                "need 0 < min <= max"
            )
        shortest, longest = NARRATOR_WORDS
        if self.url is None and (self.min_words > shortest or self.max_words < longest):
            yield (
                f"{group}min_words={self.min_words} and {group}max_words={self.max_words}: the "
                f"built-in narrator writes {shortest} to {longest} words, so lower the minimum and "
                f"raise the maximum to these, or give {group}url"
            )
        if self.sufficient and self.grounding != "oracle":
            yield (
                f"{group}sufficient=true and {group}grounding={self.grounding}: only the facts of "
                f"the simulator can decide an item; set {group}sufficient=false"
            )
        for name in ("grammar", "fallback"):
            if getattr(self, name) and self.url is None:
                yield f"{group}{name}=true needs a server: give {group}url=..."
        if self.form == "cited" and self.url is None:
            yield f"{group}form=cited needs a server: give {group}url=..."
        if self.form == "cited" and self.grammar:
            yield (
                f"{group}form=cited and {group}grammar=true: cited responses have a JSON schema of "
                f"their own; leave out grammar, or set {group}form=free"
            )
