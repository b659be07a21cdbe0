"""Which of a run's checkpoints can be gone on from."""

from __future__ import annotations

import json
import logging
import re
import zipfile
from pathlib import Path

from safetensors import SafetensorError, safe_open

from conf.errors import UserError

log = logging.getLogger(__name__)

STATE = "trainer_state.json"
NEEDED = {
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
"""What a checkpoint must hold, each under one of its patterns: without some of them the trainer
would go on all the same, from a new optimizer or another chance. Where several ranks write parts
of one, the list of the parts is written last."""


def newest_checkpoint(folder: Path) -> Path | None:
    """The newest whole checkpoint below a run's folder, and None where there is none. Those that a
    kill, a crash or a full disk cut off are told and passed over."""
    named = [(re.fullmatch(r"checkpoint-(\d+)", p.name), p) for p in folder.glob("checkpoint-*")]
    numbered = sorted(((int(m[1]), p) for m, p in named if m), reverse=True)
    for k, (_, path) in enumerate(numbered):
        if (problem := cut_off(path)) is None:
            return path
        instead = "going on from the one before it" if k + 1 < len(numbered) else "starting anew"
        log.warning("%s was cut off (%s): %s", path, problem, instead)
    return None


def check_best(checkpoint: Path) -> None:
    """Raises UserError where the checkpoint that was the best before `checkpoint` is not whole: the
    library would keep the last weights in its place without a word, or fail in the end."""
    best = json.loads((checkpoint / STATE).read_text())["best_global_step"]
    if best and (problem := cut_off(kept := checkpoint.with_name(f"checkpoint-{best}"))):
        raise UserError(
            f"{kept}, the best checkpoint so far, was lost or cut off ({problem}): put it back, or "
            f"delete {checkpoint.parent} and train again"
        )


def cut_off(checkpoint: Path) -> str | None:
    """What of a checkpoint is missing or not whole; None where nothing is.

    The trainer writes its state last, but a machine that goes down may lose any of the files.
    """
    for what, patterns in NEEDED.items():
        if not any(True for pattern in patterns for _ in checkpoint.glob(pattern)):
            return f"its {what} is missing"
    for path in sorted(checkpoint.rglob("*")):
        if path.is_file() and not is_whole(path):
            return f"{path.relative_to(checkpoint)} is not whole"
    return None


def is_whole(path: Path) -> bool:
    """Whether a file of weights, of pickled state or of JSON has its end; others count as whole."""
    try:
        if path.suffix == ".json":
            json.loads(path.read_bytes())
        elif path.suffix == ".safetensors":
            with safe_open(path, "pt"):
                pass
        elif path.suffix in (".pt", ".pth", ".bin"):
            # torch writes zip archives, whose table of contents stands at the end.
            zipfile.ZipFile(path).close()
    except (OSError, ValueError, SafetensorError, zipfile.BadZipFile):
        return False
    return True
