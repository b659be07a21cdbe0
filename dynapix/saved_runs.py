"""Write a result of the library as a run that `python -m evaluation.report` shows."""

from __future__ import annotations

import json
from collections.abc import Iterator
from contextlib import contextmanager
from datetime import UTC, datetime
from pathlib import Path

from dynapix.conf.errors import UserError
from dynapix.conf.files import write_json, write_text
from dynapix.data.store import Store


@contextmanager
def saved_run(
    folder: Path, store: Store, kind: str, name: str, seed: int, metrics: dict[str, float]
) -> Iterator[None]:
    """Write the record and the settings of a run; the block writes its results.

    Args:
        kind: The command whose files the run has: select, similarity or retrieve.
        name: The model's name.
        metrics: Content of metrics.json, which is written last: a run without it is unfinished.

    Raises:
        UserError: The folder exists and contains something else.
    """
    if folder.exists() and any(folder.iterdir()) and not (folder / "run.json").exists():
        raise UserError(f"{folder} contains other files: choose a new folder", code="other-files")
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "metrics.json").unlink(missing_ok=True)
    settings = {"benchmark": store.manifest["config"], "model": None}
    write_text(folder / "config.yaml", json.dumps(settings, indent=1) + "\n")
    started = datetime.now(UTC).isoformat(timespec="seconds")
    command = "dynapix.evaluate_retrieval" if kind == "retrieve" else "dynapix.evaluate"
    record = {"command": command, "kind": kind, "name": name, "seed": seed}
    write_json(folder / "run.json", {**record, "started": started, "earlier_starts": []})
    yield
    write_json(folder / "metrics.json", metrics)
