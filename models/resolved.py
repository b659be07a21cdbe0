"""`resolved.yaml`: what a training run resolves before its first step, in the run's folder.

    precision: bf16                  of the passes; train.precision=auto depends on the machine
    base: Qwen/Qwen3-VL-8B-Instruct@0c351dd01ed8...
                                     name and commit of a hub model, or a digest of local weights
    data: 5f0f9a4a3c1d2e77           digest of everything that the run learns from

A run that resumes, is evaluated or is exported takes these values, whatever the machine and the hub
offer by then. Another base or other data are refused.
"""

from __future__ import annotations

import hashlib
from collections.abc import Iterable
from dataclasses import replace
from pathlib import Path

import yaml

from conf.errors import UserError
from conf.runs import write_text
from models.fingerprints import Preset, is_hub_model, model_id, pin_revisions, weights_digest
from models.precision import resolve_precision

RESOLVED = "resolved.yaml"


def resolve_run(folder: Path, precision: str, preset: Preset, data: str) -> tuple[str, Preset]:
    """Resolve a run's precision and its base's commit, and write them with the digest of its data.

    In `models.distributed.main_first`, the main rank resolves and writes; the others read.

    Args:
        folder: The run's folder.
        precision: bf16, fp32 or auto.
        data: What `data_digest` returns for the run.

    Returns:
        The precision, bf16 or fp32, and the preset with the commit.

    Raises:
        UserError: the folder holds a run on other data or over another base.
    """
    preset = pin_revisions(pin_base(folder, preset))
    check_base(folder, preset)
    if resolved := read_resolved(folder):
        if resolved["data"] != data:
            raise UserError(
                f"{folder} was started on other data: the benchmark, its rationales or the prompts "
                "have changed since. Restore them, or train in another folder (run=NAME)",
                code="other-data",
            )
        return resolved["precision"], preset
    precision = resolve_precision(precision)
    # A hub's base without a commit cannot be loaded, which loading it reports.
    if not is_hub_model(preset.model) or preset.revision:
        resolved = {"precision": precision, "base": base_identity(preset), "data": data}
        write_text(folder / RESOLVED, yaml.safe_dump(resolved, sort_keys=False))
    return precision, preset


def read_resolved(folder: Path) -> dict[str, str]:
    """Return the content of a folder's resolved.yaml; empty if the file does not exist.

    Raises:
        UserError: the file is damaged.
    """
    path = folder / RESOLVED
    try:
        resolved = yaml.safe_load(path.read_text())
        return {name: str(resolved[name]) for name in ("precision", "base", "data")}
    except FileNotFoundError:
        return {}
    except (yaml.YAMLError, KeyError, TypeError, ValueError) as error:
        raise UserError(
            f"{path} is damaged: delete {folder} and train again", code="damaged-file"
        ) from error


def pin_base(folder: Path, preset: Preset) -> Preset:
    """Return a run's preset with the commit of the hub's base that the run resolved."""
    name, _, commit = read_resolved(folder).get("base", "").rpartition("@")
    return replace(preset, revision=commit) if name and name == preset.model else preset


def check_base(folder: Path, preset: Preset) -> None:
    """Raise UserError if the weights in a local base are not those that a run was trained over."""
    resolved = read_resolved(folder)
    if not resolved or is_hub_model(preset.model):
        return
    if resolved["base"] != base_identity(preset):
        raise UserError(
            f"the weights in {preset.model} are not those that {folder} is trained over: restore "
            "them, or delete that run and train again",
            code="other-base",
        )


def base_identity(preset: Preset) -> str:
    """Return NAME@COMMIT of a hub's base, or the digest of a local one."""
    if is_hub_model(preset.model):
        return model_id(preset.model, preset.revision)
    return weights_digest(preset.model)


def data_digest(store_identity: str, texts: Iterable[str]) -> str:
    """Return a digest of what a run learns from: the benchmark, and texts that are not part of it
    (rationales, prompts), in order."""
    whole = hashlib.sha256(store_identity.encode())
    for text in texts:
        whole.update(hashlib.sha256(text.encode()).digest())
    return whole.hexdigest()[:16]
