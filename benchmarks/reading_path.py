"""Lists the files that a reader follows from `data.build`'s main function to a selection item.

    python -m benchmarks.reading_path

Builds a small benchmark in one process, and prints the files of the project in which a function is
executed until `selection.parquet` is written, in the order of the first execution.
"""

from __future__ import annotations

import sys
import tempfile
from collections.abc import Iterator, Mapping
from pathlib import Path
from types import FrameType
from typing import Any
from unittest.mock import patch

from dynapix.conf.compose import compose
from dynapix.conf.entry import Run
from dynapix.conf.schema import BuildCommand
from dynapix.data import build
from dynapix.data.parallel import Job, Workers
from dynapix.data.store import save_rows

ROOT = Path(__file__).resolve().parent.parent
SETTINGS = (
    "benchmark=tiny", "benchmark.scenes=60", "frames=none", "workers=1",
    *(f"benchmark.retrieval.builders.{k}={{train:0,test:0}}" for k in range(1, 7)),
    "benchmark.retrieval.counterfactual={train:0,test:0}",
)  # fmt: skip
"""A benchmark without queries. Its scenes do not suffice for all quotas."""


def run_inline(_: Workers, jobs: Mapping[str, Job], *rest: Any) -> Iterator[tuple[str, Any]]:
    """Replace `Workers.run`: run the jobs in this process, where they can be traced."""
    return ((name, job()) for name, job in jobs.items())


def list_files(settings: tuple[str, ...]) -> list[str]:
    """Return the files in which a function is executed, as paths relative to the project."""
    files: dict[str, None] = {}

    def record(frame: FrameType, event: str, _: Any) -> None:
        code = frame.f_code
        if event == "call" and code.co_name != "<module>":
            files[code.co_filename] = None
        if code is save_rows.__code__ and event == "return":
            sys.setprofile(None)

    with tempfile.TemporaryDirectory() as folder:
        cfg = compose("data.build", BuildCommand, [*settings, f"store={folder}"])
        with patch.object(Workers, "run", run_inline):
            sys.setprofile(record)
            build.main.__wrapped__(cfg, Run("walk", Path(folder)))
    inside = (Path(name) for name in files if name.startswith(str(ROOT)) and ".venv" not in name)
    return [path.relative_to(ROOT).as_posix() for path in inside if path != Path(__file__)]


if __name__ == "__main__":
    names = list_files(SETTINGS)
    print(*names, f"{len(names)} files", sep="\n")
