"""The folder of a run: its name, its records, its lock, and whether the run can be resumed."""

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
from contextlib import contextmanager, nullcontext, suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from dynapix.conf.errors import SettingsError, UserError
from dynapix.conf.files import expand_path, read_json, write_json, write_text

log = logging.getLogger(__name__)

RESULT_NEUTRAL_KEYS = {
    "run", "store", "checkpoints", "workers", "train.workers", "host", "port", "public",
    "train.report_to", "teacher_server.url", "sampling_server.url", "sampling_server.model",
    "train.micro_batch", "train.mini_batch", "train.sampling_batch", "train.reuse_features",
    "train.gradient_checkpointing", "batch", "matcher.batch",
    *(
        f"{servers}.{setting}"
        for servers in ("server", "teacher", "teacher_server", "sampling_server")
        for setting in ("concurrency", "timeout", "unreachable_timeout")
    ),
}  # fmt: skip
"""Keys that do not change the result of a run, or only by rounding (with dropout, the micro-batches
also determine the random numbers). Their values may differ when a run is resumed, and they are not
part of the run's name."""

LOCK = ".lock"
"""Name of the file that is locked while a process uses a folder."""

BOOKKEEPING_FILES = {"config.yaml", "run.json", "run.log", "output.log", "job.json", LOCK}
"""Files that may exist in a run's folder before the command writes its first result."""

TRAINER_FOLDERS = {"student": "sft", "retriever": "contrastive"}
"""Folder below checkpoints/ of the training runs that have each product (trained model)."""

CONTINUATIONS = ("distill", "reinforce")
"""Folders below checkpoints/ of the runs that train the student of another run further."""

PACKAGES = (
    "torch", "transformers", "peft", "bitsandbytes", "accelerate", "sentence-transformers",
    "trl", "hydra-core", "omegaconf", "numpy", "pybullet",
)  # fmt: skip
"""Packages whose versions run.json records."""


@dataclass(frozen=True)
class Run:
    name: str
    """Name of the folder below checkpoints/<command>/, such as exp-cot."""
    folder: Path
    overrides: tuple[str, ...] = ()
    """Overrides of the command line, such as train.lr=1e-4."""


def rank() -> int:
    """Return the rank of this process under a launcher such as torchrun; 0 without a launcher.

    Rank 0 is the main rank, which prepares, logs and writes for all ranks.
    """
    return int(os.environ["RANK"]) if _has_launcher() else 0


def world_size() -> int:
    """Return the number of ranks that a launcher started; 1 without a launcher."""
    return int(os.environ["WORLD_SIZE"]) if _has_launcher() else 1


def local_world_size() -> int:
    """Return the number of ranks on this machine; 1 without a launcher."""
    return int(os.environ.get("LOCAL_WORLD_SIZE", 1)) if _has_launcher() else 1


def _has_launcher() -> bool:
    names = ("LOCAL_RANK", "RANK", "WORLD_SIZE")
    return all(os.environ.get(name, "").isdecimal() for name in names)


def run_name(run: str | None, overrides: Sequence[str]) -> str:
    """Return `run` if it is set; otherwise a name built from the overrides. The order of the keys
    does not matter."""
    if run is not None:
        return run
    # If a key occurs twice, its last value takes effect; the stable sort keeps their order.
    ordered = sorted((o.lstrip("+") for o in overrides), key=_key)
    ordered = [o for o in ordered if _key(o) not in RESULT_NEUTRAL_KEYS]
    # Keep only characters that need no quotes in an override such as model=NAME.
    name = re.sub(r"'([A-Za-z0-9_.+-]+)'", r"\1", "+".join(ordered))
    name = re.sub(r"[^A-Za-z0-9_.+-]", "-", name) or "default"
    if len(name) > 120:
        digest = hashlib.sha256(name.encode()).hexdigest()[:8]
        name = f"{name[:111]}-{digest}"
    return name


def _key(override: str) -> str:
    return override.partition("=")[0]


def resolve_run_name(run: str, folder: str) -> str:
    """Return the name of a run in `folder`; `run` is either this name or the path of the run's
    folder."""
    run, folder = expand_path(run), expand_path(folder)
    return os.path.relpath(run, folder) if is_inside(run, folder) else os.path.normpath(run)


def is_inside(path: str, folder: str) -> bool:
    """Return whether `path` is `folder` or below it."""
    return bool(path) and not os.path.relpath(path, folder).startswith("..")


def runs_folder(checkpoints: str, product: str, run: str = "") -> str:
    """Return the folder to which the names of the runs that train a product (student or retriever)
    are relative. If `run` is the folder of a run of train.distill or train.reinforce, this is
    `checkpoints`, so that the run's name begins with "distill/" or "reinforce/"."""
    checkpoints, run = expand_path(checkpoints), expand_path(run)
    if product == "student" and any(is_inside(run, f"{checkpoints}/{f}") for f in CONTINUATIONS):
        return checkpoints
    return f"{checkpoints}/{TRAINER_FOLDERS.get(product, product)}"


def read_finished_metrics(run: Run) -> dict[str, float] | None:
    """Return the metrics of a run that is finished, and log how to train again; otherwise None."""
    path = run.folder / "metrics.json"
    if not path.exists():
        return None
    log.info("%s is finished; to train again, delete it or give run=NAME", run.folder)
    return read_json(path)


