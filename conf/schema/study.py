"""What the human study and its export take."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import urlsplit

from omegaconf import MISSING

from conf.runs import is_run_name, resolve_run_name
from conf.schema.benchmark import BenchmarkConfig
from conf.schema.checks import is_url, too_small
from conf.schema.commands import CommandConfig


@dataclass
class StudyCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    items: str = "60"
    """How many test items are asked, drawn evenly from the families; or a file that names them, one
    item_id a line or one JSON object with an item_id a line."""
    annotators: int = 3
    """Who answers, each by a link of their own; every item is to get as many answers."""
    practice: int = 3
    """Items of the training split that each annotator answers first, with feedback and unscored."""
    rest_every: int = 20
    """Items after which an annotator is offered a break."""
    seed: int = 0
    """Of the draw of items, and of each annotator's order of items and candidates."""
    host: str = "127.0.0.1"
    """Address that the server listens at; 0.0.0.0 for all of this machine's, with public=."""
    port: int = 8765
    public: str | None = None
    """Where annotators reach it, such as https://study.example.org behind a proxy; null takes host
    and port."""

    @property
    def address(self) -> str:
        """What links begin with."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return (self.public or f"http://{host}:{self.port}").rstrip("/")

    def check(self) -> list[str]:
        least = {"annotators": 1, "practice": 0, "rest_every": 1}
        problems = super().check() + too_small(self, "", least)
        if not self.items or (self.items.isdecimal() and int(self.items) == 0):
            problems.append(f"items={self.items} asks nothing: give a number or a file")
        if not 0 < self.port < 65536:
            problems.append(f"port={self.port} is no port: give one of 1 to 65535")
        if self.public is None and self.host in ("0.0.0.0", "::"):
            problems.append(
                f"host={self.host} does not say where annotators reach the study: give public=, "
                "such as https://study.example.org"
            )
        if self.public is not None and not _is_root(self.public):
            problems.append(
                f"public={self.public} is no address of a host, such as https://study.example.org"
            )
        return problems


@dataclass
class ExportStudyCommand(CommandConfig):
    run: str = "default"
    """The run of evaluation.study whose votes are exported: its name or its folder."""

    def check(self) -> list[str]:
        problems = super().check()
        runs = f"{self.checkpoints}/study"
        if not is_run_name(resolve_run_name(self.run, runs)):
            problems.append(
                f"run={self.run} is no run below {runs}: name one that is there, and give "
                "checkpoints=FOLDER where the runs are elsewhere"
            )
        return problems


def _is_root(url: str) -> bool:
    return is_url(url) and urlsplit(url).netloc != "" and urlsplit(url).path in ("", "/")
