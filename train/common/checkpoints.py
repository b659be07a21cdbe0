"""Find the checkpoint that a run resumes from, and check that checkpoints are complete."""

from __future__ import annotations

import errno
import json
import logging
import re
import zipfile
from pathlib import Path

from safetensors import SafetensorError, safe_open

from dynapix.conf.errors import UserError

log = logging.getLogger(__name__)

STATE = "trainer_state.json"
PARTS = {
    "file of weights": (
        "**/*.safetensors",
        "pytorch_model_fsdp*.bin",
        "pytorch_model_fsdp*/.metadata",
    ),
    "optimizer": ("optimizer.*", "optimizer_*/.metadata"),
    "schedule": ("scheduler.pt",),
    "random state": ("rng_state*.pth",),
    "trainer's state": (STATE,),
}
"""The parts of a checkpoint. Each part has patterns of files, at least one of which must match: if,
say, the optimizer or the random state were missing, the trainer would resume without an error, but
not as if it had never stopped. Of the files that FSDP writes, .metadata is written last."""
READERS = {
    ".json": lambda path: json.loads(path.read_bytes()),
    ".safetensors": lambda path: safe_open(path, "pt"),
    # torch writes zip archives, whose table of contents is at the end.
    **dict.fromkeys((".pt", ".pth", ".bin"), lambda path: zipfile.ZipFile(path).close()),
}
"""By suffix, a function that raises an error if a file is incomplete."""
ACCESS_ERRNOS = (errno.EACCES, errno.EPERM, errno.EIO, errno.ESTALE, errno.EMFILE, errno.ENFILE)
"""Numbers of operating system errors that say nothing about the content of a file."""


def newest_checkpoint(folder: Path) -> Path | None:
    """Return the newest complete checkpoint in a run's folder, or None.

    Newer ones that a kill, a crash or a full disk left incomplete are skipped with a warning.
    """
    named = [(re.fullmatch(r"checkpoint-(\d+)", p.name), p) for p in folder.glob("checkpoint-*")]
    numbered = sorted(((int(m[1]), p) for m, p in named if m), reverse=True)
    for k, (_, path) in enumerate(numbered):
        if (problem := find_damage(path)) is None:
            return path
        instead = "trying the one before" if k + 1 < len(numbered) else "training starts again"
        log.warning("%s is incomplete (%s): %s", path, problem, instead)
    return None


def find_damage(checkpoint: Path) -> str | None:
    """Return a phrase that says what is missing or incomplete in a checkpoint, or None.

    The trainer writes its state last, but if the machine crashes, any file may be lost.
    """
    for part, patterns in PARTS.items():
        if not any(True for pattern in patterns for _ in checkpoint.glob(pattern)):
            return f"its {part} is missing"
    for path in sorted(checkpoint.rglob("*")):
        try:
            if read := READERS.get(path.suffix):
                read(path)
        except (OSError, ValueError, SafetensorError, zipfile.BadZipFile) as error:
            if isinstance(error, OSError) and error.errno in ACCESS_ERRNOS:
                # The checkpoint may be complete; without it, the run would start again.
                raise UserError(
                    f"{path} cannot be read ({error}): correct this and run the same command again",
                    code="unreadable-checkpoint",
                ) from error
            return f"{path.relative_to(checkpoint)} is incomplete"
    return None