def open_run(run: Run, settings: dict[str, Any], command: str) -> None:
    """Write the settings (config.yaml) and the record (run.json) of a run that starts or resumes.

    A folder without results may be reused with other settings; its record then starts again.

    Raises:
        SettingsError: The folder contains results of a run with other settings.
    """
    from omegaconf import OmegaConf

    if other := changed_settings(run.folder, settings):
        if {path.name for path in run.folder.iterdir()} - BOOKKEEPING_FILES:
            raise other_settings_error(f"{run.folder} contains a run", other)
        (run.folder / "run.json").unlink(missing_ok=True)
    run.folder.mkdir(parents=True, exist_ok=True)
    write_text(run.folder / "config.yaml", OmegaConf.to_yaml(OmegaConf.create(settings)))
    path = run.folder / "run.json"
    earlier = read_json(path) if path.exists() else None
    record = {
        "command": command,
        "overrides": list(run.overrides),
        "seeds": {k: v for k, v in flatten(settings).items() if k.rpartition(".")[2] == "seed"},
        "ranks": world_size(),
        "git": _git(),
        "python": platform.python_version(),
        "platform": platform.platform(),
        "packages": _installed_versions(),
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "earlier_starts": [*earlier["earlier_starts"], earlier["started"]] if earlier else [],
    }
    write_json(path, record)


def other_settings_error(subject: str, changes: Sequence[str]) -> SettingsError:
    """Return an error for results with other settings; `subject` is a clause like "FOLDER contains
    a run"."""
    return SettingsError(
        f"{subject} with other settings: {'; '.join(changes[:3])}. Choose another folder with "
        "run=NAME, or delete this one.",
        code="other-settings",
    )


@contextmanager
def lock_folder(folder: Path, busy: str) -> Iterator[None]:
    """Hold an exclusive lock on a folder during the block; the lock is the file `.lock` in it. The
    main rank holds it for all ranks.

    Raises:
        UserError: Another process holds the lock; `busy` is the message.
    """
    with nullcontext() if rank() > 0 else lock_file(folder / LOCK, busy):
        yield


@contextmanager
def lock_file(path: Path, busy: str, wait: bool = False) -> Iterator[None]:
    """Hold an exclusive lock on a file during the block; create it if it is missing.

    The file is opened for writing, because NFS locks no other files exclusively.

    Args:
        wait: Log `busy` and wait while another process holds the lock.

    Raises:
        UserError: Another process holds the lock, and `wait` is not set; `busy` is the message.
    """
    path.parent.mkdir(parents=True, exist_ok=True)
    with open(path, "a") as file:
        if wait:
            wait_for_lock(file.fileno(), busy)
        else:
            try:
                fcntl.flock(file, fcntl.LOCK_EX | fcntl.LOCK_NB)
            except BlockingIOError as error:
                raise UserError(busy, code="in-use") from error
        yield


def wait_for_lock(handle: int, busy: str) -> None:
    """Take an exclusive lock on a file that is open for writing, and wait while another process
    holds it.

    Args:
        handle: File descriptor; closing it releases the lock.
        busy: What to log before waiting.
    """
    try:
        fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
    except BlockingIOError:
        log.info("%s; waiting", busy)
        fcntl.flock(handle, fcntl.LOCK_EX)


def changed_settings(folder: Path, settings: dict[str, Any]) -> list[str]:
    """Return `compare_settings` of the run in `folder` and `settings`; empty if there is no run.

    Raises:
        UserError: The settings of the run are damaged.
    """
    from omegaconf import OmegaConf
    from yaml import YAMLError

    path = folder / "config.yaml"
    if not path.exists():
        return []
    try:
        return compare_settings(OmegaConf.to_container(OmegaConf.load(path)), settings)
    except (YAMLError, ValueError) as error:
        first = str(error).partition("\n")[0]
        raise UserError(
            f"{path} is damaged ({first}): restore it, or delete {folder} and start again",
            code="damaged-file",
        ) from error


def flatten(value: Any, key: str = "") -> dict[str, Any]:
    """Flatten nested settings to a dict by dotted key, such as train.lr."""
    if not isinstance(value, dict) or not value:
        return {key: value}
    return {
        dotted: leaf
        for name, inner in value.items()
        for dotted, leaf in flatten(inner, f"{key}.{name}" if key else str(name)).items()
    }


def compare_settings(before: Any, now: Any) -> list[str]:
    """Describe each setting that differs between two nested dicts, except those that do not change
    the result of a run (RESULT_NEUTRAL_KEYS)."""
    before, now = (
        {key: json.dumps(value) for key, value in flatten(settings).items()}
        for settings in (before, now)
    )
    return [
        f"{key} was {before.get(key, 'absent')} and is now {now.get(key, 'absent')}"
        for key in sorted((before.keys() | now.keys()) - RESULT_NEUTRAL_KEYS)
        # A removed or a new dict of values that is empty changes nothing.
        if before.get(key, "{}") != now.get(key, "{}")
    ]


def run_id(run: Run) -> str:
    """Return the unique id of a run, from its folder and the time of its first start; resuming
    keeps it."""
    record = read_json(run.folder / "run.json")
    first = [*record["earlier_starts"], record["started"]][0]
    return hashlib.sha256(f"{run.folder.resolve()} {first}".encode()).hexdigest()[:16]


def _git() -> dict[str, Any] | None:
    """Return the commit of the code, and whether there are uncommitted changes; None without
    git."""

    def git(*arguments: str) -> str:
        command, folder = ["git", *arguments], Path(__file__).parent
        return subprocess.check_output(command, cwd=folder, stderr=subprocess.DEVNULL, text=True)

    try:
        return {"commit": git("rev-parse", "HEAD").strip(), "dirty": bool(git("status", "-s"))}
    except (OSError, subprocess.CalledProcessError):
        return None


def _installed_versions() -> dict[str, str]:
    versions = {}
    for name in PACKAGES:
        # Which packages are installed depends on the extras.
        with suppress(PackageNotFoundError):
            versions[name] = version(name)
    return versions
