"""Find the GPUs of this machine without torch, whose import takes seconds and reserves memory."""

from __future__ import annotations

import logging
import os
import re
import subprocess
from itertools import takewhile

log = logging.getLogger(__name__)

DEVICE = r"\d+|(GPU|MIG)-\S+"
"""Pattern of a valid device in CUDA_VISIBLE_DEVICES: an index or an identifier."""


def visible_gpus() -> list[str]:
    """Return the GPUs that this process may use, in the notation of CUDA_VISIBLE_DEVICES."""
    visible = os.environ.get("CUDA_VISIBLE_DEVICES")
    if visible is not None:
        # Like CUDA, ignore everything after the first invalid device.
        devices = map(str.strip, visible.split(","))
        return list(takewhile(lambda device: re.fullmatch(DEVICE, device), devices))
    try:
        listed = subprocess.run(["nvidia-smi", "-L"], capture_output=True, text=True, timeout=60)
    except (OSError, subprocess.TimeoutExpired):
        return []
    count = sum(line.startswith("GPU ") for line in listed.stdout.splitlines())
    return [str(number) for number in range(count)]


def restrict_to_one_gpu() -> None:
    """Make only the first GPU visible, unless a launcher started this process as a rank.

    With several visible GPUs, transformers' Trainer runs one micro-batch on each, so that an
    optimizer step has more samples than `train.batch`. Call this before anything initialises CUDA;
    importing bitsandbytes does.
    """
    gpus = visible_gpus()
    if len(gpus) > 1 and "LOCAL_RANK" not in os.environ:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[0]
        log.info(
            "training on GPU %s of %d; start with accelerate launch to use all", gpus[0], len(gpus)
        )
