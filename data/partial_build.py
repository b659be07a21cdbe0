"""The folder beside a store that a build writes to, so that a killed build can resume."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Collection, Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from conf.errors import UserError
from conf.runs import wait_for_lock
from conf.schema import BenchmarkConfig
from data.records import SPLITS
from data.store import PLAN, write_atomically
from data.world.standins import generator_version

SCENE_SETTINGS = (
    "simulator",
    "standin",
    "seed",
    "test_share",
    "min_objects",
    "max_objects",
    "max_collisions",
    "fps",
)
"""Settings that scenes depend on. Other parts have a name that depends on their settings."""


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
    plan = _plan(cfg)
    handle = os.open(partial, os.O_RDONLY)
    try:
        wait_for_lock(handle, f"{folder} is being built by another process")
        if folder.exists():
            shutil.rmtree(partial, ignore_errors=True)
            yield None
            return
        if (partial / PLAN).exists():
            _check_same_plan(json.loads((partial / PLAN).read_text()), plan, partial)
        for leftover in partial.rglob(".*.partial"):
            leftover.unlink()
        write_atomically(partial / PLAN, json.dumps(plan).encode())
        yield partial
    finally:
        os.close(handle)


def _plan(cfg: BenchmarkConfig) -> dict[str, Any]:
    absent = {split: getattr(cfg.retrieval.counterfactual, split) > 0 for split in SPLITS}
    return {
        "generator": generator_version(cfg.standin),
        "benchmark": {key: getattr(cfg, key) for key in SCENE_SETTINGS},
        "counterfactual scenes": absent,
    }


def _check_same_plan(old: dict[str, Any], new: dict[str, Any], partial: Path) -> None:
    """Scenes take hours to simulate, so a changed setting does not discard them silently."""
    if change := find_change(old, new):
        key, started, requested = change
        raise UserError(
            f"{partial} holds an unfinished build with {key}={started}, but the command has "
            f"{requested}: resume that build with its setting, choose another name with "
            f"benchmark.name=NAME, or delete {partial}",
            code="different-settings",
        )


def find_change(
    old: dict[str, Any], new: dict[str, Any], ignored: Collection[str] = ()
) -> tuple[str, Any, Any] | None:
    """The first dotted key whose value differs between nested settings, with both values."""
    before, after = _flatten(old), _flatten(new)
    for key in before | after:
        if key not in ignored and before.get(key) != after.get(key):
            return key, before.get(key), after.get(key)
    return None


def _flatten(settings: dict[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted key."""
    flat: dict[str, Any] = {}
    for key, value in settings.items():
        name = f"{prefix}{key}"
        flat |= _flatten(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return flat
