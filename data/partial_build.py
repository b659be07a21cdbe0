"""The folder that a build fills beside a store, so that a killed one goes on with what it has."""

from __future__ import annotations

import json
import os
import shutil
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

from conf.errors import UserError
from conf.runs import wait_for_lock
from conf.schema import BenchmarkConfig
from data.records import SPLITS
from data.store import PLAN, write_atomically
from data.world.standins import generator_version


@contextmanager
def lock_partial_build(cfg: BenchmarkConfig, folder: Path) -> Iterator[Path | None]:
    """The folder beside `folder` that a build fills, held by this process alone; while another
    process holds it, this one waits. None where that one has built `folder` meanwhile.

    Raises:
        UserError: a build of other settings was left there.
    """
    growing = folder.with_name(f".{folder.name}.partial")
    growing.mkdir(parents=True, exist_ok=True)
    plan = _plan(cfg)
    handle = os.open(growing, os.O_RDONLY)
    try:
        wait_for_lock(handle, f"{folder} is being built by another process")
        if folder.exists():
            shutil.rmtree(growing, ignore_errors=True)
            yield None
            return
        if (growing / PLAN).exists():
            _check_same_plan(json.loads((growing / PLAN).read_text()), plan, growing)
        for leftover in growing.rglob(".*.partial"):
            leftover.unlink()
        write_atomically(growing / PLAN, json.dumps(plan).encode())
        yield growing
    finally:
        os.close(handle)


def _plan(cfg: BenchmarkConfig) -> dict[str, Any]:
    """What the scenes of a build depend on; its other parts are named by what they depend on."""
    keys = (
        "simulator",
        "standin",
        "seed",
        "test_share",
        "min_objects",
        "max_objects",
        "max_collisions",
        "fps",
    )
    absent = {split: getattr(cfg.retrieval.counterfactual, split) > 0 for split in SPLITS}
    return {
        "generator": generator_version(cfg.standin),
        "config": {key: getattr(cfg, key) for key in keys},
        "counterfactual scenes": absent,
    }


def _check_same_plan(there: dict[str, Any], plan: dict[str, Any], growing: Path) -> None:
    """Scenes that took hours are not thrown away for a changed setting."""
    was, now = flatten(there), flatten(plan)
    for key in was | now:
        if was.get(key) != now.get(key):
            name = key.replace("config.", "benchmark.", 1)
            raise UserError(
                f"{growing} holds an unfinished build with {name}={was.get(key)}, you ask for "
                f"{now.get(key)}: go on with that one, choose another name with "
                f"benchmark.name=NAME, or delete {growing}"
            )


def flatten(config: dict[str, Any], above: str = "") -> dict[str, Any]:
    """Nested settings by dotted key."""
    found: dict[str, Any] = {}
    for key, value in config.items():
        name = f"{above}{key}"
        found |= flatten(value, f"{name}.") if isinstance(value, dict) else {name: value}
    return found
