"""The GPUs of this machine, without importing torch, which takes seconds and reserves memory."""

from __future__ import annotations

import logging
import os
import re
import subprocess
from itertools import takewhile

log = logging.getLogger(__name__)

DEVICE = r"\d+|(GPU|MIG)-\S+"
"""A device in CUDA_VISIBLE_DEVICES."""


def visible_gpus() -> list[str]:
    """The GPUs that this process may use, as CUDA_VISIBLE_DEVICES names them."""
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

    A Trainer that sees several GPUs spreads each micro-batch over them, so that a step has more
    samples than the settings. Call this before anything initialises CUDA, as importing bitsandbytes
    does.
    """
    gpus = visible_gpus()
    if len(gpus) > 1 and "LOCAL_RANK" not in os.environ:
        os.environ["CUDA_VISIBLE_DEVICES"] = gpus[0]
        log.info(
            "training on GPU %s of %d; start with accelerate launch to use all", gpus[0], len(gpus)
        )
