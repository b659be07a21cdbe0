"""Settings of OpenAI-compatible servers and of their clients."""

from __future__ import annotations

import re
from dataclasses import dataclass
from typing import Any, ClassVar

from conf.schema.checks import check_minimum, is_url


@dataclass
class ServersConfig:
    """Settings that every group of servers has."""

    GROUP: ClassVar[str]

    url: Any = None
    """Address of an OpenAI-compatible server, such as http://127.0.0.1:8000/v1, or a list of
    servers of the same model; null uses no server."""
    model: str | None = None
    """Name of the model on the server."""
    concurrency: int = 128
    """Concurrent requests over all servers; 128 requests saturate one vLLM server."""
    timeout: float = 120.0
    """Timeout of a request (s)."""
    patience: float = 600.0
    """Time (s) without any reachable server after which the command gives up."""

    @property
    def urls(self) -> list[str]:
        """Addresses of the servers; empty without a server."""
        if self.url is None:
            return []
        return list(self.url) if isinstance(self.url, list) else [self.url]

    def check(self) -> list[str]:
        group = self.GROUP
        problems = check_minimum(self, f"{group}.", {"concurrency": 1, "timeout": 1, "patience": 0})
        if self.url == []:
            problems.append(f"{group}.url=[] is empty: give an address, or null for no server")
        for url in self.urls:
            if not isinstance(url, str) or not is_url(url):
                problems.append(f"{group}.url={url} is not a URL, such as http://127.0.0.1:8000/v1")
        return problems


@dataclass
class ServerConfig(ServersConfig):
    """Servers of the model to measure."""

    GROUP: ClassVar[str] = "server"

    model: str | None = None
    """Name of the model or of an adapter on the server; null uses student.model."""
    concurrency: int = 32
    """Concurrent requests over all servers; each contains the frames of an item."""
    timeout: float = 600.0
    """Timeout of a request (s); a response with thinking takes minutes."""

    def check(self) -> list[str]:
        problems = super().check()
        if self.model is not None and self.url is None:
            problems.append(f"server.model={self.model} without a server: give server.url=...")
        return problems


@dataclass
class ImageServerConfig(ServersConfig):
    """Servers that generate images from text (/v1/images/generations, as in vLLM-Omni)."""

    GROUP: ClassVar[str] = "images"

    concurrency: int = 4
    """Concurrent requests over all servers."""
    timeout: float = 600.0
    """Timeout of a request (s)."""
    size: str = "480x320"
    """Width x height (px) of a generated image, before it is preprocessed like a frame."""
    seed: int = 0
    """Seed of every image, so that the same text gives the same image."""

    def check(self) -> list[str]:
        problems = super().check() + check_minimum(self, "images.", {"seed": 0})
        if not re.fullmatch(r"[1-9]\d*x[1-9]\d*", self.size):
            problems.append(f"images.size={self.size} is not a size in px, such as 480x320")
        return problems
