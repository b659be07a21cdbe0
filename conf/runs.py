"""A run's folder: its name, what is written into it, and whether it can be gone on with."""

from __future__ import annotations

import fcntl
import hashlib
import json
import logging
import os
import platform
import re
import subprocess
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from omegaconf import OmegaConf

from conf.errors import SettingsError, UserError

log = logging.getLogger(__name__)

RESULT_NEUTRAL_KEYS = (
    "run",
    "store",
    "checkpoints",
    "workers",
    "train.workers",
    "host",
    "port",
    "public",
)
"""Keys that say where and how fast a run goes, not what comes out of it."""

BOOKKEEPING_FILES = {"config.yaml", "run.json", "run.log", "output.log", "job.json"}
"""Files of a run's folder before the command makes any."""

TRAINER_FOLDERS = {"student": "sft", "retriever": "contrastive"}
"""The folders of runs below checkpoints/, by what they train."""

PACKAGES = (
    "torch",
    "transformers",
    "peft",
    "bitsandbytes",
    "accelerate",
    "sentence-transformers",
    "trl",
    "hydra-core",
    "omegaconf",
    "numpy",
    "pybullet",
)


@dataclass(frozen=True)
class Run:
    name: str
    """Of the folder below checkpoints/<command>/, such as exp-cot."""
    folder: Path
    overrides: tuple[str, ...] = ()
    """What was typed, such as train.lr=1e-4."""


def rank() -> int:
    """Which of the ranks this process is that a launcher such as torchrun started; 0, the main one,
    prepares, logs and writes for all."""
    return int(os.environ["RANK"]) if "LOCAL_RANK" in os.environ else 0


def world_size() -> int:
    """How many ranks a launcher started; 1 without one."""
    return int(os.environ["WORLD_SIZE"]) if "LOCAL_RANK" in os.environ else 1


