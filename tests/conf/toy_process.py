"""Runs the toy command of toy.py as a process."""

from __future__ import annotations

import os
import subprocess
import sys
from pathlib import Path

NO_GPU = {**os.environ, "CUDA_VISIBLE_DEVICES": ""}


def start_toy(folder: Path, *arguments: str, env: dict[str, str] = NO_GPU) -> subprocess.Popen[str]:
    command, pipe = [sys.executable, "-m", "toy", *arguments], subprocess.PIPE
    return subprocess.Popen(command, cwd=folder, env=env, stdout=pipe, stderr=pipe, text=True)


def run_toy(
    folder: Path, *arguments: str, env: dict[str, str] = NO_GPU
) -> subprocess.CompletedProcess[str]:
    process = start_toy(folder, *arguments, env=env)
    output, errors = process.communicate(timeout=300)
    return subprocess.CompletedProcess(process.args, process.returncode, output, errors)
