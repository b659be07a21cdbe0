"""OpenAI-compatible servers, and how they are asked."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, ClassVar

from conf.schema.checks import is_url, too_small


@dataclass
class ServersConfig:
    """What every group of servers takes."""

    GROUP: ClassVar[str]

    url: Any = None
    """An OpenAI-compatible server, such as http://127.0.0.1:8000/v1, or a list of several that
    serve the same model; null for none."""
    model: str | None = None
    """The model's name at the server."""
    concurrency: int = 128
    """Requests in flight, over all servers; 128 keep one busy."""
    timeout: float = 120.0
    """Seconds that one request may take."""
    patience: float = 600.0
    """Seconds to wait while no server can be asked before giving up."""

    @property
    def urls(self) -> list[str]:
        """The servers' addresses; none where there is no server."""
        if self.url is None:
            return []
        return list(self.url) if isinstance(self.url, list) else [self.url]

    def check(self) -> list[str]:
        group = self.GROUP
        problems = too_small(self, f"{group}.", {"concurrency": 1, "timeout": 1, "patience": 0})
        if self.url == []:
            problems.append(f"{group}.url=[] names no server: give one, or null for none")
        for url in self.urls:
            if not isinstance(url, str) or not is_url(url):
                problems.append(
                    f"{group}.url={url} is no address of a server, such as http://127.0.0.1:8000/v1"
                )
        return problems


@dataclass
class ServerConfig(ServersConfig):
    """Servers of a model that is measured."""

    GROUP: ClassVar[str] = "server"

    model: str | None = None
    """The model's name at the server, or that of an adapter that it has; null takes
    student.model."""
    concurrency: int = 32
    """Requests in flight, over all servers; each holds an item's frames."""
    timeout: float = 600.0
    """Seconds that one request may take; thinking takes minutes."""

    def check(self) -> list[str]:
        problems = super().check()
        if self.model is not None and self.url is None:
            problems.append(f"server.model={self.model} needs server.url=...")
        return problems


@dataclass
class ImageServerConfig(ServersConfig):
    """Servers that draw images of texts (/v1/images/generations, as vLLM-Omni has it)."""

    GROUP: ClassVar[str] = "images"

    concurrency: int = 4
    """Images in the making, over all servers."""
    timeout: float = 600.0
    """Seconds that one image may take."""
    size: str = "480x320"
    """Width and height in px of an image; it is then shown to the matcher as frames are."""
    seed: int = 0
    """Of every image: the same text gives the same one."""

    def check(self) -> list[str]:
        problems = super().check() + too_small(self, "images.", {"seed": 0})
        if not re.fullmatch(r"[1-9]\d*x[1-9]\d*", self.size):
            problems.append(f"images.size={self.size} is no size in px, such as 480x320")
        return problems