def local_world_size() -> int:
    """How many of the ranks share this machine."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", 1)) if "LOCAL_RANK" in os.environ else 1


def run_name(run: str | None, overrides: Sequence[str]) -> str:
    """The given name, or one of the overrides, in whichever order they were typed."""
    if run is not None:
        return run
    # Of two values of one key the later holds.
    told = sorted((o.lstrip("+") for o in overrides), key=_key)
    told = [o for o in told if _key(o) not in RESULT_NEUTRAL_KEYS]
    # Only what can be typed after model= as it stands: "=" and "," mean something there.
    name = re.sub(r"[^A-Za-z0-9_.+-]", "-", "+".join(told)) or "default"
    if len(name) > 120:
        digest = hashlib.sha256(name.encode()).hexdigest()[:8]
        name = f"{name[:111]}-{digest}"
    return name


def _key(override: str) -> str:
    return override.partition("=")[0]


def resolve_run_name(run: str, folder: str) -> str:
    """The name of the run in `folder` that is given by its name or by its own folder."""
    return os.path.relpath(run, folder) if is_inside(run, folder) else os.path.normpath(run)


def is_inside(path: str, folder: str) -> bool:
    return not os.path.relpath(path, folder).startswith("..")


def runs_folder(checkpoints: str, product: str) -> str:
    """The folder of the runs that train a product, student or retriever."""
    return f"{checkpoints}/{TRAINER_FOLDERS.get(product, product)}"


def is_run_name(run: str) -> bool:
    """Whether a run's name leads to a folder below another one; a sweep's job is SWEEP/NUMBER."""
    return not os.path.isabs(run) and run.split(os.sep)[0] not in (".", "..")


def finished_metrics(run: Run) -> dict[str, float] | None:
    """The metrics of a run that has ended; None while there is something left to do."""
    path = run.folder / "metrics.json"
    return json.loads(path.read_text()) if path.exists() else None


OmegaConf.register_new_resolver("run_name", run_name, replace=True)
OmegaConf.register_new_resolver("resolve_run_name", resolve_run_name, replace=True)
OmegaConf.register_new_resolver("runs_folder", runs_folder, replace=True)


def open_run(run: Run, settings: dict[str, Any], command: str, overrides: list[str]) -> None:
    """Write a run's settings and record, first or again. A run that ended before it had made
    anything may be started with other settings.

    Raises SettingsError where the folder holds a run with other settings, and UserError where it
    cannot be written.
    """
    if other := differences(run.folder, settings):
        if {path.name for path in run.folder.iterdir()} - BOOKKEEPING_FILES:
            raise SettingsError(
                f"{run.folder} holds a run with other settings: {'; '.join(other[:3])}. "
                "Choose another folder with run=NAME, or delete this one."
            )
        (run.folder / "run.json").unlink(missing_ok=True)
    try:
        run.folder.mkdir(parents=True, exist_ok=True)
        write_text(run.folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(settings)))
        write_json(run.folder / "run.json", _record(run.folder, settings, command, overrides))
    except OSError as error:
        raise UserError(f"cannot write the run's folder {run.folder}: {error.strerror}") from error


@contextmanager
def lock_folder(folder: Path, otherwise: str) -> Iterator[None]:
    """Hold a folder against other processes.

    Raises:
        UserError: another process holds it; `otherwise` says so.
    """
    handle = os.open(folder, os.O_RDONLY)
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError as error:
        os.close(handle)
        raise UserError(otherwise) from error
    try:
        yield
    finally:
        os.close(handle)


def wait_for_lock(handle: int, busy: str) -> None:
    """Hold an open file or folder against other processes, once the one that has it is done; `busy`
    says that one has. It is held until it is closed."""
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        log.info("%s; waiting for it", busy)
        fcntl.flock(handle, fcntl.LOCK_EX)


def differences(folder: Path, settings: dict[str, Any]) -> list[str]:
    """Each setting that a run in `folder` was started with and that is another one now."""
    path = folder / "config.yaml"
    if not path.exists():
        return []
    there = _flat(OmegaConf.to_container(OmegaConf.load(path)))
    now = _flat(settings)
    absent = object()
    return [
        f"{key} is {_shown(there, key)} there and {_shown(now, key)} now"
        for key in sorted(there.keys() | now.keys())
        if key not in RESULT_NEUTRAL_KEYS and there.get(key, absent) != now.get(key, absent)
    ]


def write_json(path: Path, value: Any) -> None:
    """Write JSON with sorted keys, whole or not at all."""
    write_text(path, json.dumps(value, indent=2, sort_keys=True) + "\n")


def write_text(path: Path, text: str) -> None:
    """Write a text file, whole or not at all."""
    part = path.with_name(path.name + ".tmp")
    part.write_text(text, encoding="utf-8")
    os.replace(part, path)


def _flat(value: Any, key: str = "") -> dict[str, Any]:
    if not isinstance(value, dict) or not value:
        return {key: value}
    return {
        k: v for name, inner in value.items() for k, v in _flat(inner, _join(key, name)).items()
    }


def _join(key: str, name: Any) -> str:
    return f"{key}.{name}" if key else str(name)


def _shown(flat: dict[str, Any], key: str) -> str:
    return json.dumps(flat[key]) if key in flat else "absent"


def _record(
    folder: Path, settings: dict[str, Any], command: str, overrides: list[str]
) -> dict[str, Any]:
    path = folder / "run.json"
    earlier = json.loads(path.read_text(encoding="utf-8")) if path.exists() else None
    return {
        "command": command,
        "overrides": overrides,
        "seeds": {k: v for k, v in _flat(settings).items() if k.rpartition(".")[2] == "seed"},
        "ranks": world_size(),
        "git": _git(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": {name: v for name in PACKAGES if (v := _version(name))},
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "earlier_starts": [*earlier["earlier_starts"], earlier["started"]] if earlier else [],
    }


def run_id(run: Run) -> str:
    """A name of a run that no other has, and that it keeps when it goes on: by its folder and when
    it was first started."""
    record = json.loads((run.folder / "run.json").read_text(encoding="utf-8"))
    first = [*record["earlier_starts"], record["started"]][0]
    return hashlib.sha256(f"{run.folder.resolve()} {first}".encode()).hexdigest()[:16]


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None


def _git() -> dict[str, Any] | None:
    """The commit that the code stands at, and whether it was changed since; None outside git."""
    try:
        commit = _git_output("rev-parse", "HEAD")
        return {"commit": commit, "dirty": bool(_git_output("status", "--porcelain"))}
    except (OSError, subprocess.CalledProcessError):
        return None


def _git_output(*arguments: str) -> str:
    return subprocess.run(
        ["git", *arguments],
        cwd=Path(__file__).parent,
        capture_output=True,
        text=True,
        check=True,
    ).stdout.strip()
