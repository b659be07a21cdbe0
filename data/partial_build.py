"""The folder beside a store that a build writes to, so that a killed build can resume."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from conf.errors import UserError
from conf.runs import flatten, wait_for_lock
from conf.schema import BenchmarkConfig
from data.records import SPLITS
from data.store import PLAN, write_atomically
from data.world.standins import generator_version

SCENE_SETTINGS = (
    "simulator", "standin", "seed", "test_share", "min_objects", "max_objects", "max_collisions",
    "fps",
)  # fmt: skip
"""Settings that determine the scenes. The file name of any other part is a hash of its settings."""


@contextmanager
def lock_partial_build(cfg: BenchmarkConfig, folder: Path) -> Iterator[Path | None]:
    """Lock the folder beside `folder` that a build writes to; wait while another process has it.

    Yields:
        The folder, or None if the other process has completed `folder` meanwhile.

    Raises:
        UserError: the folder holds an unfinished build with other settings.
    """
    partial = folder.with_name(f".{folder.name}.partial")
    partial.mkdir(parents=True, exist_ok=True)
    plan = {
        "generator": generator_version(cfg.standin),
        "benchmark": {key: getattr(cfg, key) for key in SCENE_SETTINGS},
        "counterfactual scenes": {
            split: getattr(cfg.retrieval.counterfactual, split) > 0 for split in SPLITS
        },
    }
    handle = os.open(partial, os.O_RDONLY)
    try:
        wait_for_lock(handle, f"{folder} is being built by another process")
        if folder.exists():
            shutil.rmtree(partial, ignore_errors=True)
            yield None
            return
        if (partial / PLAN).exists():
            # Scenes take hours to simulate, so a changed setting does not discard them silently.
            check_same_settings(json.loads((partial / PLAN).read_text()), plan, partial)
        for leftover in partial.rglob(".*.partial"):
            leftover.unlink()
        write_atomically(partial / PLAN, json.dumps(plan).encode())
        yield partial
    finally:
        os.close(handle)


def check_same_settings(old: dict[str, Any], new: dict[str, Any], folder: Path) -> None:
    """Raises UserError where a key differs between the nested settings of two builds."""
    before, after = (
        {key: value for key, value in flatten(settings).items() if value != {}}
        for settings in (old, new)
    )
    for key in before | after:
        if before.get(key) != after.get(key):
            raise UserError(
                f"{folder} was built with {key}={before.get(key)}, but the command has "
                f"{after.get(key)}: use the earlier setting, choose another name with "
                f"benchmark.name=NAME, or delete {folder}",
                code="different-settings",
            )
