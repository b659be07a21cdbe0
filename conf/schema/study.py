"""Settings of the human study and of its export."""

from __future__ import annotations

from dataclasses import dataclass
from urllib.parse import urlsplit

from omegaconf import MISSING

from conf.schema.benchmark import BenchmarkConfig
from conf.schema.checks import check_minimum, check_run, is_url
from conf.schema.commands import CommandConfig


@dataclass
class StudyCommand(CommandConfig):
    benchmark: BenchmarkConfig = MISSING
    items: str = "60"
    """Number of test items, sampled evenly from the families; or a file of items, with one item_id
    or one JSON object with an item_id per line."""
    annotators: int = 3
    """Number of annotators, each with a personal link; each of them answers every item."""
    practice: int = 3
    """Practice items from the training split, which each annotator answers first, with feedback and
    without a score."""
    rest_every: int = 20
    """Items after which an annotator is offered a break."""
    seed: int = 0
    """Seed of the sample of items and of each annotator's order of items and candidates."""
    host: str = "127.0.0.1"
    """Network address at which the server listens; 0.0.0.0 (all addresses) also needs `public`."""
    port: int = 8765
    """Port at which the server listens."""
    public: str | None = None
    """Address at which annotators reach the study, such as https://study.example.org behind a
    proxy; null uses host and port."""

    @property
    def address(self) -> str:
        """Beginning of the annotators' links."""
        host = f"[{self.host}]" if ":" in self.host else self.host
        return (self.public or f"http://{host}:{self.port}").rstrip("/")

    def check(self) -> list[str]:
        least = {"annotators": 1, "practice": 0, "rest_every": 1}
        problems = super().check() + check_minimum(self, "", least)
        if not self.items or (self.items.isdecimal() and int(self.items) == 0):
            problems.append(f"items={self.items} selects no item: give a number or a file")
        if not 0 < self.port < 65536:
            problems.append(f"port={self.port} is not a port: give a number from 1 to 65535")
        if self.public is None and self.host in ("0.0.0.0", "::"):
            problems.append(
                f"host={self.host} is not an address that annotators can open: give "
                "public=ADDRESS, such as https://study.example.org"
            )
        if self.public is not None and not _is_root(self.public):
            problems.append(
                f"public={self.public} is not the URL of a host, such as https://study.example.org"
            )
        return problems


@dataclass
class ExportStudyCommand(CommandConfig):
    run: str = "default"
    """Run of evaluation.study to export: its name or its folder."""

    def check(self) -> list[str]:
        return super().check() + check_run(self.run, f"{self.checkpoints}/study")


def _is_root(url: str) -> bool:
    return is_url(url) and urlsplit(url).netloc != "" and urlsplit(url).path in ("", "/")
